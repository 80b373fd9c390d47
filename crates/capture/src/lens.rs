//! Lenses that are no pinholes, and photographs without their distortion.

use mb_geometry::{ImageSize, Intrinsics};
use mb_image::{Image, Mask, RgbImage};
use nalgebra::{Point2, Vector2};

/// How a lens moves a point of the plane at depth 1 before the intrinsics apply (conventions of OpenCV and COLMAP).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Distortion {
    /// A pinhole.
    None,
    /// Brown and Conrady's model with OpenCV's rational radial factor
    /// `(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)` and tangential `p1, p2`.
    Radial {
        /// `k1 .. k6`.
        k: [f64; 6],
        /// `p1, p2`.
        p: [f64; 2],
    },
    /// Equidistant fisheye: the radius becomes `theta (1 + k1 theta^2 + .. + k4 theta^8)`, theta the angle to the axis,
    /// then tangential `p1, p2` and thin-prism `s1, s2` terms of COLMAP's `THIN_PRISM_FISHEYE`.
    Fisheye {
        /// `k1 .. k4`.
        k: [f64; 4],
        /// `p1, p2`.
        p: [f64; 2],
        /// `sx1, sy1`.
        s: [f64; 2],
    },
    /// Fisheye of COLMAP's `RAD_TAN_THIN_PRISM_FISHEYE` (Project Aria): six radial terms on the angle, then tangential and
    /// thin-prism terms on the result.
    RadTanThinPrism {
        /// `k0 .. k5`.
        k: [f64; 6],
        /// `p0, p1`.
        p: [f64; 2],
        /// `s0 .. s3`.
        s: [f64; 4],
    },
    /// Devernay and Faugeras' one-parameter field-of-view model.
    FieldOfView {
        /// The model's angle, radians.
        omega: f64,
    },
    /// Fitzgibbon's division model: the undistorted point is the distorted one over `1 + k r^2`.
    Division {
        /// `k`.
        k: f64,
    },
    /// Khomutenko, Garcia and Martinet's enhanced unified model.
    EnhancedUnified {
        /// Share of the sphere, 0 to 1.
        alpha: f64,
        /// Weight of the radius, above 0.
        beta: f64,
    },
    /// A panorama: x is the azimuth, y the angle below the horizon. Only what lies in front can become a pinhole's image.
    Equirectangular,
}

impl Distortion {
    /// Whether nothing moves.
    pub fn is_none(&self) -> bool {
        match *self {
            Self::None => true,
            Self::Radial { k, p } => k == [0.0; 6] && p == [0.0; 2],
            Self::Fisheye { .. } | Self::RadTanThinPrism { .. } | Self::Equirectangular => false,
            Self::FieldOfView { omega } => omega == 0.0,
            Self::Division { k } => k == 0.0,
            Self::EnhancedUnified { alpha, .. } => alpha == 0.0,
        }
    }

    /// Where the lens puts a point of the plane at depth 1; NaN where its model has no image of it.
    pub fn distort(&self, p_in_plane: &Point2<f64>) -> Point2<f64> {
        let (x, y) = (p_in_plane.x, p_in_plane.y);
        let r_sq = x * x + y * y;
        match *self {
            Self::None => *p_in_plane,
            Self::Radial { k, p } => {
                let factor = (1.0 + r_sq * (k[0] + r_sq * (k[1] + r_sq * k[2])))
                    / (1.0 + r_sq * (k[3] + r_sq * (k[4] + r_sq * k[5])));
                Point2::new(
                    x * factor + 2.0 * p[0] * x * y + p[1] * (r_sq + 2.0 * x * x),
                    y * factor + p[0] * (r_sq + 2.0 * y * y) + 2.0 * p[1] * x * y,
                )
            }
            Self::Fisheye { k, p, s } => {
                let (u, v) = fisheye(x, y);
                let t_sq = u * u + v * v;
                let radial = t_sq * (k[0] + t_sq * (k[1] + t_sq * (k[2] + t_sq * k[3])));
                Point2::new(
                    u + u * radial + 2.0 * p[0] * u * v + p[1] * (t_sq + 2.0 * u * u) + s[0] * t_sq,
                    v + v * radial + 2.0 * p[1] * u * v + p[0] * (t_sq + 2.0 * v * v) + s[1] * t_sq,
                )
            }
            Self::FieldOfView { omega } => {
                let r = r_sq.sqrt();
                if r < 1e-12 || omega.abs() < 1e-12 {
                    return *p_in_plane;
                }
                let scale = (2.0 * r * (omega / 2.0).tan()).atan() / (omega * r);
                Point2::new(x * scale, y * scale)
            }
            Self::RadTanThinPrism { k, p, s } => {
                let (u, v) = fisheye(x, y);
                let t_sq = u * u + v * v;
                let factor = 1.0 + k.iter().rev().fold(0.0, |sum, k| t_sq * (k + sum));
                let (x, y) = (u * factor, v * factor);
                let r_sq = x * x + y * y;
                Point2::new(
                    x + 2.0 * p[1] * x * y + p[0] * (r_sq + 2.0 * x * x) + r_sq * (s[0] + s[1] * r_sq),
                    y + 2.0 * p[0] * x * y + p[1] * (r_sq + 2.0 * y * y) + r_sq * (s[2] + s[3] * r_sq),
                )
            }
            Self::Division { k } => {
                // The smaller root of k r^2 rho - r + rho = 0.
                let scale = 2.0 / (1.0 + (1.0 - 4.0 * r_sq * k).sqrt());
                Point2::new(x * scale, y * scale)
            }
            Self::EnhancedUnified { alpha, beta } => {
                let scale = 1.0 / (alpha * (beta * r_sq + 1.0).sqrt() + 1.0 - alpha);
                Point2::new(x * scale, y * scale)
            }
            Self::Equirectangular => Point2::new(x.atan(), (y / (x * x + 1.0).sqrt()).atan()),
        }
    }

