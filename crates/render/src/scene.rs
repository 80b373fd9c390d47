//! The rasteriser: projects vertices, sorts triangles into strips of rows, and fills the strips in parallel.

use mb_geometry::{ImageSize, Rigid3};
use mb_image::{DepthImage, Image};
use mb_mesh::TriangleMesh;
use nalgebra::{Matrix3x4, Point3, Vector3};
use rayon::prelude::*;

use crate::setup::{Corner, Setup};
use crate::strip::{Piece, STRIP, Strip};
use crate::{Raster, View};

/// Consecutive triangles that are drawn together. Near clusters are drawn first, so that most of what they hide is
/// found hidden at a glance.
const CLUSTER: usize = 128;
/// Clusters that one task sorts into strips.
const CLUSTERS_PER_TASK: usize = 128;

/// A mesh, ready to be rendered from many views.
pub struct Scene {
    vertices: Vec<Point3<f64>>,
    triangles: Vec<[u32; 3]>,
    /// Middle and radius of a ball around the triangles of each cluster.
    clusters: Vec<(Point3<f64>, f64)>,
}

impl Scene {
    /// Keeps a copy of the mesh's geometry.
    pub fn new(mesh: &TriangleMesh) -> Self {
        let ball = |triangles: &[[u32; 3]]| {
            let corners = || triangles.as_flattened().iter().map(|&v| &mesh.vertices[v as usize]);
            let middle = mb_geometry::Aabb::of(corners()).center();
            (middle, corners().map(|p| (p - middle).norm_squared()).fold(0.0, f64::max).sqrt())
        };
        let clusters = mesh.triangles.par_chunks(CLUSTER).map(ball).collect();
        Self { vertices: mesh.vertices.clone(), triangles: mesh.triangles.clone(), clusters }
    }

    /// Depth and triangle at every pixel centre of `view`.
    ///
    /// # Panics
    /// For images wider or higher than 65,535 pixels.
    pub fn render<F>(&self, view: &View<F>) -> Raster {
        let width = view.size.width.max(1);
        let mut depth = DepthImage::filled(view.size, 0.0);
        let mut triangle = Image::filled(view.size, 0);
        let depths = depth.data_mut().par_chunks_mut(STRIP * width);
        let outputs = depths.zip(triangle.data_mut().par_chunks_mut(STRIP * width));
        self.strips(view, outputs, |strip, (depth, triangle)| {
            strip.write_depth(depth);
            strip.write_triangles(triangle);
        });
        Raster { depth, triangle }
    }

    /// Depth alone, metres; 0 where nothing is seen.
    ///
    /// # Panics
    /// For images wider or higher than 65,535 pixels.
    pub fn depth<F>(&self, view: &View<F>) -> DepthImage {
        let mut depth = DepthImage::filled(view.size, 0.0);
        let outputs = depth.data_mut().par_chunks_mut(STRIP * view.size.width.max(1));
        self.strips(view, outputs, |strip, depth| strip.write_depth(depth));
        depth
    }

    /// Renders strip after strip and hands each to `write` with its part of the outputs.
    fn strips<F, T: Send>(
        &self,
        view: &View<F>,
        outputs: impl IndexedParallelIterator<Item = T>,
        write: impl Fn(&Strip, T) + Sync,
    ) {
        let size = view.size;
        assert!(size.width <= usize::from(u16::MAX) && size.height <= usize::from(u16::MAX), "{size} is too large");
        let cam_from_frame: Matrix3x4<f64> = view.cam_from_frame.to_matrix().fixed_view::<3, 4>(0, 0).into();
        let img_from_frame = view.intrinsics.to_matrix() * cam_from_frame;
        let homogeneous = |v: u32| img_from_frame * self.vertices[v as usize].to_homogeneous();
        let corners: Vec<Corner> = self
            .vertices
            .par_iter()
            .with_min_len(4096)
            .map(|p| Corner::new(&(img_from_frame * p.to_homogeneous())))
            .collect();
        let pieces: Vec<Vec<Vec<Piece>>> = self
            .front_to_back(&view.cam_from_frame)
            .par_chunks(CLUSTERS_PER_TASK)
            .map(|clusters| self.sort_into_strips(clusters, &corners, &homogeneous, size))
            .collect();
        outputs.enumerate().for_each_init(
            || Strip::new(size.width),
            |strip, (index, output)| {
                strip.begin(index * STRIP, size.height);
                for piece in pieces.iter().flat_map(|task| &task[index]) {
                    if strip.hides(piece) {
                        continue;
                    }
                    let triangle = self.triangles[piece.triangle as usize];
                    let seen = triangle.map(|v| &corners[v as usize]);
                    let setup = match seen.iter().all(|c| c.is_in_front()) {
                        true => Setup::in_front(seen),
                        false => Setup::across(seen, triangle.map(homogeneous)),
                    };
                    if let Some(setup) = setup {
                        strip.draw(piece, &setup);
                    }
                }
                write(strip, output);
            },
        );
    }

