//! Alpha compositing along a ray, and its derivative.
//!
//! Sample i has opacity `alpha_i` and colour `c_i`; `T_i = prod_{j<i} (1 - alpha_j)` is what reaches it,
//! `w_i = T_i alpha_i` its weight, and the pixel is `C = sum_i w_i c_i + T_n background`.
//!
//! Let a loss have the derivatives `dC`, `dw_i` (for losses on weights or depth) and `dT` (on what is left). With
//! `q_i = dC . c_i + dw_i` and `Q`, the value of everything behind a sample, from back to front
//! `Q_n = dC . background + dT`, `Q_{i-1} = alpha_i q_i + (1 - alpha_i) Q_i`, the derivatives are
//! `d alpha_i = T_i (q_i - Q_i)` and `dc_i = w_i dC`: no division, also where a sample is opaque.

/// A composited ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Composite {
    /// C, including the background.
    pub rgb: [f32; 3],
    /// T_n: what no sample stopped.
    pub transmittance: f32,
}

/// What a loss asks of one composited ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CompositeGradient {
    /// dC.
    pub d_rgb: [f32; 3],
    /// dT.
    pub d_transmittance: f32,
}

/// Composites a ray; `weights` receives `w_i`.
pub fn composite(alphas: &[f32], colors: &[[f32; 3]], background: [f32; 3], weights: &mut [f32]) -> Composite {
    let mut rgb = [0.0; 3];
    let mut transmittance = 1.0;
    for ((alpha, color), weight) in alphas.iter().zip(colors).zip(weights) {
        *weight = transmittance * alpha;
        for d in 0..3 {
            rgb[d] += *weight * color[d];
        }
        transmittance *= 1.0 - alpha;
    }
    for d in 0..3 {
        rgb[d] += transmittance * background[d];
    }
    Composite { rgb, transmittance }
}

/// The derivatives of [`composite`]. `d_alphas` holds `dw_i` when it is called and `d alpha_i` when it returns;
/// `weights` are those of the forward pass.
pub fn composite_backward(
    alphas: &[f32],
    colors: &[[f32; 3]],
    background: [f32; 3],
    weights: &[f32],
    gradient: &CompositeGradient,
    d_alphas: &mut [f32],
    d_colors: &mut [[f32; 3]],
) {
    let d = gradient.d_rgb;
    let dot = |c: [f32; 3]| d[0] * c[0] + d[1] * c[1] + d[2] * c[2];
    // What reaches each sample, front to back, is kept in d_colors until it is overwritten.
    let mut reach = 1.0;
    for (alpha, slot) in alphas.iter().zip(d_colors.iter_mut()) {
        slot[0] = reach;
        reach *= 1.0 - alpha;
    }
    let mut behind = dot(background) + gradient.d_transmittance;
    for i in (0..alphas.len()).rev() {
        let value = dot(colors[i]) + d_alphas[i];
        d_alphas[i] = d_colors[i][0] * (value - behind);
        behind = alphas[i] * value + (1.0 - alphas[i]) * behind;
        d_colors[i] = d.map(|d| d * weights[i]);
    }
}

/// Rays of a tile, composited one after the other, and what a loss asks of their samples.
#[derive(Debug, Default)]
pub struct RayComposites {
    /// Opacity and colour of each sample.
    pub alphas: Vec<f32>,
    colors: Vec<[f32; 3]>,
    weights: Vec<f32>,
    backgrounds: Vec<[f32; 3]>,
    /// The samples of each ray end here.
    ends: Vec<usize>,
    /// The rays.
    pub rays: Vec<Composite>,
    /// The loss by the opacity and colour of each sample, once it was sent back.
    pub d_alphas: Vec<f32>,
    /// See `d_alphas`.
    pub d_colors: Vec<[f32; 3]>,
}

impl RayComposites {
    /// Forgets all rays.
    pub fn clear(&mut self) {
        self.alphas.clear();
        self.colors.clear();
        self.weights.clear();
        self.backgrounds.clear();
        self.ends.clear();
        self.rays.clear();
        self.d_alphas.clear();
        self.d_colors.clear();
    }

