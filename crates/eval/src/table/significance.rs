//! Whether one method is better than another.

use rand::RngExt;
use serde::Serialize;

use crate::Interval;

/// The difference between two methods on the same sequences.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PairedDifference {
    /// Sequences that both methods have.
    pub sequences: usize,
    /// Mean of first minus second.
    pub mean: f64,
    /// 95 % interval of the mean, by drawing sequences with replacement.
    pub confidence_95: Interval,
    /// Share of resamples whose mean has the other sign or is 0, doubled: small values speak against chance.
    pub p_two_sided: f64,
}

/// Bootstrap resamples.
const RESAMPLES: usize = 10_000;

/// Compares two methods by a paired bootstrap over sequences (Efron and Tibshirani 1993): scores of the same sequence are
/// drawn together, so that hard sequences do not blur the difference. Each pair holds both methods' score of a sequence;
/// leave out sequences that one of them misses. `None` for fewer than two pairs, or numbers that are not finite.
pub fn paired_bootstrap(pairs: &[(f64, f64)], seed: u64) -> Option<PairedDifference> {
    let differences: Vec<f64> = pairs.iter().map(|(a, b)| a - b).collect();
    if differences.len() < 2 || !differences.iter().all(|d| d.is_finite()) {
        return None;
    }
    let count = differences.len();
    let mean = differences.iter().sum::<f64>() / count as f64;
    let mut rng = mb_job::rng(seed, 0);
    let means: Vec<f64> = (0..RESAMPLES)
        .map(|_| (0..count).map(|_| differences[rng.random_range(0..count)]).sum::<f64>() / count as f64)
        .collect();
    let against = means.iter().filter(|&&m| m * mean <= 0.0).count();
    Some(PairedDifference {
        sequences: count,
        mean,
        p_two_sided: (2.0 * against as f64 / RESAMPLES as f64).min(1.0),
        confidence_95: Interval::of(means),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_steady_difference_is_significant_and_noise_is_not() {
        // Sequences differ by far more than the methods do.
        let steady: Vec<_> = (0..18).map(|i| (f64::from(i) + 0.1 + 0.01 * f64::from(i % 3), f64::from(i))).collect();
        let found = paired_bootstrap(&steady, 0).unwrap();
        assert!((found.mean - 0.11).abs() < 1e-9);
        assert_eq!(found.p_two_sided, 0.0);
        assert!(found.confidence_95.0 > 0.1 && found.confidence_95.1 < 0.12, "{found:?}");
        let noise: Vec<_> = (0..18).map(|i| (if i % 2 == 0 { 1.0 } else { -0.9 }, 0.0)).collect();
        let found = paired_bootstrap(&noise, 0).unwrap();
        assert!(found.p_two_sided > 0.5 && found.confidence_95.0 < 0.0, "{found:?}");
    }

    #[test]
    fn equal_methods_do_not_differ() {
        let found = paired_bootstrap(&[(1.0, 1.0), (2.0, 2.0)], 0).unwrap();
        assert_eq!((found.mean, found.p_two_sided), (0.0, 1.0));
        assert_eq!(paired_bootstrap(&[(1.0, 2.0)], 0), None);
        assert_eq!(paired_bootstrap(&[(1.0, 2.0), (f64::NAN, 1.0)], 0), None);
    }
}
