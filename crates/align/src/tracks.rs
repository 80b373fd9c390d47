//! Points that several photographs show, from matches guided by the cameras' approximate poses.

use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_image::DepthImage;
use nalgebra::{Matrix3, Point2, Point3, Vector3};
use rayon::prelude::*;

use crate::features::Feature;
use crate::matching::{FeatureGrid, best_of};

/// A photograph with what guides the matching.
pub(crate) struct TrackFrame {
    pub intrinsics: Intrinsics,
    pub size: ImageSize,
    pub world_from_cam: Rigid3<World, Camera>,
    pub features: Vec<Feature>,
    /// The aligned model's depth, metres, 0 beside it.
    pub model_depth: DepthImage,
}

/// How the matching works.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TrackOptions {
    /// Frames that each frame is matched with.
    pub partners: usize,
    /// Largest angle between the viewing directions of matched frames, radians.
    pub max_angle_rad: f64,
    /// Distance from where the poses put a match, pixels.
    pub radius_px: f64,
    /// Descriptor distance ratio.
    pub ratio: f64,
}

/// A feature of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct FeatureRef {
    pub frame_idx: usize,
    pub feature_idx: usize,
}

/// Depths that a feature beside the model may have, metres.
const FREE_DEPTH_M: (f64, f64) = (0.1, 3.0);
/// Play of the model's depth, metres.
const MODEL_DEPTH_PLAY_M: f64 = 0.02;

impl TrackFrame {
    /// The model's depth at a feature; `None` beside the model, and where it steps by more than a millimetre in the
    /// pixels around, since the feature may then lie on either side.
    pub fn depth_at(&self, pixel: &Point2<f64>) -> Option<f64> {
        let (x, y) = (pixel.x.round(), pixel.y.round());
        if x < 1.0 || y < 1.0 || x + 1.0 >= self.size.width as f64 || y + 1.0 >= self.size.height as f64 {
            return None;
        }
        let (x, y) = (x as usize, y as usize);
        let around: Vec<f32> =
            (y - 1..=y + 1).flat_map(|v| (x - 1..=x + 1).map(move |u| self.model_depth[(u, v)])).collect();
        let (low, high) = around.iter().fold((f32::INFINITY, 0.0f32), |(low, high), z| (low.min(*z), high.max(*z)));
        (low > 0.0 && high - low < 1e-3).then(|| f64::from(self.model_depth[(x, y)]))
    }

    /// The model's point that a feature shows, in the world of this frame's pose.
    pub fn lift(&self, feature_idx: usize) -> Option<Point3<f64>> {
        let pixel = &self.features[feature_idx].pixel;
        let z = self.depth_at(pixel)?;
        Some(self.world_from_cam * self.intrinsics.cam_from_img(pixel, z))
    }

    /// Where `other` may show a feature of this frame: the segment between its nearest and farthest place.
    fn segment_in(&self, other: &Self, feature: &Feature) -> Option<(Point2<f64>, Point2<f64>)> {
        let (near, far) = match self.depth_at(&feature.pixel) {
            Some(z) => (z - MODEL_DEPTH_PLAY_M, z + MODEL_DEPTH_PLAY_M),
            None => FREE_DEPTH_M,
        };
        let other_from_cam = other.world_from_cam.inverse() * self.world_from_cam;
        let project = |z: f64| {
            let p = other_from_cam * self.intrinsics.cam_from_img(&feature.pixel, z);
            // Nearer than any camera focuses: the segment leaves the image there anyway.
            (p.z > 0.02).then(|| other.intrinsics.img_from_cam(&p)).flatten()
        };
        Some((project(near)?, project(far)?))
    }
}

