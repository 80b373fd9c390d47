//! Opacity from signed distance (Wang et al. 2021, "NeuS"), and its derivatives.
//!
//! A section of length `dt` around a sample with distance f and gradient n, on a ray with direction d: `c = d . n`, held
//! to `i = -(relu(1/2 - c/2) (1 - r) + relu(-c) r)` (r rises from 0 to 1 over the first steps, so that early rays need
//! not face the surface), `prev = f - i dt / 2`, `next = f + i dt / 2`, and with the logistic function of sharpness s
//! `p = sigmoid(s prev)`, `q = sigmoid(s next)`: `alpha = clamp((p - q + e) / (p + e), 0, 1)`, e = 1e-5.
//!
//! Inside the clamp `alpha = 1 - q / (p + e)`, so `dp = q / (p + e)^2`, `dq = -1 / (p + e)`; the rest is the chain rule.

/// A section of a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Section {
    /// Signed distance at the sample.
    pub sdf: f32,
    /// Cosine between the ray's direction and the gradient (times the gradient's length).
    pub cosine: f32,
    /// Length.
    pub dt: f32,
}

/// Derivatives of an opacity.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SectionGradient {
    /// With respect to the distance.
    pub sdf: f32,
    /// With respect to the cosine.
    pub cosine: f32,
    /// With respect to the sharpness.
    pub sharpness: f32,
}

const EPSILON: f32 = 1e-5;

impl Section {
    fn held_cosine(&self, anneal: f32) -> f32 {
        -((0.5 - 0.5 * self.cosine).max(0.0) * (1.0 - anneal) + (-self.cosine).max(0.0) * anneal)
    }

    /// The opacity for a sharpness, with `anneal` r in 0..=1.
    pub fn alpha(&self, sharpness: f32, anneal: f32) -> f32 {
        let half = 0.5 * self.held_cosine(anneal) * self.dt;
        let p = sigmoid(sharpness * (self.sdf - half));
        let q = sigmoid(sharpness * (self.sdf + half));
        ((p - q + EPSILON) / (p + EPSILON)).clamp(0.0, 1.0)
    }

    /// The derivatives of [`Section::alpha`].
    pub fn gradient(&self, sharpness: f32, anneal: f32) -> SectionGradient {
        let half = 0.5 * self.held_cosine(anneal) * self.dt;
        let (prev, next) = (self.sdf - half, self.sdf + half);
        let (p, q) = (sigmoid(sharpness * prev), sigmoid(sharpness * next));
        let raw = (p - q + EPSILON) / (p + EPSILON);
        if !(0.0..=1.0).contains(&raw) {
            return SectionGradient::default();
        }
        let d_p = q / ((p + EPSILON) * (p + EPSILON)) * p * (1.0 - p);
        let d_q = -q * (1.0 - q) / (p + EPSILON);
        let d_half = sharpness * (d_q - d_p);
        let slope =
            if self.cosine < 1.0 { 0.5 * (1.0 - anneal) } else { 0.0 } + if self.cosine < 0.0 { anneal } else { 0.0 };
        SectionGradient {
            sdf: sharpness * (d_p + d_q),
            cosine: d_half * 0.5 * self.dt * slope,
            sharpness: d_p * prev + d_q * next,
        }
    }
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x.clamp(-80.0, 80.0)).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn derivatives_agree_with_finite_differences(
            sdf in -0.05..0.05f32, cosine in -1.2..1.3f32, dt in 0.005..0.1f32, sharpness in 10.0..60.0f32, anneal in 0.0..1.0f32,
        ) {
            prop_assume!(cosine.abs() > 0.02 && (cosine - 1.0).abs() > 0.02);
            let section = Section { sdf, cosine, dt };
            // In f64, so that the steps can be small.
            let alpha = |f: f64, c: f64, s: f64| {
                let (r, dt) = (f64::from(anneal), f64::from(dt));
                let i = -((0.5 - 0.5 * c).max(0.0) * (1.0 - r) + (-c).max(0.0) * r);
                let (p, q) = (1.0 / (1.0 + (-s * (f - 0.5 * i * dt)).exp()), 1.0 / (1.0 + (-s * (f + 0.5 * i * dt)).exp()));
                ((p - q + 1e-5) / (p + 1e-5)).clamp(0.0, 1.0)
            };
            let (f, c, s) = (f64::from(sdf), f64::from(cosine), f64::from(sharpness));
            prop_assert!((f64::from(section.alpha(sharpness, anneal)) - alpha(f, c, s)).abs() < 1e-4);
            let found = section.gradient(sharpness, anneal);
            let check = |found: f32, expected: f64| (f64::from(found) - expected).abs() < 2e-3 * expected.abs() + 2e-3;
            prop_assert!(check(found.sdf, (alpha(f + 1e-6, c, s) - alpha(f - 1e-6, c, s)) / 2e-6), "{found:?}");
            prop_assert!(check(found.cosine, (alpha(f, c + 1e-6, s) - alpha(f, c - 1e-6, s)) / 2e-6), "{found:?}");
            prop_assert!(check(found.sharpness, (alpha(f, c, s + 1e-6) - alpha(f, c, s - 1e-6)) / 2e-6), "{found:?}");
        }
    }

    #[test]
    fn a_sharp_surface_stops_a_ray_that_enters_and_not_one_that_leaves() {
        let at = |sdf: f32, cosine: f32| Section { sdf, cosine, dt: 0.1 }.alpha(1000.0, 1.0);
        assert!(at(0.0, -1.0) > 0.99 && at(0.2, -1.0) < 1e-3 && at(0.0, 1.0) < 1e-3);
        for extreme in [1e6, -1e6] {
            assert!(at(extreme, -1.0).is_finite());
            assert!(Section { sdf: extreme, cosine: -1.0, dt: 0.1 }.gradient(1e4, 1.0).sdf.is_finite());
        }
    }
}
