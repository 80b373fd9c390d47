//! A calibration board, printed on paper that lies under the model.

use glam::Vec3;
use mb_boards::BoardSpec;
use mb_geometry::{Board, ImageSize, Object, Rigid3};
use mb_image::Image;
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion};

use crate::stage::vec3;
use crate::texture::Finish;

/// White paper round the print.
const MARGIN_M: f64 = 0.010;
/// Finest print; large boards have fewer dots, so that their picture stays small.
const DOTS_PER_INCH: f64 = 600.0;
const MOST_DOTS: f64 = 5000.0;

/// The print, where it lies, and how it looks from further and further away.
pub(crate) struct Print {
    /// Brightness, 0 to 255; each level has half the dots of the one before.
    levels: Vec<Image<u8>>,
    /// Size of a dot of the first level.
    dot_m: f32,
    /// Top left of the paper, and its axes to the right and down (object frame).
    corner: Vec3,
    axes: (Vec3, Vec3),
    /// Width and height of the paper.
    extent_m: (f32, f32),
    pub object_from_board: Rigid3<Object, Board>,
}

impl Print {
    /// Lays the board on the table so that its middle is `middle` (object frame, y up), turned by `turn_rad`.
    pub fn new(spec: &BoardSpec, middle: &Point3<f64>, turn_rad: f64) -> Self {
        let [width, height] = spec.size_m();
        let (sin, cos) = turn_rad.sin_cos();
        // x to the right, y down the page, z into the table.
        let axes = Matrix3::new(cos, -sin, 0.0, 0.0, 0.0, -1.0, sin, cos, 0.0);
        let (right, down) = (axes.column(0).into_owned(), axes.column(1).into_owned());
        let origin = middle - right * (0.5 * width) - down * (0.5 * height);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        let dots_per_inch = DOTS_PER_INCH.min(MOST_DOTS * 0.0254 / (width.max(height) + 2.0 * MARGIN_M));
        let mut levels = vec![spec.texture(dots_per_inch, MARGIN_M)];
        while let Some(finer) = levels.last().filter(|level| level.width().min(level.height()) >= 8) {
            levels.push(halved(finer));
        }
        let as_glam = |v: nalgebra::Vector3<f64>| vec3(&Point3::from(v));
        Self {
            levels,
            dot_m: (0.0254 / dots_per_inch) as f32,
            corner: vec3(&(origin - (right + down) * MARGIN_M)),
            axes: (as_glam(right), as_glam(down)),
            extent_m: ((width + 2.0 * MARGIN_M) as f32, (height + 2.0 * MARGIN_M) as f32),
            object_from_board: Rigid3::from_parts(rotation, origin.coords),
        }
    }

    /// How far the paper reaches from the middle of the board.
    pub fn reach_m(spec: &BoardSpec) -> f32 {
        let [width, height] = spec.size_m();
        (0.5 * (width + 2.0 * MARGIN_M).hypot(height + 2.0 * MARGIN_M)) as f32
    }

    /// The paper at a place of the table; `None` beside it.
    pub fn finish(&self, place: Vec3, pixel_m: f32) -> Option<Finish> {
        let off = place - self.corner;
        let (x, y) = (off.dot(self.axes.0), off.dot(self.axes.1));
        if x < 0.0 || y < 0.0 || x > self.extent_m.0 || y > self.extent_m.1 {
            return None;
        }
        // Between the two levels whose dots are next to the size of the pixel.
        let level = (0.7 * pixel_m / self.dot_m).max(1.0).log2();
        let (lower, share) = (level as usize, level.fract());
        let at = |level: usize| {
            let level = level.min(self.levels.len() - 1);
            let dot_m = self.dot_m * (1 << level) as f32;
            bilinear(&self.levels[level], x / dot_m - 0.5, y / dot_m - 0.5)
        };
        let white = (at(lower) * (1.0 - share) + at(lower + 1) * share) / 255.0;
        // Toner is not quite black, paper not quite white.
        let albedo = Vec3::new(0.745, 0.75, 0.755) * white + Vec3::splat(0.035) * (1.0 - white);
        Some(Finish { albedo, roughness: 0.6, coat: 0.4, slope: (0.0, 0.0) })
    }
}

/// The image with half as many dots each way.
fn halved(image: &Image<u8>) -> Image<u8> {
    let size = ImageSize::new(image.width().div_ceil(2), image.height().div_ceil(2));
    Image::from_fn(size, |x, y| {
        let at = |dx: usize, dy: usize| {
            u32::from(image[((2 * x + dx).min(image.width() - 1), (2 * y + dy).min(image.height() - 1))])
        };
        ((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) / 4) as u8
    })
}

fn bilinear(image: &Image<u8>, x: f32, y: f32) -> f32 {
    let (x, y) = (x.clamp(0.0, image.width() as f32 - 1.0), y.clamp(0.0, image.height() as f32 - 1.0));
    let (i, j) = (x as usize, y as usize);
    let (right, below) = ((i + 1).min(image.width() - 1), (j + 1).min(image.height() - 1));
    let (u, v) = (x.fract(), y.fract());
    let row = |j: usize| f32::from(image[(i, j)]) * (1.0 - u) + f32::from(image[(right, j)]) * u;
    row(j) * (1.0 - v) + row(below) * v
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]
mod tests {
    use super::*;

    #[test]
    fn squares_are_black_where_the_frame_says_from_near_and_far() {
        let spec: BoardSpec = "charuco:7x5:0.030:0.022:DICT_5X5_100".parse().unwrap();
        let print = Print::new(&spec, &Point3::new(0.01, 0.0, -0.02), 0.7);
        for column in 0..7 {
            for row in 0..5 {
                // The corner of a square beside its marker, if it has one.
                let point = Point3::new(0.030 * column as f64 + 0.002, 0.030 * row as f64 + 0.002, 0.0);
                let place = vec3(&(print.object_from_board * point));
                assert!(place.y.abs() < 1e-6);
                for pixel_m in [1e-5, 2e-4, 8e-4] {
                    let albedo = print.finish(place, pixel_m).unwrap().albedo.y;
                    let dark = spec.is_black_square(column, row);
                    assert!(if dark { albedo < 0.2 } else { albedo > 0.55 }, "{column}, {row}, {pixel_m}: {albedo}");
                }
            }
        }
        let middle = vec3(&(print.object_from_board * Point3::new(0.105, 0.075, 0.0)));
        assert!((middle - Vec3::new(0.01, 0.0, -0.02)).length() < 1e-6);
        assert!(print.finish(Vec3::new(0.3, 0.0, 0.0), 1e-4).is_none());
        // Seen from above, the board is not mirrored: its z goes into the table.
        assert!(print.object_from_board.rotate(&nalgebra::Vector3::z()).y < -0.999);
    }
}
