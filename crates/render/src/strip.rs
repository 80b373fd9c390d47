//! A few rows of the image while triangles are drawn into them.

use wide::f64x4;

use crate::NO_TRIANGLE;
use crate::setup::Setup;

/// Rows of a strip: few enough to stay in the processor's cache.
pub(crate) const STRIP: usize = 32;
/// Pixels that are tested together.
const LANES: usize = 4;
/// Rows wider than this are narrowed to the triangle first.
const WIDE: usize = 16;
/// Larger rectangles are not searched for a pixel that would see the triangle.
const GLANCE: usize = 64;

/// A triangle, and the first and last column and row that may see it.
#[derive(Clone, Copy)]
pub(crate) struct Piece {
    pub(crate) triangle: u32,
    /// No point of the triangle has a larger inverse depth. It is here so that a hidden triangle's corners, which lie
    /// anywhere in memory, are not fetched again.
    pub(crate) nearest: f32,
    pub(crate) x: (u16, u16),
    pub(crate) y: (u16, u16),
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
    triangle: Vec<u32>,
}

impl Strip {
    pub(crate) fn new(width: usize) -> Self {
        let stride = width + LANES;
        Self {
            width,
            stride,
            first_y: 0,
            rows: STRIP,
            touched: (width, 0),
            inverse_depth: vec![0.0; stride * STRIP],
            triangle: vec![NO_TRIANGLE; stride * STRIP],
        }
    }

    /// Forgets what was drawn; the strip's first row is now `first_y` of `height`.
    pub(crate) fn begin(&mut self, first_y: usize, height: usize) {
        if self.touched.0 < self.touched.1 {
            self.inverse_depth.fill(0.0);
            self.triangle.fill(NO_TRIANGLE);
        }
        self.first_y = first_y;
        self.rows = STRIP.min(height - first_y);
        self.touched = (self.width, 0);
    }

    /// The strip's rows of a piece, (first, last), counted from the strip's own first.
    #[inline]
    fn rows_of(&self, piece: &Piece) -> (usize, usize) {
        let first = usize::from(piece.y.0).max(self.first_y) - self.first_y;
        (first, (usize::from(piece.y.1) - self.first_y).min(self.rows - 1))
    }

    /// Whether a glance shows that what was drawn hides all of a small piece.
    #[inline]
    pub(crate) fn hides(&self, piece: &Piece) -> bool {
        let (first, last) = self.rows_of(piece);
        let columns = usize::from(piece.x.0)..usize::from(piece.x.1) + 1;
        if columns.len() * (last + 1 - first) > GLANCE {
            return false;
        }
        let nearest = f64::from(piece.nearest);
        (first..=last).all(|row| {
            let start = row * self.stride;
            self.inverse_depth[start + columns.start..start + columns.end].iter().all(|&w| w >= nearest)
        })
    }

    /// Draws a triangle where it is nearer than what was drawn before.
    #[inline]
    pub(crate) fn draw(&mut self, piece: &Piece, setup: &Setup) {
        let columns = (usize::from(piece.x.0), usize::from(piece.x.1));
        self.touched = (self.touched.0.min(columns.0), self.touched.1.max(columns.1 + 1));
        let (first, last) = self.rows_of(piece);
        for row_index in first..=last {
            let row = setup.row((self.first_y + row_index) as f64);
            let (first_x, last_x) =
                if columns.1 - columns.0 < WIDE { columns } else { setup.narrow(&row, columns.0, columns.1) };
            let start = row_index * self.stride;
            for x in (first_x..=last_x).step_by(LANES) {
                let px = f64x4::splat(x as f64) + f64x4::new([0.0, 1.0, 2.0, 3.0]);
                let inside = setup.contains(&row, px);
                if !inside.any() {
                    continue;
                }
                let range = start + x..start + x + LANES;
                let depths: &mut [f64; LANES] =
                    (&mut self.inverse_depth[range.clone()]).try_into().expect("a range of that length");
                let before = f64x4::new(*depths);
                let w = setup.inverse_depth(&row, px);
                let seen = inside & w.simd_gt(before);
                *depths = seen.bitselect(w, before).to_array();
                let mut lanes = seen.to_bitmask();
                while lanes != 0 {
                    self.triangle[range.start + lanes.trailing_zeros() as usize] = piece.triangle;
                    lanes &= lanes - 1;
                }
            }
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
