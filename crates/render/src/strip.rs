//! A few rows of the image while triangles are drawn into them.

use std::ops::Range;

use wide::f64x4;

use crate::NO_TRIANGLE;
use crate::cluster::{CLUSTER, Placed};
use crate::setup::{Columns, Setup};

/// Rows of a strip: few enough to stay in the processor's cache.
pub(crate) const STRIP: usize = 32;
/// Pixels that are tested together.
const LANES: usize = 4;
/// Rows wider than this are narrowed to the triangle first.
const WIDE: usize = 16;
/// Larger rectangles are not searched for a pixel that would see the triangle.
const GLANCE: usize = 64;
/// The same for the rectangle of a cluster: about what its triangles would cost.
const CLUSTER_GLANCE: usize = 8 * CLUSTER;

/// The part of a strip that may see a triangle.
pub(crate) struct Piece {
    /// First and last column.
    pub(crate) x: (usize, usize),
    /// First and last row, counted from the strip's own first.
    pub(crate) rows: (usize, usize),
}

/// For each pixel the largest inverse depth so far, and whose it is.
pub(crate) struct Strip {
    width: usize,
    /// Row length: room for a group of lanes that begins at the last pixel.
    stride: usize,
    first_y: usize,
    rows: usize,
    /// Columns that anything was drawn to (first, end).
    touched: (usize, usize),
    inverse_depth: Vec<f64>,
    /// Empty where only depth is asked for.
    triangle: Vec<u32>,
}

impl Strip {
    pub(crate) fn new(width: usize, with_triangles: bool) -> Self {
        let stride = width + LANES;
        Self {
            width,
            stride,
            first_y: 0,
            rows: STRIP,
            touched: (width, 0),
            inverse_depth: vec![0.0; stride * STRIP],
            triangle: vec![NO_TRIANGLE; if with_triangles { stride * STRIP } else { 0 }],
        }
    }

    /// Forgets what was drawn; the strip's first row is now `first_y` of `height`.
    pub(crate) fn begin(&mut self, first_y: usize, height: usize) {
        if self.touched.0 < self.touched.1 {
            // Drawing in groups of lanes wrote no further than the last column, and changed nothing there.
            let touched = |row: usize| row * self.stride + self.touched.0..row * self.stride + self.touched.1;
            for row in 0..self.rows {
                self.inverse_depth[touched(row)].fill(0.0);
                if let Some(triangles) = self.triangle.get_mut(touched(row)) {
                    triangles.fill(NO_TRIANGLE);
                }
            }
        }
        self.first_y = first_y;
        self.rows = STRIP.min(height - first_y);
        self.touched = (self.width, 0);
    }

    /// Columns and rows of the image that the strip has.
    #[inline]
    pub(crate) fn pixels(&self) -> (Range<usize>, Range<usize>) {
        (0..self.width, self.first_y..self.first_y + self.rows)
    }

    /// Whether a glance shows that what was drawn hides all of a cluster.
    pub(crate) fn hides_cluster(&self, cluster: &Placed) -> bool {
        let first = cluster.y.0.max(self.first_y) - self.first_y;
        let last = (cluster.y.1 - self.first_y).min(self.rows - 1);
        self.all_nearer(&Piece { x: cluster.x, rows: (first, last) }, cluster.nearest(), CLUSTER_GLANCE)
    }

    /// Whether a glance shows that what was drawn hides all of a small piece, no point of which has a larger inverse
    /// depth than `nearest`.
    #[inline]
    pub(crate) fn hides(&self, piece: &Piece, nearest: f64) -> bool {
        self.all_nearer(piece, nearest, GLANCE)
    }

    /// Whether a piece of at most `most` pixels was drawn nearer than an inverse depth everywhere.
    #[inline]
    fn all_nearer(&self, piece: &Piece, inverse_depth: f64, most: usize) -> bool {
        let (columns, (first, last)) = (piece.x.0..piece.x.1 + 1, piece.rows);
        columns.len() * (last + 1 - first) <= most
            && (first..=last).all(|row| {
                let start = row * self.stride;
                self.inverse_depth[start + columns.start..start + columns.end].iter().all(|&w| w >= inverse_depth)
            })
    }

    /// Draws a triangle where it is nearer than what was drawn before.
    #[inline(always)]
    pub(crate) fn draw(&mut self, piece: &Piece, index: u32, setup: &Setup) {
        let (first, last) = piece.x;
        self.touched = (self.touched.0.min(first), self.touched.1.max(last + 1));
        let rows = piece.rows.0..=piece.rows.1;
        if last - first < WIDE {
            for x in (first..=last).step_by(LANES) {
                let columns = setup.columns(x as f64);
                for row in rows.clone() {
                    self.draw_lanes(row, x, index, setup, &columns);
                }
            }
        } else {
            for row in rows {
                let (first, last) = setup.narrow((self.first_y + row) as f64, first, last);
                for x in (first..=last).step_by(LANES) {
                    self.draw_lanes(row, x, index, setup, &setup.columns(x as f64));
                }
            }
        }
    }

    /// Draws a triangle into a group of pixels that begins at column `x`.
    #[inline(always)]
    fn draw_lanes(&mut self, row: usize, x: usize, index: u32, setup: &Setup, columns: &Columns) {
        let functions = setup.row((self.first_y + row) as f64);
        let inside = setup.contains(columns, &functions);
        if !inside.any() {
            return;
        }
        let start = row * self.stride + x;
        let depths: &mut [f64; LANES] =
            (&mut self.inverse_depth[start..start + LANES]).try_into().expect("a range of that length");
        let before = f64x4::new(*depths);
        let w = setup.inverse_depth(columns, &functions);
        let seen = inside & w.simd_gt(before);
        *depths = seen.bitselect(w, before).to_array();
        if self.triangle.is_empty() {
            return;
        }
        let mut lanes = seen.to_bitmask();
        while lanes != 0 {
            self.triangle[start + lanes.trailing_zeros() as usize] = index;
            lanes &= lanes - 1;
        }
    }

    /// Writes depths into the strip's rows of an image that is 0 everywhere.
    pub(crate) fn write_depth(&self, depth: &mut [f32]) {
        let (first, end) = self.touched;
        if first >= end {
            return;
        }
        for (row, depth) in depth.chunks_mut(self.width).enumerate() {
            let start = row * self.stride;
            for (depth, &w) in depth[first..end].iter_mut().zip(&self.inverse_depth[start + first..start + end]) {
                *depth = if w > 0.0 { (1.0 / w) as f32 } else { 0.0 };
            }
        }
    }

    /// Writes triangle indices into the strip's rows of an image.
    pub(crate) fn write_triangles(&self, triangles: &mut [u32]) {
        for (row, triangles) in triangles.chunks_mut(self.width).enumerate() {
            let start = row * self.stride;
            triangles.copy_from_slice(&self.triangle[start..start + triangles.len()]);
        }
    }
}
