//! Where along a ray to sample: stratified, and by importance.

use mb_job::Rng;
use rand::RngExt;

/// `n` ascending depths in `near..far`, one in each of n equal parts: at a random place, or in the middle without a
/// generator.
pub fn stratified(near: f32, far: f32, n: usize, mut rng: Option<&mut Rng>, out: &mut Vec<f32>) {
    out.clear();
    let part = (far - near) / n as f32;
    out.extend((0..n).map(|i| {
        let u = rng.as_mut().map_or(0.5, |rng| rng.random::<f32>());
        near + part * (i as f32 + u)
    }));
}

/// `n` ascending depths drawn from the piecewise constant density that has mass `weights[i]` between `edges[i]` and
/// `edges[i + 1]` (inverse transform; stratified, at random or in the middle of each stratum). A constant of 1e-5 is
/// added to every weight, as in the original NeRF, so that a ray of zeros is sampled evenly.
///
/// # Panics
/// `edges` is not one longer than `weights`, or there are no weights.
pub fn importance(edges: &[f32], weights: &[f32], n: usize, mut rng: Option<&mut Rng>, out: &mut Vec<f32>) {
    assert!(edges.len() == weights.len() + 1 && !weights.is_empty());
    out.clear();
    let total: f32 = weights.iter().map(|w| w + 1e-5).sum();
    let mut interval = 0;
    let mut before = 0.0;
    let mut mass = (weights[0] + 1e-5) / total;
    for i in 0..n {
        let u = (i as f32 + rng.as_mut().map_or(0.5, |rng| rng.random::<f32>())) / n as f32;
        while u > before + mass && interval + 1 < weights.len() {
            before += mass;
            interval += 1;
            mass = (weights[interval] + 1e-5) / total;
        }
        let t = ((u - before) / mass).clamp(0.0, 1.0);
        out.push(edges[interval] + t * (edges[interval + 1] - edges[interval]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn samples_ascend_inside_their_strata(seed: u64, near in 0.1..1.0f32, length in 0.1..5.0f32, n in 1usize..64) {
            let mut out = Vec::new();
            stratified(near, near + length, n, Some(&mut mb_job::rng(seed, 0)), &mut out);
            for (i, t) in out.iter().enumerate() {
                let part = length / n as f32;
                prop_assert!(*t >= near + part * i as f32 - 1e-5 && *t <= near + part * (i + 1) as f32 + 1e-5);
            }
            importance(&[0.0, 1.0, 3.0], &[0.2, 0.0], n, Some(&mut mb_job::rng(seed, 1)), &mut out);
            prop_assert!(out.windows(2).all(|w| w[0] <= w[1]) && out.iter().all(|t| (0.0..=3.0).contains(t)));
        }
    }

    #[test]
    fn importance_follows_the_weights() {
        let mut out = Vec::new();
        importance(&[0.0, 1.0, 2.0, 4.0], &[1.0, 0.0, 3.0], 4000, None, &mut out);
        let share = |a: f32, b: f32| out.iter().filter(|t| (a..b).contains(t)).count() as f32 / 4000.0;
        assert!(
            (share(0.0, 1.0) - 0.25).abs() < 1e-3 && share(1.0, 2.0) < 1e-3 && (share(2.0, 3.0) - 0.375).abs() < 1e-3
        );
    }
}