/// Matches every frame with its neighbours and joins the matches into tracks over two or more frames, each with at most
/// one feature of a frame. Returns the tracks, and how many were given up because they held two features of one frame.
pub(crate) fn find_tracks(frames: &[TrackFrame], options: &TrackOptions) -> (Vec<Vec<FeatureRef>>, usize) {
    let grids: Vec<FeatureGrid> = frames.par_iter().map(|f| FeatureGrid::new(&f.features, f.size)).collect();
    let pairs = pairs(frames, options);
    let matches: Vec<Vec<(usize, usize)>> = pairs
        .par_iter()
        .map(|&(a, b)| {
            let there = guided(&frames[a], &frames[b], &grids[b], options);
            let back = guided(&frames[b], &frames[a], &grids[a], options);
            let mutual = there.iter().enumerate().filter_map(|(i, j)| j.map(|j| (i, j)));
            mutual.filter(|&(i, j)| back[j] == Some(i)).collect()
        })
        .collect();

    // Union of matches.
    let mut first = Vec::with_capacity(frames.len());
    let mut total = 0;
    for frame in frames {
        first.push(total);
        total += frame.features.len();
    }
    let mut parent: Vec<usize> = (0..total).collect();
    fn root(parent: &mut [usize], mut i: usize) -> usize {
        while parent[i] != i {
            parent[i] = parent[parent[i]];
            i = parent[i];
        }
        i
    }
    for (&(a, b), matches) in pairs.iter().zip(&matches) {
        for &(i, j) in matches {
            let (i, j) = (root(&mut parent, first[a] + i), root(&mut parent, first[b] + j));
            parent[i.max(j)] = i.min(j);
        }
    }
    let mut members: Vec<(usize, FeatureRef)> = Vec::new();
    for (frame_idx, frame) in frames.iter().enumerate() {
        for feature_idx in 0..frame.features.len() {
            members.push((root(&mut parent, first[frame_idx] + feature_idx), FeatureRef { frame_idx, feature_idx }));
        }
    }
    members.sort_unstable();
    let mut torn = 0;
    let mut tracks = Vec::new();
    for group in members.chunk_by(|a, b| a.0 == b.0).filter(|g| g.len() > 1) {
        if group.windows(2).any(|w| w[0].1.frame_idx == w[1].1.frame_idx) {
            torn += 1;
        } else {
            tracks.push(group.iter().map(|m| m.1).collect());
        }
    }
    (tracks, torn)
}

/// Each frame with those seen from the nearest directions.
fn pairs(frames: &[TrackFrame], options: &TrackOptions) -> Vec<(usize, usize)> {
    let forward: Vec<Vector3<f64>> = frames.iter().map(|f| f.world_from_cam.rotate(&Vector3::z())).collect();
    let mut pairs = Vec::new();
    for a in 0..frames.len() {
        let mut near: Vec<(f64, usize)> = (0..frames.len())
            .filter(|&b| b != a)
            .map(|b| (forward[a].angle(&forward[b]), b))
            .filter(|(angle, _)| *angle <= options.max_angle_rad)
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        pairs.extend(near.iter().take(options.partners).map(|&(_, b)| (a.min(b), a.max(b))));
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

fn guided(from: &TrackFrame, to: &TrackFrame, grid: &FeatureGrid, options: &TrackOptions) -> Vec<Option<usize>> {
    from.features
        .iter()
        .map(|feature| {
            let (a, b) = from.segment_in(to, feature)?;
            let candidates = grid.near_segment(&to.features, &a, &b, options.radius_px);
            best_of(feature, &to.features, &candidates, options.ratio)
        })
        .collect()
}

/// The point nearest to all rays, each weighted alike; `None` where the rays are nearly parallel (under a degree apart)
/// or the point lies behind a camera.
pub(crate) fn triangulate(rays: &[(Point3<f64>, Vector3<f64>)]) -> Option<Point3<f64>> {
    let widest = rays
        .iter()
        .enumerate()
        .flat_map(|(i, a)| rays[i + 1..].iter().map(move |b| a.1.angle(&b.1)))
        .fold(0.0, f64::max);
    if widest < 1f64.to_radians() {
        return None;
    }
    let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
    for (origin, direction) in rays {
        let d = direction.normalize();
        let across = Matrix3::identity() - d * d.transpose();
        a += across;
        b += across * origin.coords;
    }
    let p = Point3::from(a.cholesky()?.solve(&b));
    rays.iter().all(|(origin, direction)| (p - origin).dot(direction) > 0.0).then_some(p)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_where_they_were_sent() {
        let p = Point3::new(0.1, -0.2, 0.4);
        let ray = |x: f64| {
            let origin = Point3::new(x, 0.05 * x, 0.0);
            (origin, (p - origin) * 3.0)
        };
        let found = triangulate(&[ray(0.0), ray(0.1), ray(-0.05)]).unwrap();
        assert!((found - p).norm() < 1e-12);
        assert_eq!(triangulate(&[ray(0.0), ray(1e-4)]), None);
        let (origin, direction) = ray(0.0);
        assert_eq!(triangulate(&[ray(0.1), (origin, -direction)]), None);
    }
}
