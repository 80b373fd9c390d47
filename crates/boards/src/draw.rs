//! The board as pixels.

use mb_geometry::ImageSize;
use mb_image::Image;

use crate::BoardSpec;

/// A black rectangle of the print, metres, board frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rectangle {
    /// Left end.
    pub x_m: f64,
    /// Upper end.
    pub y_m: f64,
    /// Extent along x.
    pub width_m: f64,
    /// Extent along y.
    pub height_m: f64,
}

/// Metres to the inch, of dots per inch.
const INCH_M: f64 = 0.0254;

impl BoardSpec {
    /// What is black on the board: rectangles that touch but never overlap. All else is white.
    pub fn black_rectangles(&self) -> Vec<Rectangle> {
        let mut black = Vec::new();
        if let crate::BoardPattern::Charuco { square_m, .. } = self.pattern() {
            for row in 0..self.rows() {
                for column in (0..self.columns()).filter(|&column| self.is_black_square(column, row)) {
                    let (x_m, y_m) = (column as f64 * square_m, row as f64 * square_m);
                    black.push(Rectangle { x_m, y_m, width_m: square_m, height_m: square_m });
                }
            }
        }
        let side = self.dictionary().side();
        for marker in self.markers() {
            let module_m = marker.side_m / (side + 2) as f64;
            let is_black = |x: usize, y: usize| {
                let border = x == 0 || y == 0 || x > side || y > side;
                border || !self.dictionary().is_white(marker.id, x - 1, y - 1)
            };
            // Runs of black modules, so that a print has no seams along them.
            for y in 0..side + 2 {
                let mut x = 0;
                while x < side + 2 {
                    let end = (x..side + 2).find(|&x| !is_black(x, y)).unwrap_or(side + 2);
                    if end > x {
                        black.push(Rectangle {
                            x_m: marker.top_left_m.x + x as f64 * module_m,
                            y_m: marker.top_left_m.y + y as f64 * module_m,
                            width_m: (end - x) as f64 * module_m,
                            height_m: module_m,
                        });
                    }
                    x = end + 1;
                }
            }
        }
        black
    }

    /// Size of [`BoardSpec::texture`]: whole pixels, enough for all of the board and its margins.
    pub fn texture_size(&self, dots_per_inch: f64, margin_m: f64) -> ImageSize {
        let [width, height] =
            self.size_m().map(|m| (snap((m + 2.0 * margin_m) * dots_per_inch / INCH_M).ceil() as usize).max(1));
        ImageSize::new(width, height)
    }

    /// The board with a white margin around it, 0 black to 255 white; a pixel holds the share of white in its square.
    ///
    /// The point (x, y) of the board lies at pixel `((x + margin_m) * s - 0.5, (y + margin_m) * s - 0.5)` with
    /// `s = dots_per_inch / 0.0254`, pixel centres at integers.
    pub fn texture(&self, dots_per_inch: f64, margin_m: f64) -> Image<u8> {
        let scale = dots_per_inch / INCH_M;
        self.draw(self.texture_size(dots_per_inch, margin_m), scale, [margin_m * scale; 2])
    }

    /// The board as OpenCV's `generateImage` lays it out: as large as fits between margins of `margin_px`, centred.
    pub fn image(&self, size: ImageSize, margin_px: usize) -> Image<u8> {
        let [width_m, height_m] = self.size_m();
        let room = [size.width, size.height].map(|all| all.saturating_sub(2 * margin_px) as f64);
        let scale = (room[0] / width_m).min(room[1] / height_m);
        let origin = [(size.width as f64 - width_m * scale) * 0.5, (size.height as f64 - height_m * scale) * 0.5];
        self.draw(size, scale, origin)
    }

    /// `origin_px`: the board's origin from the top left of the image, in pixels.
    fn draw(&self, size: ImageSize, px_per_m: f64, origin_px: [f64; 2]) -> Image<u8> {
        let mut black = Image::filled(size, 0.0f32);
        for rectangle in self.black_rectangles() {
            let columns = shares(origin_px[0] + rectangle.x_m * px_per_m, rectangle.width_m * px_per_m, size.width);
            let rows = shares(origin_px[1] + rectangle.y_m * px_per_m, rectangle.height_m * px_per_m, size.height);
            for &(y, share_y) in &rows {
                for &(x, share_x) in &columns {
                    black[(x, y)] += share_x * share_y;
                }
            }
        }
        black.map(|share| ((1.0 - share) * 255.0).round().clamp(0.0, 255.0) as u8)
    }
}

