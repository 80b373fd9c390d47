//! All of space in a cube: the contraction of mip-NeRF 360 (Barron et al. 2022) with the maximum norm.
//!
//! Points of the scene frame with `|x| = max_d |x_d| <= 1` stay, farther ones go to `(2 - 1 / |x|) x / |x|`, so that
//! infinity is the border of the cube [-2, 2]^3, which is then scaled to the unit cube.

/// A scene point in the unit cube.
#[inline(always)]
pub fn contract(p: [f32; 3]) -> [f32; 3] {
    let norm = p[0].abs().max(p[1].abs()).max(p[2].abs());
    let scale = if norm <= 1.0 { 1.0 } else { (2.0 - 1.0 / norm) / norm };
    p.map(|c| 0.25 * scale * c + 0.5)
}

/// The scene point of a point of the unit cube; the border is infinitely far.
pub fn expand(u: [f32; 3]) -> [f32; 3] {
    let c = u.map(|v| 4.0 * (v - 0.5));
    let norm = c[0].abs().max(c[1].abs()).max(c[2].abs());
    let scale = if norm <= 1.0 { 1.0 } else { 1.0 / (norm * (2.0 - norm)) };
    c.map(|v| v * scale)
}

/// `J^T g` of [`contract`] at a scene point.
pub fn contract_gradient(p: [f32; 3], g: [f32; 3]) -> [f32; 3] {
    let widest = (0..3).max_by(|a, b| p[*a].abs().total_cmp(&p[*b].abs())).unwrap_or(0);
    let norm = p[widest].abs();
    if norm <= 1.0 {
        return g.map(|c| 0.25 * c);
    }
    // u = 0.25 s(m) p with s = 2 / m - 1 / m^2 and m = |p_widest|.
    let (scale, slope) = ((2.0 - 1.0 / norm) / norm, (2.0 / norm - 2.0) / (norm * norm));
    let mut out = g.map(|c| 0.25 * scale * c);
    out[widest] += 0.25 * slope * p[widest].signum() * (g[0] * p[0] + g[1] * p[1] + g[2] * p[2]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_derivative_agrees_with_finite_differences(
            p in proptest::array::uniform3(-3.0..3.0f32), g in proptest::array::uniform3(-1.0..1.0f32),
        ) {
            // Away from the kinks: the unit cube's border, and two equally wide axes.
            let mut wide = p.map(f32::abs);
            wide.sort_by(f32::total_cmp);
            prop_assume!((wide[2] - 1.0).abs() > 0.02 && wide[2] - wide[1] > 0.02);
            let found = contract_gradient(p, g);
            for d in 0..3 {
                let at = |h: f32| {
                    let mut p = p;
                    p[d] += h;
                    contract(p).iter().zip(&g).map(|(a, b)| f64::from(a * b)).sum::<f64>()
                };
                let expected = (at(5e-3) - at(-5e-3)) / 1e-2;
                prop_assert!((f64::from(found[d]) - expected).abs() < 2e-3, "{} is not {expected}", found[d]);
            }
        }

        #[test]
        fn expansion_inverts_contraction(p in proptest::array::uniform3(-50.0..50.0f32)) {
            let u = contract(p);
            prop_assert!(u.iter().all(|v| (0.0..=1.0).contains(v)));
            let back = expand(u);
            let norm = p.iter().fold(1.0f32, |a, v| a.max(v.abs()));
            for d in 0..3 {
                prop_assert!((back[d] - p[d]).abs() < 1e-5 * norm * norm, "{back:?} is not {p:?}");
            }
        }
    }
}
