//! The rasteriser: places clusters of triangles in the image, and fills strips of rows in parallel, nearest cluster
//! first, so that most of what is hidden is found hidden at a glance.

use mb_geometry::Aabb;
use mb_image::{DepthImage, Image};
use mb_mesh::TriangleMesh;
use nalgebra::{Matrix3x4, Point3, Vector3};
use rayon::prelude::*;

use crate::cluster::{self, CLUSTER, Placed};
use crate::setup::{Corner, Setup};
use crate::strip::{Piece, STRIP, Strip};
use crate::{Raster, View, Window};

/// A mesh, ready to be rendered from many views.
pub struct Scene {
    vertices: Vec<Point3<f64>>,
    /// Ordered so that a cluster, which is [`CLUSTER`] of them in a row, is compact.
    triangles: Vec<[u32; 3]>,
    /// Index of each triangle in the mesh.
    mesh_index: Vec<u32>,
    /// The box around each cluster.
    clusters: Vec<Aabb>,
}

impl Scene {
    /// Keeps a copy of the mesh's geometry.
    pub fn new(mesh: &TriangleMesh) -> Self {
        let mesh_index = cluster::compact_order(mesh);
        let triangles: Vec<_> = mesh_index.par_iter().map(|&index| mesh.triangles[index as usize]).collect();
        let clusters = cluster::bounds(&mesh.vertices, &triangles);
        Self { vertices: mesh.vertices.clone(), triangles, mesh_index, clusters }
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
        self.strips(view, true, outputs, |strip, (depth, triangle)| {
            strip.write_depth(depth);
            strip.write_triangles(triangle);
        });
        Raster { depth, triangle }
    }

    /// Like [`render`](Self::render), of the part of the image that the mesh may fill; `None` where it is not in the
    /// image. For meshes in front of the camera.
    ///
    /// # Panics
    /// As for [`render`](Self::render).
    pub fn render_where_seen<F>(&self, view: &View<F>) -> Option<(Window, Raster)> {
        let seen = |p: &Point3<f64>| view.intrinsics.img_from_cam(&(view.cam_from_frame * *p)).map(|p| [p.x, p.y]);
        let window = Window::around(self.clusters.iter().flat_map(Aabb::corners).filter_map(|p| seen(&p)), view.size)?;
        Some((window, self.render(&view.within(&window))))
    }

    /// Depth alone, metres; 0 where nothing is seen.
    ///
    /// # Panics
    /// For images wider or higher than 65,535 pixels.
    pub fn depth<F>(&self, view: &View<F>) -> DepthImage {
        let mut depth = DepthImage::filled(view.size, 0.0);
        let outputs = depth.data_mut().par_chunks_mut(STRIP * view.size.width.max(1));
        self.strips(view, false, outputs, |strip, depth| strip.write_depth(depth));
        depth
    }

    /// Renders strip after strip and hands each to `write` with its part of the outputs.
    fn strips<F, T: Send>(
        &self,
        view: &View<F>,
        with_triangles: bool,
        outputs: impl IndexedParallelIterator<Item = T>,
        write: impl Fn(&Strip, T) + Sync,
    ) {
        let size = view.size;
        assert!(size.width <= usize::from(u16::MAX) && size.height <= usize::from(u16::MAX), "{size} is too large");
        let cam_from_frame: Matrix3x4<f64> = view.cam_from_frame.to_matrix().fixed_view::<3, 4>(0, 0).into();
        let img_from_frame = view.intrinsics.to_matrix() * cam_from_frame;
        let corners: Vec<Corner> = self
            .vertices
            .par_iter()
            .with_min_len(4096)
            .map(|p| Corner::new(&(img_from_frame * p.to_homogeneous())))
            .collect();
        let mut placed: Vec<Placed> = self
            .clusters
            .par_iter()
            .enumerate()
            .filter_map(|(index, bounds)| Placed::new(index, bounds, &img_from_frame, [size.width, size.height]))
            .collect();
        placed.sort_unstable_by(Placed::order);
        let mut placed_in: Vec<Vec<&Placed>> = vec![Vec::new(); size.height.div_ceil(STRIP)];
        for cluster in &placed {
            placed_in[cluster.y.0 / STRIP..=cluster.y.1 / STRIP].iter_mut().for_each(|strip| strip.push(cluster));
        }
        outputs.zip(placed_in).enumerate().for_each_init(
            || Strip::new(size.width, with_triangles),
            |strip, (index, (output, clusters))| {
                strip.begin(index * STRIP, size.height);
                for placed in clusters {
                    if !strip.hides_cluster(placed) {
                        self.draw(placed.cluster, &corners, &img_from_frame, strip);
                    }
                }
                write(strip, output);
            },
        );
    }

    /// Draws a cluster's triangles into a strip.
    fn draw(&self, cluster: usize, corners: &[Corner], img_from_frame: &Matrix3x4<f64>, strip: &mut Strip) {
        let homogeneous = |v: u32| img_from_frame * self.vertices[v as usize].to_homogeneous();
        let first = cluster * CLUSTER;
        let last = (first + CLUSTER).min(self.triangles.len());
        for (triangle, &index) in self.triangles[first..last].iter().zip(&self.mesh_index[first..last]) {
            let seen = triangle.map(|v| &corners[v as usize]);
            let in_front = seen.iter().filter(|c| c.is_in_front()).count();
            let bounds = match in_front {
                3 => bounds_in_front(seen),
                0 => continue,
                _ => bounds_across(triangle.map(homogeneous)),
            };
            let Some(piece) = bounds.piece(strip) else { continue };
            let setup = match in_front {
                3 if strip.hides(&piece, seen[0].w.max(seen[1].w).max(seen[2].w)) => continue,
                3 => Setup::in_front(seen),
                _ => Setup::across(seen, triangle.map(homogeneous)),
            };
            if let Some(setup) = setup {
                strip.draw(&piece, index, &setup);
            }
        }
    }
}

/// A rectangle of the image, in pixels.
struct Bounds {
    low: [f64; 2],
    high: [f64; 2],
}

impl Bounds {
    /// The pixels of a strip inside; `None` where it has none.
    #[inline]
    fn piece(&self, strip: &Strip) -> Option<Piece> {
        // Far more than the rounding of a projection, far less than a pixel.
        const SLACK_PX: f64 = 1e-6;
        let range = |axis: usize, begin: usize, end: usize| {
            // Rounds up and down by truncation, which is one instruction everywhere.
            let (first, last) = (self.low[axis] + (1.0 - SLACK_PX), self.high[axis] + SLACK_PX);
            let first = if first > begin as f64 { first as usize } else { begin };
            let end = end as f64 - 1.0;
            let last = if last < end { last } else { end };
            (last >= first as f64).then_some((first, last as usize))
        };
        let (columns, rows) = strip.pixels();
        let (first, last) = range(1, rows.start, rows.end)?;
        Some(Piece { x: range(0, columns.start, columns.end)?, rows: (first - rows.start, last - rows.start) })
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
