//! Whether clicks of several frames would agree if the model were larger or smaller.

use crate::pnp::{Correspondence, PosedCamera};
use crate::pnp_problem::Problem;
use crate::sqpnp;

/// The size at which the model fits clicks best.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FittingScale {
    /// What the model's lengths must be multiplied by.
    pub factor: f64,
    /// Median residual with it, pixels.
    pub median_px: f64,
    /// Median residual at the model's own size.
    pub own_median_px: f64,
}

/// From a fiftieth to fifty times, which covers every pair of units that people mix up but metres and millimetres.
const WIDEST: f64 = 50.0;
/// Steps of 4 % find every valley; the best is then narrowed down.
const STEPS_PER_E: f64 = 25.0;

/// The factor that makes the clicks agree best, by the median distance of the points from where they were clicked. `None`
/// where all clicks are in one frame, which shows a large object far away as it shows a small one nearby.
pub(crate) fn fitting_scale(cameras: &[PosedCamera], correspondences: &[Correspondence]) -> Option<FittingScale> {
    let first = correspondences.first()?.camera_idx;
    if correspondences.iter().all(|c| c.camera_idx == first) {
        return None;
    }
    let median_at = |log_factor: f64| -> f64 {
        let factor = log_factor.exp();
        let scaled: Vec<Correspondence> = correspondences
            .iter()
            .map(|c| Correspondence { point_in_object: c.point_in_object * factor, ..*c })
            .collect();
        let problem = Problem::new(cameras, &scaled, None);
        let solutions = sqpnp::solve(&problem.sightings);
        let Some(best) = solutions.iter().min_by(|a, b| a.cost_m2.total_cmp(&b.cost_m2)) else { return f64::INFINITY };
        let mut lengths: Vec<f64> =
            problem.residuals(&best.world_from_object).iter().map(|r| r.map_or(f64::INFINITY, |r| r.norm())).collect();
        lengths.sort_by(f64::total_cmp);
        lengths[lengths.len() / 2]
    };
    let reach = (WIDEST.ln() * STEPS_PER_E).round() as i32;
    let mut best = (f64::INFINITY, 0.0);
    for i in -reach..=reach {
        let log_factor = f64::from(i) / STEPS_PER_E;
        let median = median_at(log_factor);
        if median < best.0 {
            best = (median, log_factor);
        }
    }
    let mut step = 0.5 / STEPS_PER_E;
    while step > 1e-3 {
        for log_factor in [best.1 - step, best.1 + step] {
            let median = median_at(log_factor);
            if median < best.0 {
                best = (median, log_factor);
            }
        }
        step *= 0.5;
    }
    best.0.is_finite().then(|| FittingScale { factor: best.1.exp(), median_px: best.0, own_median_px: median_at(0.0) })
}