    /// Adds a sample to the ray that has begun.
    pub fn push(&mut self, alpha: f32, color: [f32; 3]) {
        self.alphas.push(alpha);
        self.colors.push(color);
    }

    /// Ends the ray, in front of a background.
    pub fn end_ray(&mut self, background: [f32; 3]) {
        let (start, end) = (self.ends.last().copied().unwrap_or(0), self.alphas.len());
        self.weights.resize(end, 0.0);
        self.d_alphas.resize(end, 0.0);
        self.d_colors.resize(end, [0.0; 3]);
        self.ends.push(end);
        self.backgrounds.push(background);
        self.rays.push(composite(&self.alphas[start..], &self.colors[start..], background, &mut self.weights[start..]));
    }

    /// Sends what a loss asks of a ray back to its samples.
    pub fn send_back(&mut self, ray: usize, gradient: &CompositeGradient) {
        let run = ray.checked_sub(1).map_or(0, |before| self.ends[before])..self.ends[ray];
        composite_backward(
            &self.alphas[run.clone()],
            &self.colors[run.clone()],
            self.backgrounds[ray],
            &self.weights[run.clone()],
            gradient,
            &mut self.d_alphas[run.clone()],
            &mut self.d_colors[run],
        );
    }
}

/// Opacity of a stretch of length `dt` with density `sigma`: `1 - exp(-sigma dt)`.
pub fn opacity(sigma: f32, dt: f32) -> f32 {
    -(-sigma * dt).exp_m1()
}

