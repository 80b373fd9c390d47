//! The alignment inside the published protocol: point-to-point ICP on vertices, as Open3D 0.19 runs it
//! (`registration_icp` with `TransformationEstimationPointToPoint`).

use mb_geometry::{Rigid3, Sim3, World};
use mb_mesh::KdTree;
use nalgebra::Point3;
use rayon::prelude::*;

/// Pairs farther apart than this do not count.
const MAX_DISTANCE_M: f64 = 0.02;
/// The published script's `max_iteration`.
const MAX_ITERATIONS: usize = 10;
/// Open3D's defaults `relative_fitness` and `relative_rmse`, which it compares with absolute differences.
const SETTLED: f64 = 1e-6;

/// Above this fitness the published protocol moves the prediction.
pub(super) const APPLY_ABOVE: f64 = 0.99;

/// Outcome of the alignment.
pub(super) struct Registration {
    /// Share of the source's points with a partner.
    pub fitness: f64,
    /// Maps the source (the ground truth) onto the target (the prediction).
    pub pred_from_gt: Rigid3<World, World>,
}

/// Aligns the ground truth's vertices to the prediction's.
pub(super) fn register(gt: &[Point3<f64>], pred: &[Point3<f64>]) -> Registration {
    let tree = KdTree::new(pred);
    let mut moved = gt.to_vec();
    let mut pred_from_gt = Rigid3::identity();
    let mut pairs = Pairs::find(&tree, &moved);
    for _ in 0..MAX_ITERATIONS {
        let from: Vec<Point3<f64>> = pairs.matches.iter().map(|&(i, _)| moved[i]).collect();
        let to: Vec<Point3<f64>> = pairs.matches.iter().map(|&(_, j)| pred[j]).collect();
        let update = Sim3::<World, World>::align_any(&to, &from, false).map_or_else(Rigid3::identity, |s| s.rigid);
        pred_from_gt = update * pred_from_gt;
        moved.par_iter_mut().for_each(|p| *p = update * *p);
        let before = std::mem::replace(&mut pairs, Pairs::find(&tree, &moved));
        if (before.fitness - pairs.fitness).abs() < SETTLED && (before.rmse_m - pairs.rmse_m).abs() < SETTLED {
            break;
        }
    }
    Registration { fitness: pairs.fitness, pred_from_gt }
}

/// Nearest neighbours within [`MAX_DISTANCE_M`].
struct Pairs {
    /// (index in the source, index in the target), by source.
    matches: Vec<(usize, usize)>,
    fitness: f64,
    rmse_m: f64,
}

impl Pairs {
    fn find(tree: &KdTree, source: &[Point3<f64>]) -> Self {
        let nearest: Vec<_> =
            source.par_iter().with_min_len(256).map(|p| tree.nearest_within(p, MAX_DISTANCE_M)).collect();
        let mut squares = 0.0;
        let mut matches = Vec::with_capacity(source.len());
        for (i, nearest) in nearest.into_iter().enumerate() {
            // Open3D's radius is exclusive.
            if let Some((j, distance)) = nearest.filter(|(_, d)| *d < MAX_DISTANCE_M) {
                squares += distance * distance;
                matches.push((i, j));
            }
        }
        let count = matches.len().max(1) as f64;
        Self { fitness: matches.len() as f64 / source.len() as f64, rmse_m: (squares / count).sqrt(), matches }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector6;

    fn cloud() -> Vec<Point3<f64>> {
        use rand::RngExt;
        let mut rng = mb_job::rng(1, 0);
        (0..2000).map(|_| Point3::new(rng.random(), rng.random::<f64>() * 0.5, rng.random::<f64>() * 0.3)).collect()
    }

    #[test]
    fn a_small_motion_is_recovered() {
        let gt = cloud();
        let pred_from_gt = Rigid3::<World, World>::exp(&Vector6::new(0.002, -0.001, 0.0015, 0.001, -0.002, 0.001));
        let pred: Vec<_> = gt.iter().map(|p| pred_from_gt * *p).collect();
        let found = register(&gt, &pred);
        assert_eq!(found.fitness, 1.0);
        assert!((found.pred_from_gt.inverse() * pred_from_gt).log().norm() < 1e-9);
    }

    #[test]
    fn without_partners_nothing_moves() {
        let found = register(&cloud(), &[Point3::new(9.0, 9.0, 9.0)]);
        assert_eq!(found.fitness, 0.0);
        assert_eq!(found.pred_from_gt, Rigid3::identity());
    }
}