/// Lengths in metres times a scale are whole numbers of pixels only up to rounding.
fn snap(pixels: f64) -> f64 {
    if (pixels - pixels.round()).abs() < 1e-6 { pixels.round() } else { pixels }
}

/// The pixels of a row of `count` that the interval from `start` covers, and how much of each.
fn shares(start: f64, length: f64, count: usize) -> Vec<(usize, f32)> {
    let (start, end) = (snap(start).clamp(0.0, count as f64), snap(start + length).clamp(0.0, count as f64));
    (start.floor() as usize..end.ceil() as usize)
        .map(|i| (i, (end.min(i as f64 + 1.0) - start.max(i as f64)) as f32))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn board(text: &str) -> BoardSpec {
        text.parse().expect("a board")
    }

    #[test]
    fn one_marker_module_by_module() {
        let image = board("grid:1x1:0.06:0.01:DICT_4X4_50").image(ImageSize::new(8, 8), 1);
        let drawn: Vec<String> = (0..8)
            .map(|y| {
                image
                    .row(y)
                    .iter()
                    .map(|v| {
                        if *v == 255 {
                            '.'
                        } else if *v == 0 {
                            '#'
                        } else {
                            '?'
                        }
                    })
                    .collect()
            })
            .collect();
        assert_eq!(
            drawn,
            ["........", ".######.", ".#.#..#.", ".##.#.#.", ".###..#.", ".###.##.", ".######.", "........"]
        );
    }

    #[test]
    fn squares_and_markers_of_a_board() {
        // 12 pixels a square, a marker of 6 pixels: one pixel a module.
        let image = board("charuco:2x2:0.12:0.06:DICT_4X4_50").image(ImageSize::new(30, 30), 3);
        assert_eq!((image[(3, 3)], image[(14, 14)], image[(15, 3)], image[(2, 3)]), (0, 0, 255, 255));
        assert_eq!((image[(17, 6)], image[(18, 6)], image[(23, 11)], image[(24, 12)]), (255, 0, 0, 255));
        let legacy = board("charuco:2x2:0.12:0.06:DICT_4X4_50:legacy").image(ImageSize::new(30, 30), 3);
        assert_eq!((legacy[(3, 3)], legacy[(15, 3)], legacy[(6, 6)]), (255, 0, 0));
    }

    proptest! {
        /// Wherever pixels fall, they hold all the black there is.
        #[test]
        fn black_is_neither_lost_nor_gained(dpi in 20.0..200.0f64, margin_m in 0.0..0.02f64) {
            let board = board("charuco:5x7:0.04:0.03:DICT_6X6_250");
            let texture = board.texture(dpi, margin_m);
            let scale = dpi / INCH_M;
            let drawn: f64 = texture.data().iter().map(|v| 1.0 - f64::from(*v) / 255.0).sum();
            let exact: f64 = board.black_rectangles().iter().map(|r| r.width_m * r.height_m).sum::<f64>() * scale * scale;
            prop_assert!((drawn / exact - 1.0).abs() < 2e-3, "{drawn} of {exact}");
        }
    }

    #[test]
    fn the_texture_has_corners_where_it_says() {
        let board = board("charuco:5x7:0.04:0.02:DICT_6X6_250");
        let (dpi, margin_m) = (96.0, 0.01);
        let texture = board.texture(dpi, margin_m);
        let scale = dpi / INCH_M;
        // Around an inner corner the four pixels are black on one diagonal and white on the other.
        for corner in board.corners() {
            let [x, y] = [corner.x, corner.y].map(|v| (v + margin_m) * scale - 0.5);
            let at = |dx: f64, dy: f64| texture[((x + dx).round() as usize, (y + dy).round() as usize)];
            let (a, b, c, d) = (at(-2.0, -2.0), at(2.0, 2.0), at(2.0, -2.0), at(-2.0, 2.0));
            assert!(a == b && c == d && a.abs_diff(c) == 255, "{corner}");
        }
    }
}
