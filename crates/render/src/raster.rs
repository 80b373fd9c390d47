//! The rasteriser.
//!
//! A pixel's ray, in homogeneous pixel coordinates, is p = (x, y, 1). With the corners q0, q1, q2 of a triangle in the
//! same coordinates (q = K * p_in_cam), the ray meets the triangle where (qj x qk) . p has the sign of
//! det = q0 . (q1 x q2) for all three sides, and 1 / depth = n . p / det with n = (q1 - q0) x (q2 - q0) (Olano and
//! Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997). Nothing is divided by a corner's depth,
//! so triangles that cross the camera's plane need no clipping. Everything is `f64`, and a side's function is the exact
//! negative of what the neighbour across that side computes, so that no pixel falls between them.

use mb_geometry::ImageSize;
use mb_image::{DepthImage, Image, Mask};
use mb_mesh::TriangleMesh;
use nalgebra::{Matrix3x4, Point3, Vector3};
use rayon::prelude::*;

use crate::View;
use crate::setup::Setup;

/// Marks pixels that see no triangle.
pub const NO_TRIANGLE: u32 = u32::MAX;

/// Rows of the image that one task fills.
const STRIP: usize = 32;
/// Pixels that are tested together.
const LANES: usize = 4;
/// Triangles that one task assigns to strips.
const CHUNK: usize = 16_384;

/// What a camera sees, pixel by pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    /// Depth along z at the pixel's centre, metres; 0 where nothing is seen.
    pub depth: DepthImage,
    /// Index of the nearest triangle, [`NO_TRIANGLE`] where nothing is seen. Of triangles at the very same depth the
    /// lowest index is seen.
    pub triangle: Image<u32>,
}

impl Raster {
    /// Where anything is seen.
    pub fn mask(&self) -> Mask {
        self.triangle.map(|&t| t != NO_TRIANGLE)
    }
}

/// A mesh, ready to be rendered from many views.
pub struct Scene {
    vertices: Vec<Point3<f64>>,
    triangles: Vec<[u32; 3]>,
}

/// A vertex as seen from a view.
#[derive(Clone, Copy)]
struct Projected {
    /// Homogeneous pixel coordinates; the last is the depth.
    q: Vector3<f64>,
    /// Pixel coordinates, of meaning for positive depth.
    x: f64,
    y: f64,
}

/// A triangle's piece in one strip.
#[derive(Clone, Copy)]
struct Piece {
    triangle: u32,
    /// First and last column.
    x: (u16, u16),
    /// First and last row, of the whole triangle.
    y: (u16, u16),
}

impl Scene {
    /// Keeps a copy of the mesh's geometry.
    pub fn new(mesh: &TriangleMesh) -> Self {
        Self { vertices: mesh.vertices.clone(), triangles: mesh.triangles.clone() }
    }

    /// Depth and triangle at every pixel centre of `view`.
    ///
    /// # Panics
    /// For images wider or higher than 65,535 pixels.
    pub fn render<F>(&self, view: &View<F>) -> Raster {
        let size = view.size;
        let mut depth = DepthImage::filled(size, 0.0);
        let mut triangle = Image::filled(size, NO_TRIANGLE);
        let width = size.width.max(1);
        let rows =
            depth.data_mut().par_chunks_mut(STRIP * width).zip(triangle.data_mut().par_chunks_mut(STRIP * width));
        self.strips(view, rows, |strip, (depth, triangle)| {
            for (row, (depth, triangle)) in depth.chunks_mut(width).zip(triangle.chunks_mut(width)).enumerate() {
                let (inverse_depths, triangles) = strip.row(row);
                for (depth, &w) in depth.iter_mut().zip(inverse_depths) {
                    *depth = depth_of(w);
                }
                triangle.copy_from_slice(&triangles[..width]);
            }
        });
        Raster { depth, triangle }
    }

    /// Depth alone, metres; 0 where nothing is seen.
    ///
    /// # Panics
    /// For images wider or higher than 65,535 pixels.
    pub fn depth<F>(&self, view: &View<F>) -> DepthImage {
        let mut depth = DepthImage::filled(view.size, 0.0);
        let width = view.size.width.max(1);
        self.strips(view, depth.data_mut().par_chunks_mut(STRIP * width), |strip, depth| {
            for (row, depth) in depth.chunks_mut(width).enumerate() {
                for (depth, &w) in depth.iter_mut().zip(strip.row(row).0) {
                    *depth = depth_of(w);
                }
            }
        });
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
        let projected = self.project(view);
        let assigned: Vec<Vec<Vec<Piece>>> = self
            .triangles
            .par_chunks(CHUNK)
            .enumerate()
            .map(|(chunk, triangles)| assign(triangles, chunk * CHUNK, &projected, size))
            .collect();
        outputs.enumerate().for_each_init(
            || Strip::new(size.width),
            |strip, (index, output)| {
                strip.begin(index * STRIP, size.height);
                for chunk in &assigned {
                    for piece in &chunk[index] {
                        let corners = self.triangles[piece.triangle as usize].map(|v| &projected[v as usize]);
                        strip.draw(piece, corners);
                    }
                }
                write(strip, output);
            },
        );
    }

    fn project<F>(&self, view: &View<F>) -> Vec<Projected> {
        let cam_from_frame: Matrix3x4<f64> = view.cam_from_frame.to_matrix().fixed_view::<3, 4>(0, 0).into();
        let img_from_frame = view.intrinsics.to_matrix() * cam_from_frame;
        let project = |p: &Point3<f64>| {
            let q = img_from_frame * p.to_homogeneous();
            Projected { q, x: q.x / q.z, y: q.y / q.z }
        };
        self.vertices.par_iter().with_min_len(4096).map(project).collect()
    }
}