/// The distortion of a ray (Barron et al. 2022, eq. 15), small where the light is stopped in one place:
/// `sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 l_i` with ascending places s and lengths l. Adds
/// `scale * d/dw_i = scale (2 sum_j w_j |s_i - s_j| + 2/3 w_i l_i)` to `d_weights`, in linear time, and returns the value.
pub fn distortion(weights: &[f32], places: &[f32], lengths: &[f32], scale: f32, d_weights: &mut [f32]) -> f32 {
    let (total, moment) =
        weights.iter().zip(places).fold((0.0, 0.0), |(w, m), (weight, s)| (w + weight, m + weight * s));
    let (mut before, mut moment_before, mut value) = (0.0, 0.0, 0.0);
    for i in 0..weights.len() {
        let (w, s) = (weights[i], places[i]);
        let (after, moment_after) = (total - before - w, moment - moment_before - w * s);
        let pairs = s * before - moment_before + moment_after - s * after;
        value += w * pairs + w * w * lengths[i] / 3.0;
        d_weights[i] += scale * 2.0 * (pairs + w * lengths[i] / 3.0);
        before += w;
        moment_before += w * s;
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_homogeneous_slab_follows_beer_and_lambert() {
        // Density 2 over a length of 1.5, white on black: 1 - exp(-3), however the slab is cut.
        for n in [1, 7, 100] {
            let alphas = vec![opacity(2.0, 1.5 / n as f32); n];
            let mut weights = vec![0.0; n];
            let c = composite(&alphas, &vec![[1.0; 3]; n], [0.0; 3], &mut weights);
            assert!(
                (c.rgb[0] - (1.0 - (-3.0f32).exp())).abs() < 1e-5 && (c.transmittance - (-3.0f32).exp()).abs() < 1e-5
            );
            assert!((weights.iter().sum::<f32>() + c.transmittance - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn an_opaque_sample_hides_everything_behind_it_without_a_division_by_zero() {
        let (alphas, colors) = ([0.5, 1.0, 0.5], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let mut weights = [0.0; 3];
        let c = composite(&alphas, &colors, [9.0; 3], &mut weights);
        assert_eq!((c.rgb, c.transmittance), ([0.5, 0.5, 0.0], 0.0));
        let mut d_alphas = [0.0; 3];
        let gradient = CompositeGradient { d_rgb: [0.0, 1.0, 0.0], d_transmittance: 0.0 };
        composite_backward(&alphas, &colors, [9.0; 3], &weights, &gradient, &mut d_alphas, &mut [[0.0; 3]; 3]);
        // Behind the opaque green sample lies half of blue and half of the background, 4.5 in green.
        assert_eq!(d_alphas, [-1.0, 0.5 * (1.0 - 4.5), 0.0]);
    }

    proptest! {
        #[test]
        fn distortion_is_its_double_sum_and_has_its_derivative(
            samples in proptest::collection::vec((0.0..0.3f32, 0.01..0.2f32), 1..10),
        ) {
            let weights: Vec<f32> = samples.iter().map(|s| s.0).collect();
            let lengths: Vec<f32> = samples.iter().map(|s| s.1).collect();
            let places: Vec<f32> = lengths.iter().scan(0.0, |at, l| { *at += l; Some(*at - 0.5 * l) }).collect();
            let value = |w: &[f32]| {
                let mut sum = 0.0f64;
                for i in 0..w.len() {
                    sum += f64::from(w[i] * w[i] * lengths[i]) / 3.0;
                    sum += (0..w.len()).map(|j| f64::from(w[i] * w[j] * (places[i] - places[j]).abs())).sum::<f64>();
                }
                sum
            };
            let mut d = vec![0.0; weights.len()];
            let found = distortion(&weights, &places, &lengths, 0.5, &mut d);
            prop_assert!((f64::from(found) - value(&weights)).abs() < 1e-5);
            for i in 0..weights.len() {
                let at = |h: f32| { let mut w = weights.clone(); w[i] += h; value(&w) };
                // The value is quadratic in each weight: any step is exact.
                prop_assert!((at(0.1) - at(-0.1) - 0.4 * f64::from(d[i])).abs() < 1e-5);
            }
        }

        #[test]
        fn derivatives_agree_with_finite_differences(
            samples in proptest::collection::vec((0.0..0.95f32, proptest::array::uniform3(0.0..1.0f32), -1.0..1.0f32), 1..12),
            background in proptest::array::uniform3(0.0..1.0f32), d_rgb in proptest::array::uniform3(-1.0..1.0f32), d_t in -1.0..1.0f32,
        ) {
            let alphas: Vec<f32> = samples.iter().map(|s| s.0).collect();
            let colors: Vec<[f32; 3]> = samples.iter().map(|s| s.1).collect();
            let d_weights: Vec<f32> = samples.iter().map(|s| s.2).collect();
            let loss = |alphas: &[f32], colors: &[[f32; 3]]| {
                let (mut t, mut sum) = (1.0f64, 0.0f64);
                for i in 0..alphas.len() {
                    let w = t * f64::from(alphas[i]);
                    sum += w * f64::from(d_weights[i]);
                    sum += (0..3).map(|d| w * f64::from(colors[i][d]) * f64::from(d_rgb[d])).sum::<f64>();
                    t *= 1.0 - f64::from(alphas[i]);
                }
                sum + t * (f64::from(d_t) + (0..3).map(|d| f64::from(background[d] * d_rgb[d])).sum::<f64>())
            };
            let mut weights = vec![0.0; alphas.len()];
            composite(&alphas, &colors, background, &mut weights);
            let (mut d_alphas, mut d_colors) = (d_weights.clone(), vec![[0.0; 3]; alphas.len()]);
            let gradient = CompositeGradient { d_rgb, d_transmittance: d_t };
            composite_backward(&alphas, &colors, background, &weights, &gradient, &mut d_alphas, &mut d_colors);
            for i in 0..alphas.len() {
                // The loss is linear in each alpha and in each colour: any step is exact.
                let at = |h: f32| { let mut a = alphas.clone(); a[i] += h; loss(&a, &colors) };
                prop_assert!((at(0.05) - at(-0.05) - 0.1 * f64::from(d_alphas[i])).abs() < 1e-5);
                let at = |h: f32| { let mut c = colors.clone(); c[i][1] += h; loss(&alphas, &c) };
                prop_assert!((at(0.5) - at(-0.5) - f64::from(d_colors[i][1])).abs() < 1e-5);
            }
        }
    }
}