    /// Whether the lens still moves points outwards here: polynomials fold back beyond the image they were fitted to.
    fn is_outward(&self, p_in_plane: &Point2<f64>) -> bool {
        let here = self.distort(p_in_plane).coords;
        let further = self.distort(&Point2::from(p_in_plane.coords * 1.001)).coords;
        (further - here).dot(&p_in_plane.coords) >= 0.0 && here.dot(&p_in_plane.coords) >= 0.0
    }
}

/// The point at the same azimuth whose radius is the angle to the axis.
fn fisheye(x: f64, y: f64) -> (f64, f64) {
    let r = x.hypot(y);
    let scale = if r > 1e-12 { r.atan() / r } else { 1.0 };
    (x * scale, y * scale)
}

/// A photograph's camera as a source states it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Focal lengths and principal point, pixel centres at integers.
    pub intrinsics: Intrinsics,
    /// What the lens does on top.
    pub distortion: Distortion,
}

impl Lens {
    /// The photograph that a pinhole with the same intrinsics and size would have taken, and where it has content: the
    /// pixels whose ray the lens saw. Elsewhere it is black.
    ///
    /// Bicubic (Catmull-Rom) interpolation.
    pub fn undistort(&self, photo: &RgbImage) -> (RgbImage, Mask) {
        let size = photo.size();
        let mut image = RgbImage::filled(size, [0; 3]);
        let mut valid = Mask::filled(size, false);
        for y in 0..size.height {
            for x in 0..size.width {
                if let Some(source) = self.source_of(x, y, size) {
                    image[(x, y)] = bicubic(photo, source.x, source.y);
                    valid[(x, y)] = true;
                }
            }
        }
        (image, valid)
    }

    /// The mask of [`Self::undistort`]'s photograph, from that of the photograph as it was taken; false where the lens did
    /// not see. Nearest pixel.
    pub fn undistort_mask(&self, mask: &Mask) -> Mask {
        let size = mask.size();
        Mask::from_fn(size, |x, y| {
            let nearest = |p: Vector2<f64>| (p.x.round().max(0.0) as usize, p.y.round().max(0.0) as usize);
            self.source_of(x, y, size).map(nearest).and_then(|(u, v)| mask.get(u, v).copied()).unwrap_or(false)
        })
    }

    /// Where the photograph shows what belongs at this pixel of the undistorted one; `None` where the lens did not see it.
    fn source_of(&self, x: usize, y: usize, size: ImageSize) -> Option<Vector2<f64>> {
        let k = self.intrinsics;
        let ray = Point2::new((x as f64 - k.cx) / k.fx, (y as f64 - k.cy) / k.fy);
        let bent = self.distortion.distort(&ray);
        let source = Vector2::new(bent.x * k.fx + k.cx, bent.y * k.fy + k.cy);
        (self.distortion.is_outward(&ray) && inside(&source, size)).then_some(source)
    }
}

fn inside(p: &Vector2<f64>, size: ImageSize) -> bool {
    p.x >= -0.5 && p.y >= -0.5 && p.x <= size.width as f64 - 0.5 && p.y <= size.height as f64 - 0.5
}