fn depth_of(inverse_depth: f64) -> f32 {
    if inverse_depth > 0.0 { (1.0 / inverse_depth) as f32 } else { 0.0 }
}

/// Sorts triangles, numbered from `first`, into the strips that they touch; each strip's list is in their order.
fn assign(triangles: &[[u32; 3]], first: usize, projected: &[Projected], size: ImageSize) -> Vec<Vec<Piece>> {
    let mut strips = vec![Vec::new(); size.height.div_ceil(STRIP)];
    for (index, triangle) in triangles.iter().enumerate() {
        let Some([x, y]) = pixel_bounds(triangle.map(|v| &projected[v as usize]), size) else { continue };
        let piece = Piece { triangle: (first + index) as u32, x, y };
        for strip in usize::from(y.0) / STRIP..=usize::from(y.1) / STRIP {
            strips[strip].push(piece);
        }
    }
    strips
}

/// Pixel columns and rows (first, last) that may see the triangle; `None` where none can.
fn pixel_bounds(corners: [&Projected; 3], size: ImageSize) -> Option<[(u16, u16); 2]> {
    // Far more than the rounding of a projection, far less than a pixel.
    const SLACK_PX: f64 = 1e-6;
    let [a, b, c] = corners;
    let mut low = [f64::INFINITY; 2];
    let mut high = [f64::NEG_INFINITY; 2];
    if a.q.z > 0.0 && b.q.z > 0.0 && c.q.z > 0.0 {
        low = [a.x.min(b.x).min(c.x), a.y.min(b.y).min(c.y)];
        high = [a.x.max(b.x).max(c.x), a.y.max(b.y).max(c.y)];
    } else {
        for (i, from) in corners.into_iter().enumerate() {
            let to = corners[(i + 1) % 3];
            if from.q.z > 0.0 {
                low = [low[0].min(from.x), low[1].min(from.y)];
                high = [high[0].max(from.x), high[1].max(from.y)];
            }
            if (from.q.z > 0.0) != (to.q.z > 0.0) {
                // Towards the camera's plane the side runs off to infinity, on the side where it pierces the plane.
                for axis in 0..2 {
                    let pierces = (from.q[axis] * to.q.z - to.q[axis] * from.q.z) * (to.q.z - from.q.z).signum();
                    if pierces.is_nan() || pierces <= 0.0 {
                        low[axis] = f64::NEG_INFINITY;
                    }
                    if pierces.is_nan() || pierces >= 0.0 {
                        high[axis] = f64::INFINITY;
                    }
                }
            }
        }
    }
    let range = |axis: usize, pixels: usize| {
        let first = (low[axis] - SLACK_PX).ceil().max(0.0);
        let last = (high[axis] + SLACK_PX).floor().min(pixels as f64 - 1.0);
        (first <= last).then_some((first as u16, last as u16))
    };
    Some([range(0, size.width)?, range(1, size.height)?])
}

/// A few rows of the image: for each pixel the largest inverse depth so far, and whose it is.
struct Strip {
    /// Row length, a multiple of the lanes.
    stride: usize,
    first_y: usize,
    rows: usize,
    inverse_depth: Vec<f64>,
    triangle: Vec<u32>,
}

impl Strip {
    fn new(width: usize) -> Self {
        let stride = width.next_multiple_of(LANES);
        Self {
            stride,
            first_y: 0,
            rows: STRIP,
            inverse_depth: vec![0.0; stride * STRIP],
            triangle: vec![NO_TRIANGLE; stride * STRIP],
        }
    }

    fn begin(&mut self, first_y: usize, height: usize) {
        self.first_y = first_y;
        self.rows = STRIP.min(height - first_y);
        self.inverse_depth.fill(0.0);
        self.triangle.fill(NO_TRIANGLE);
    }

    fn row(&self, row: usize) -> (&[f64], &[u32]) {
        let range = row * self.stride..(row + 1) * self.stride;
        (&self.inverse_depth[range.clone()], &self.triangle[range])
    }

    fn draw(&mut self, piece: &Piece, corners: [&Projected; 3]) {
        let Some(setup) = Setup::new(corners.map(|c| &c.q)) else { return };
        let first_x = usize::from(piece.x.0) / LANES * LANES;
        let last_x = usize::from(piece.x.1);
        let first_y = usize::from(piece.y.0).max(self.first_y);
        let last_y = usize::from(piece.y.1).min(self.first_y + self.rows - 1);
        for y in first_y..=last_y {
            let row = setup.row(y as f64);
            let start = (y - self.first_y) * self.stride;
            for x in (first_x..=last_x).step_by(LANES) {
                let range = start + x..start + x + LANES;
                let depths: &mut [f64; LANES] =
                    (&mut self.inverse_depth[range.clone()]).try_into().expect("LANES wide");
                let triangles: &mut [u32; LANES] = (&mut self.triangle[range]).try_into().expect("LANES wide");
                for lane in 0..LANES {
                    let px = (x + lane) as f64;
                    let w = row.inverse_depth(px);
                    let seen = row.contains(px) & (w > depths[lane]);
                    depths[lane] = if seen { w } else { depths[lane] };
                    triangles[lane] = if seen { piece.triangle } else { triangles[lane] };
                }
            }
        }
    }
}
