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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
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
