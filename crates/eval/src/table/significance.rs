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
    /// Share of resamples whose mean has the other sign or is 0, doubled: small values speak against chance. Never below
    /// what the number of sequences can show: see [`PairedDifference::is_significant`].
    pub p_two_sided: f64,
}

impl PairedDifference {
    /// Whether chance is an unlikely explanation: `p_two_sided` is below 0.05. Fewer than six sequences never suffice: were
    /// each a toss of a coin, all of five would fall on one side with a probability of 0.06 (the sign test), however clear
    /// the interval looks, as resamples of a few numbers of one sign never cross 0.
    pub fn is_significant(&self) -> bool {
        self.p_two_sided < 0.05
    }
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
    // The sample itself counts as a resample (Davison and Hinkley 1997, section 4.2), so that p is never 0; and the least
    // that the sign test can give bounds it too.
    let resampled = 2.0 * (against + 1) as f64 / (RESAMPLES + 1) as f64;
    let least = 2.0 * 0.5f64.powi(count as i32);
    Some(PairedDifference {
        sequences: count,
        mean,
        p_two_sided: resampled.max(least).min(1.0),
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
        assert!((found.p_two_sided - 2.0 / 10_001.0).abs() < 1e-12 && found.is_significant());
        assert!(found.confidence_95.0 > 0.1 && found.confidence_95.1 < 0.12, "{found:?}");
        let noise: Vec<_> = (0..18).map(|i| (if i % 2 == 0 { 1.0 } else { -0.9 }, 0.0)).collect();
        let found = paired_bootstrap(&noise, 0).unwrap();
        assert!(found.p_two_sided > 0.5 && found.confidence_95.0 < 0.0, "{found:?}");
    }

    #[test]
    fn a_handful_of_sequences_is_never_significant() {
        for count in [2, 5, 6] {
            let pairs: Vec<_> = (0..count).map(|i| (f64::from(i) + 1.0, f64::from(i))).collect();
            let found = paired_bootstrap(&pairs, 0).unwrap();
            assert_eq!(found.p_two_sided, 2.0 * 0.5f64.powi(count));
            assert_eq!(found.is_significant(), count == 6);
        }
    }

    #[test]
    fn equal_methods_do_not_differ() {
        let found = paired_bootstrap(&[(1.0, 1.0), (2.0, 2.0)], 0).unwrap();
        assert_eq!((found.mean, found.p_two_sided), (0.0, 1.0));
        assert_eq!(paired_bootstrap(&[(1.0, 2.0)], 0), None);
        assert_eq!(paired_bootstrap(&[(1.0, 2.0), (f64::NAN, 1.0)], 0), None);
    }
}
