//! Clusters: triangles near each other that are placed, drawn or found hidden together.

use mb_geometry::Aabb;
use mb_mesh::TriangleMesh;
use nalgebra::{Matrix3x4, Point3};
use rayon::prelude::*;

/// Triangles of a cluster.
pub(crate) const CLUSTER: usize = 128;

/// The triangles of a mesh, ordered so that each [`CLUSTER`] of them in a row is compact: they are split at the median
/// along the longest side of the box around their middles, again and again.
pub(crate) fn compact_order(mesh: &TriangleMesh) -> Vec<u32> {
    let middle = |index: u32| {
        let [a, b, c] = mesh.triangles[index as usize].map(|v| mesh.vertices[v as usize].coords);
        // Single precision is enough to tell what is near.
        ((a + b + c) / 3.0).cast::<f32>().into()
    };
    let mut middles: Vec<(u32, [f32; 3])> =
        (0..mesh.triangles.len() as u32).into_par_iter().map(|index| (index, middle(index))).collect();
    split(&mut middles);
    middles.into_iter().map(|(index, _)| index).collect()
}

fn split(middles: &mut [(u32, [f32; 3])]) {
    if middles.len() <= CLUSTER {
        // As the mesh has them: neighbours there share vertices.
        middles.sort_unstable_by_key(|&(index, _)| index);
        return;
    }
    let extent: [f32; 3] = std::array::from_fn(|axis| {
        let at = || middles.iter().map(|(_, middle)| middle[axis]);
        at().fold(f32::NEG_INFINITY, f32::max) - at().fold(f32::INFINITY, f32::min)
    });
    let longest = (0..3).max_by(|&a, &b| extent[a].total_cmp(&extent[b])).expect("three axes");
    let half = (middles.len() / 2).next_multiple_of(CLUSTER);
    middles.select_nth_unstable_by(half, |a, b| a.1[longest].total_cmp(&b.1[longest]).then(a.0.cmp(&b.0)));
    let (low, high) = middles.split_at_mut(half);
    rayon::join(|| split(low), || split(high));
}

/// Where a cluster may appear in a view.
pub(crate) struct Placed {
    pub(crate) cluster: usize,
    /// Depth of its nearest point, or nearer.
    near: f64,
    /// First and last column and row that may see it.
    pub(crate) x: (usize, usize),
    pub(crate) y: (usize, usize),
}

impl Placed {
    /// `None` for a cluster wholly behind the camera or beside the image of `width` x `height` pixels.
    pub(crate) fn new(
        cluster: usize,
        bounds: &Aabb,
        img_from_frame: &Matrix3x4<f64>,
        [width, height]: [usize; 2],
    ) -> Option<Self> {
        let corners = bounds.corners().map(|p| img_from_frame * p.to_homogeneous());
        if corners.iter().all(|q| q.z < 0.0) || width == 0 || height == 0 {
            return None;
        }
        let near = corners.iter().map(|q| q.z).fold(f64::INFINITY, f64::min);
        // A box that reaches behind the camera may appear anywhere, and so may one that is not finite.
        if !(near > 0.0 && corners.iter().all(|q| q.iter().all(|v| v.is_finite()))) {
            return Some(Self { cluster, near: 0.0, x: (0, width - 1), y: (0, height - 1) });
        }
        let range = |axis: usize, pixels: usize| {
            // Far more than the rounding of a projection.
            const SLACK_PX: f64 = 1e-3;
            let at = || corners.iter().map(|q| q[axis] / q.z);
            let first = (at().fold(f64::INFINITY, f64::min) - SLACK_PX).ceil().max(0.0);
            let last = (at().fold(f64::NEG_INFINITY, f64::max) + SLACK_PX).floor().min(pixels as f64 - 1.0);
            (first <= last).then_some((first as usize, last as usize))
        };
        Some(Self { cluster, near, x: range(0, width)?, y: range(1, height)? })
    }

    /// No point of the cluster has a larger inverse depth.
    pub(crate) fn nearest(&self) -> f64 {
        // More than the rounding of a depth.
        (1.0 + 1e-9) / self.near
    }

    /// Nearest first.
    pub(crate) fn order(&self, other: &Self) -> std::cmp::Ordering {
        self.near.total_cmp(&other.near).then(self.cluster.cmp(&other.cluster))
    }
}

/// The box around each cluster of `triangles`.
pub(crate) fn bounds(vertices: &[Point3<f64>], triangles: &[[u32; 3]]) -> Vec<Aabb> {
    let around = |triangles: &[[u32; 3]]| Aabb::of(triangles.as_flattened().iter().map(|&v| &vertices[v as usize]));
    triangles.par_chunks(CLUSTER).map(around).collect()
}