fn bicubic(photo: &Image<[u8; 3]>, x: f64, y: f64) -> [u8; 3] {
    let (x0, y0) = (x.floor(), y.floor());
    let weights = |t: f64| {
        let (t2, t3) = (t * t, t * t * t);
        [-0.5 * t + t2 - 0.5 * t3, 1.0 - 2.5 * t2 + 1.5 * t3, 0.5 * t + 2.0 * t2 - 1.5 * t3, -0.5 * t2 + 0.5 * t3]
    };
    let (wx, wy) = (weights(x - x0), weights(y - y0));
    let clamp = |i: f64, n: usize| i.clamp(0.0, n as f64 - 1.0) as usize;
    let mut sum = [0.0; 3];
    for (j, wy) in wy.iter().enumerate() {
        let row = photo.row(clamp(y0 + j as f64 - 1.0, photo.height()));
        for (i, wx) in wx.iter().enumerate() {
            let pixel = row[clamp(x0 + i as f64 - 1.0, photo.width())];
            for c in 0..3 {
                sum[c] += wx * wy * f64::from(pixel[c]);
            }
        }
    }
    sum.map(|v| v.round().clamp(0.0, 255.0) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics = Intrinsics { fx: 100.0, fy: 100.0, cx: 79.5, cy: 59.5 };

    #[test]
    fn published_forms_in_numbers() {
        let p = Point2::new(0.3, -0.2);
        // r^2 = 0.13; k1 = 0.1: factor 1.013; p1 = 0.01: dx = 2 p1 x y, dy = p1 (r^2 + 2 y^2).
        let radial = Distortion::Radial { k: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.01, 0.0] };
        let expected = Point2::new(0.3 * 1.013 - 0.0012, -0.2 * 1.013 + 0.01 * (0.13 + 0.08));
        assert!((radial.distort(&p) - expected).norm() < 1e-15);
        // A fisheye without coefficients maps the angle itself.
        let fisheye = Distortion::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
        assert!((fisheye.distort(&Point2::new(1.0, 0.0)).x - std::f64::consts::FRAC_PI_4).abs() < 1e-15);
        // The field-of-view model leaves the radius where the angle is `omega`: 2 r tan(omega / 2) = tan(r omega).
        let fov = Distortion::FieldOfView { omega: 0.9 };
        let r = 0.2;
        let bent = fov.distort(&Point2::new(r, 0.0)).x;
        assert!((2.0 * r * 0.45f64.tan() - (bent * 0.9).tan()).abs() < 1e-12);
    }

    #[test]
    fn a_pinhole_keeps_every_pixel() {
        let photo = RgbImage::from_fn(ImageSize::new(160, 120), |x, y| [x as u8, y as u8, (x * y) as u8]);
        let (image, valid) = Lens { intrinsics: K, distortion: Distortion::None }.undistort(&photo);
        assert_eq!(image, photo);
        assert!(valid.data().iter().all(|v| *v));
    }

    #[test]
    fn a_line_bent_by_the_lens_comes_out_straight() {
        let distortion = Distortion::Radial { k: [-0.25, 0.05, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        // What the lens sees of a bright line x = 0.35: draw it at the places that the lens puts its points.
        let mut photo = RgbImage::filled(ImageSize::new(160, 120), [0; 3]);
        for i in 0..6000 {
            let bent = distortion.distort(&Point2::new(0.35, -0.7 + 1.4 * f64::from(i) / 6000.0));
            let (x, y) = (bent.x * K.fx + K.cx, bent.y * K.fy + K.cy);
            for (px, weight) in [(x.floor(), 1.0 - x.fract()), (x.floor() + 1.0, x.fract())] {
                if let Some(pixel) = photo.get(px as usize, y.round() as usize).copied() {
                    let value = pixel[0].max((255.0 * weight) as u8);
                    photo[(px as usize, y.round() as usize)] = [value; 3];
                }
            }
        }
        let (image, valid) = Lens { intrinsics: K, distortion }.undistort(&photo);
        for y in (5..115).step_by(10) {
            let row = image.row(y);
            let mass: f64 = row.iter().map(|p| f64::from(p[0])).sum();
            let middle: f64 = row.iter().enumerate().map(|(x, p)| x as f64 * f64::from(p[0])).sum::<f64>() / mass;
            assert!((middle - (0.35 * K.fx + K.cx)).abs() < 0.35, "row {y}: {middle}");
        }
        assert!(valid[(80, 60)]);
        // Barrel distortion squeezes a wider view into the photograph, so the pinhole sees no border.
        assert!(valid.data().iter().all(|v| *v));
        let pincushion = Distortion::Radial { k: [0.3, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        let (_, valid) = Lens { intrinsics: K, distortion: pincushion }.undistort(&photo);
        assert!(!valid[(0, 0)] && valid[(80, 60)]);
    }
}
