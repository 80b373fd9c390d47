//! The plane that an object stands on: a table or a floor, which photographs without masks show as well.

use mb_mesh::{TriangleMesh, sample_uniform};
use nalgebra::{Matrix3, Point3, Unit, Vector3};
use rand::RngExt;
use rayon::prelude::*;
use serde::Serialize;

/// Points of the surface that planes are judged by, and planes that are judged.
const SAMPLES: usize = 4096;
const TRIALS: u64 = 2048;
/// Half the thickness that a plane's points may fill, as a share of the diagonal of the surface's box.
const TOLERANCE: f64 = 0.01;
/// Share of the area that a plane has to hold, and the most that may lie below it or has to lie above it.
const LEAST_SHARE: f64 = 0.1;
const MOST_BELOW: f64 = 0.1;
const LEAST_ABOVE: f64 = 0.05;

/// A plane in the world frame, seen from above by all cameras.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SupportPlane {
    /// Unit normal, to the side of the cameras.
    pub normal: Unit<Vector3<f64>>,
    /// Signed distance of the origin from the plane, metres.
    pub offset_m: f64,
    /// Standard deviation of the height of the points that lie on it, metres: 1.48 times the median of its size, which what
    /// rises from the plane does not change.
    pub roughness_m: f64,
    /// Share of the surface's area that lies on it.
    pub share: f64,
}

impl SupportPlane {
    /// Finds the plane that holds most of a surface, with all cameras (their centres) on one side, hardly any of the
    /// surface on the other, and something that stands on it. Random planes through three points of the surface are
    /// tried (Fischler and Bolles 1981), the best one is fitted to its points. `None` where no plane is like that.
    pub fn find(surface: &TriangleMesh, cameras: &[Point3<f64>]) -> Option<Self> {
        let bounds = surface.bounds();
        let tolerance = TOLERANCE * (bounds.max - bounds.min).norm();
        let points: Vec<Point3<f64>> = sample_uniform(surface, SAMPLES, 0).into_iter().map(|s| s.point).collect();
        if points.len() < 3 || cameras.is_empty() {
            return None;
        }
        let trial = |number: u64| {
            let mut rng = mb_job::rng(0, number);
            let [a, b, c] = std::array::from_fn(|_| points[rng.random_range(0..points.len())]);
            Self::through(&a, (b - a).cross(&(c - a)), cameras)
        };
        let score = |plane: &Self| {
            let (on, below, _) = plane.shares(&points, tolerance);
            on - below
        };
        let judged = (0..TRIALS).into_par_iter().filter_map(trial).map(|plane| (score(&plane), plane));
        // Of equals the same one, whichever thread comes first.
        let first =
            |a: &(f64, Self), b: &(f64, Self)| a.0.total_cmp(&b.0).then_with(|| b.1.offset_m.total_cmp(&a.1.offset_m));
        let (_, mut plane) = judged.max_by(first)?;
        for _ in 0..3 {
            plane = plane.fitted(&points, tolerance, cameras)?;
        }
        let (on, below, above) = plane.shares(&points, tolerance);
        plane.share = on;
        (on >= LEAST_SHARE && below <= MOST_BELOW && above >= LEAST_ABOVE).then_some(plane)
    }

    /// A plane through a point, unless cameras lie on both sides.
    fn through(point: &Point3<f64>, normal: Vector3<f64>, cameras: &[Point3<f64>]) -> Option<Self> {
        let mut normal = Unit::try_new(normal, 1e-12)?;
        if normal.dot(&(cameras[0] - point)) < 0.0 {
            normal = -normal;
        }
        let plane = Self { normal, offset_m: -normal.dot(&point.coords), roughness_m: 0.0, share: 0.0 };
        cameras.iter().all(|camera| plane.height(camera) > 0.0).then_some(plane)
    }

    /// The plane nearest to the points that lie on this one.
    fn fitted(&self, points: &[Point3<f64>], tolerance: f64, cameras: &[Point3<f64>]) -> Option<Self> {
        let on: Vec<&Point3<f64>> = points.iter().filter(|p| self.height(p).abs() <= tolerance).collect();
        if on.len() < 3 {
            return None;
        }
        let mean = Point3::from(on.iter().map(|p| p.coords).sum::<Vector3<f64>>() / on.len() as f64);
        let scatter: Matrix3<f64> = on.iter().map(|p| (*p - mean) * (*p - mean).transpose()).sum();
        let eigen = scatter.symmetric_eigen();
        let normal = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
        let plane = Self::through(&mean, normal, cameras)?;
        let mut heights: Vec<f64> = on.iter().map(|p| plane.height(p).abs()).collect();
        heights.sort_unstable_by(f64::total_cmp);
        Some(Self { roughness_m: 1.4826 * heights[heights.len() / 2], ..plane })
    }

    /// Shares of points on the plane, below and above it.
    fn shares(&self, points: &[Point3<f64>], tolerance: f64) -> (f64, f64, f64) {
        let share = |of: &dyn Fn(f64) -> bool| {
            points.iter().filter(|p| of(self.height(p))).count() as f64 / points.len() as f64
        };
        (share(&|h| h.abs() <= tolerance), share(&|h| h < -2.0 * tolerance), share(&|h| h > 2.0 * tolerance))
    }

    /// Height of a point, metres.
    pub fn height(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&point.coords) + self.offset_m
    }

    /// Takes what does not rise `clearance_m` above the plane out of a surface.
    pub fn cut(&self, surface: &mut TriangleMesh, clearance_m: f64) {
        let above: Vec<bool> = surface.vertices.iter().map(|v| self.height(v) >= clearance_m).collect();
        surface.retain_vertices(&above);
    }
}