    /// The clusters that are not wholly behind the camera, nearest first.
    fn front_to_back<F>(&self, cam_from_frame: &Rigid3<mb_geometry::Camera, F>) -> Vec<usize> {
        let mut order: Vec<(f64, usize)> = self
            .clusters
            .iter()
            .enumerate()
            .map(|(index, (middle, radius))| ((*cam_from_frame * *middle).z, *radius, index))
            // A ball that is not finite may still hold triangles that are.
            .filter(|(z, radius, _)| z + radius >= 0.0 || (z + radius).is_nan())
            .map(|(z, radius, index)| (z - radius, index))
            .collect();
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        order.into_iter().map(|(_, index)| index).collect()
    }

    /// For each strip, the triangles of some clusters that touch it, in order.
    fn sort_into_strips(
        &self,
        clusters: &[usize],
        corners: &[Corner],
        homogeneous: &impl Fn(u32) -> Vector3<f64>,
        size: ImageSize,
    ) -> Vec<Vec<Piece>> {
        let mut strips = vec![Vec::new(); size.height.div_ceil(STRIP)];
        for &cluster in clusters {
            let first = cluster * CLUSTER;
            let last = (first + CLUSTER).min(self.triangles.len());
            for (index, triangle) in (first as u32..).zip(&self.triangles[first..last]) {
                let seen = triangle.map(|v| &corners[v as usize]);
                let (bounds, nearest) = match seen.iter().filter(|c| c.is_in_front()).count() {
                    // The next number above, as rounding may have gone down.
                    3 => (bounds_in_front(seen), (seen[0].w.max(seen[1].w).max(seen[2].w) as f32).next_up()),
                    0 => continue,
                    _ => (bounds_across(triangle.map(homogeneous)), f32::INFINITY),
                };
                let Some([x, y]) = bounds.pixels(size) else { continue };
                let piece = Piece { triangle: index, nearest, x, y };
                for strip in &mut strips[usize::from(y.0) / STRIP..=usize::from(y.1) / STRIP] {
                    strip.push(piece);
                }
            }
        }
        strips
    }
}

/// A rectangle of the image, in pixels.
struct Bounds {
    low: [f64; 2],
    high: [f64; 2],
}

impl Bounds {
    /// First and last column, first and last row; `None` where no pixel centre lies inside.
    #[inline]
    fn pixels(&self, size: ImageSize) -> Option<[(u16, u16); 2]> {
        // Far more than the rounding of a projection, far less than a pixel.
        const SLACK_PX: f64 = 1e-6;
        let range = |axis: usize, pixels: usize| {
            // Rounds up and down by truncation, which is one instruction everywhere.
            let (first, last) = (self.low[axis] + (1.0 - SLACK_PX), self.high[axis] + SLACK_PX);
            let first = if first > 0.0 { first as u32 } else { 0 };
            let end = pixels as f64 - 1.0;
            let last = if last < end { last } else { end };
            (last >= f64::from(first)).then_some((first as u16, last as u16))
        };
        Some([range(0, size.width)?, range(1, size.height)?])
    }
}

#[inline]
fn bounds_in_front([a, b, c]: [&Corner; 3]) -> Bounds {
    // Plain comparisons: these compile to single instructions, `f64::min` does not.
    let min = |a: f64, b: f64| if a < b { a } else { b };
    let max = |a: f64, b: f64| if a > b { a } else { b };
    Bounds {
        low: [min(min(a.x, b.x), c.x), min(min(a.y, b.y), c.y)],
        high: [max(max(a.x, b.x), c.x), max(max(a.y, b.y), c.y)],
    }
}

/// Bounds of the part in front of the camera's plane of a triangle that crosses it.
fn bounds_across(q: [Vector3<f64>; 3]) -> Bounds {
    let mut bounds = Bounds { low: [f64::INFINITY; 2], high: [f64::NEG_INFINITY; 2] };
    for (i, from) in q.iter().enumerate() {
        let to = &q[(i + 1) % 3];
        for axis in 0..2 {
            if from.z > 0.0 {
                bounds.low[axis] = bounds.low[axis].min(from[axis] / from.z);
                bounds.high[axis] = bounds.high[axis].max(from[axis] / from.z);
            }
            if (from.z > 0.0) != (to.z > 0.0) {
                // Towards the camera's plane the side runs off to infinity, on the side where it pierces the plane.
                let pierces = (from[axis] * to.z - to[axis] * from.z) * (to.z - from.z).signum();
                if pierces.is_nan() || pierces <= 0.0 {
                    bounds.low[axis] = f64::NEG_INFINITY;
                }
                if pierces.is_nan() || pierces >= 0.0 {
                    bounds.high[axis] = f64::INFINITY;
                }
            }
        }
    }
    bounds
}
