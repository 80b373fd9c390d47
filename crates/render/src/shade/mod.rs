//! Pictures for people: a mesh under an overcast sky with a soft sun.

mod colormap;
mod light;

use mb_geometry::{Aabb, Camera, ImageSize, Intrinsics, Rigid3};
use mb_image::{Image, RgbImage};
use mb_mesh::TriangleMesh;
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use crate::{NO_TRIANGLE, Scene, View};
use light::Sky;

pub use colormap::heat_colors;

/// How [`shade`] makes a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShadeOptions {
    /// The direction that is up, in the mesh's frame; need not be of unit length.
    pub up: Vector3<f64>,
    /// Samples along each side of a pixel, at least 1.
    pub samples: usize,
    /// Whether a shadow falls on a plane that carries the mesh's lowest point.
    pub ground: bool,
    /// Blend normals across vertices: right for scans and heat maps, wrong for bricks with shared vertices.
    pub smooth: bool,
    /// 8-bit sRGB of a mesh without colours.
    pub color: [u8; 3],
}

impl Default for ShadeOptions {
    fn default() -> Self {
        Self { up: Vector3::y(), samples: 3, ground: true, smooth: false, color: [196, 196, 200] }
    }
}

/// A picture: 8-bit sRGB and opacity, not multiplied with each other.
pub type RgbaImage = Image<[u8; 4]>;

/// The picture over a plain background.
pub fn over(picture: &RgbaImage, background: [u8; 3]) -> RgbImage {
    picture.map(|&[r, g, b, a]| {
        let alpha = f32::from(a) / 255.0;
        let mix = |over: u8, under: u8| (f32::from(over) * alpha + f32::from(under) * (1.0 - alpha)).round() as u8;
        [mix(r, background[0]), mix(g, background[1]), mix(b, background[2])]
    })
}

/// A camera that sees all of `bounds` from above one corner, as product photographs do: `azimuth_rad` turns it around
/// the vertical (0 looks along -z where y is up; 0.6 is a good angle), `elevation_rad` lifts it (0.45 is a good one).
///
/// An empty box is seen from a metre away.
pub fn three_quarter_view<F>(
    bounds: &Aabb,
    up: &Vector3<f64>,
    size: ImageSize,
    azimuth_rad: f64,
    elevation_rad: f64,
) -> View<F> {
    const HALF_FIELD_RAD: f64 = 0.22;
    const MARGIN: f64 = 1.12;
    let up = up.try_normalize(0.0).unwrap_or(Vector3::y());
    let right = if up.x.abs() < 0.9 { Vector3::x() } else { Vector3::z() };
    let front = right.cross(&up).normalize();
    let right = up.cross(&front);
    let outward =
        (front * azimuth_rad.cos() + right * azimuth_rad.sin()) * elevation_rad.cos() + up * elevation_rad.sin();
    let focal = 0.5 * size.width.min(size.height) as f64 / HALF_FIELD_RAD.tan();
    let intrinsics =
        Intrinsics { fx: focal, fy: focal, cx: 0.5 * (size.width as f64 - 1.0), cy: 0.5 * (size.height as f64 - 1.0) };
    let (middle, corners) =
        if bounds.is_empty() { (Point3::origin(), [Point3::origin(); 8]) } else { (bounds.center(), bounds.corners()) };
    let rotation = looking(&-outward, &up);
    // Far enough for every corner to fall inside, with a margin.
    let distance = corners
        .iter()
        .map(|corner| {
            let p = rotation * (corner - middle);
            let across =
                (p.x.abs() * focal * 2.0 / size.width as f64).max(p.y.abs() * focal * 2.0 / size.height as f64);
            across * MARGIN - p.z
        })
        .fold(0.0, f64::max);
    let distance = if distance > 0.0 { distance } else { 1.0 };
    let translation = -(rotation * (middle + outward * distance).coords);
    View { intrinsics, size, cam_from_frame: Rigid3::from_parts(rotation, translation) }
}

/// The rotation into a camera that looks along `forward`, its y axis as far down as it can be.
pub(crate) fn looking(forward: &Vector3<f64>, up: &Vector3<f64>) -> UnitQuaternion<f64> {
    let z = forward.normalize();
    let aside = if z.cross(up).norm() > 1e-6 { *up } else { Vector3::new(up.y, up.z, up.x) };
    let x = z.cross(&aside).normalize();
    let y = z.cross(&x);
    let rows = Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows))
}

/// Draws the mesh: its own colours (per triangle, else per vertex, else `options.color`) in soft daylight with
/// shadows, transparent where there is nothing.
///
/// The light is the sum of a few dozen far lamps over the sky, each with a depth map of its own, so that ambient
/// occlusion, contact shadows and the sun's soft shadow are one and the same thing.
pub fn shade<F: Sync>(mesh: &TriangleMesh, view: &View<F>, options: &ShadeOptions) -> RgbaImage {
    let samples = options.samples.max(1);
    let fine = ImageSize::new(view.size.width * samples, view.size.height * samples);
    let fine_view = View::<F> {
        intrinsics: view.intrinsics.resized(view.size, fine),
        size: fine,
        cam_from_frame: view.cam_from_frame,
    };
    let scene = Scene::new(mesh);
    let raster = scene.render(&fine_view);
    let up = options.up.try_normalize(0.0).unwrap_or(Vector3::y());
    let sky = Sky::new(&scene, &mesh.bounds(), &up, &view.cam_from_frame.inverse().rotate(&Vector3::z()));
    let normals = options.smooth.then(|| mesh.vertex_normals());
    let frame_from_cam = view.cam_from_frame.inverse();
    let lowest = mesh.vertices.iter().map(|p| p.coords.dot(&up)).fold(f64::INFINITY, f64::min);

    let pixel = |i: usize| -> [u8; 4] {
        let (x, y) = (i % view.size.width * samples, i / view.size.width * samples);
        // Linear colour times opacity, and opacity.
        let mut sum = [0.0f64; 4];
        // Light changes slowly along a surface: samples of one pixel on one surface share it.
        let mut lit: Vec<(Vector3<f64>, f32, f64)> = Vec::new();
        let mut ground_shadow = None;
        for sub in 0..samples * samples {
            let (x, y) = (x + sub % samples, y + sub / samples);
            let ray = fine_view.intrinsics.ray(&[x as f64, y as f64].into(), &frame_from_cam);
            let triangle = raster.triangle[(x, y)];
            if triangle == NO_TRIANGLE {
                if options.ground {
                    sum[3] += *ground_shadow.get_or_insert_with(|| ground(&sky, &ray, &up, lowest));
                }
                continue;
            }
            let z = raster.depth[(x, y)];
            let p = ray.at(f64::from(z));
            let surface = Surface::at(mesh, normals.as_deref(), triangle as usize, &p, options.color);
            let known = lit
                .iter()
                .find(|(normal, depth, _)| normal.dot(&surface.flat_normal) > 0.99 && (depth - z).abs() < 0.01 * z);
            let light = known.map(|(_, _, light)| *light).unwrap_or_else(|| {
                let facing = |n: Vector3<f64>| if n.dot(&ray.direction) > 0.0 { -n } else { n };
                let light = sky.light(&p, &facing(surface.flat_normal), &facing(surface.normal));
                lit.push((surface.flat_normal, z, light));
                light
            });
            for (sum, color) in sum.iter_mut().zip(surface.color) {
                *sum += color * light;
            }
            sum[3] += 1.0;
        }
        let [r, g, b, opacity] = sum;
        if opacity == 0.0 {
            return [0; 4];
        }
        let [r, g, b] = [r, g, b].map(|v| srgb_from_linear((v / opacity) as f32));
        [r, g, b, (opacity / (samples * samples) as f64 * 255.0).round() as u8]
    };
    let data = (0..view.size.pixels()).into_par_iter().map(pixel).collect();
    Image::from_data(view.size, data).expect("one value a pixel")
}

/// Opacity of the black shadow on the ground: the share of light that is missing.
fn ground(sky: &Sky, ray: &mb_geometry::Ray, up: &Vector3<f64>, lowest: f64) -> f64 {
    let towards = ray.direction.dot(up);
    let t = (lowest - ray.origin.coords.dot(up)) / towards;
    if towards < 0.0 && t > 0.0 { 0.75 * sky.shadow(&ray.at(t), up) } else { 0.0 }
}

/// What is known of a point on the mesh.
struct Surface {
    flat_normal: Vector3<f64>,
    normal: Vector3<f64>,
    /// Linear.
    color: [f64; 3],
}

impl Surface {
    fn at(
        mesh: &TriangleMesh,
        normals: Option<&[Vector3<f64>]>,
        triangle: usize,
        p: &Point3<f64>,
        plain: [u8; 3],
    ) -> Self {
        let scaled = mesh.scaled_normal(triangle);
        let flat_normal = scaled.try_normalize(0.0).unwrap_or(Vector3::y());
        let [a, b, c] = mesh.triangle(triangle);
        let area_sq = scaled.norm_squared();
        let part = |from: &Point3<f64>, to: &Point3<f64>| (from - p).cross(&(to - p)).dot(&scaled) / area_sq;
        let weights = if area_sq > 0.0 { [part(&b, &c), part(&c, &a), part(&a, &b)] } else { [1.0, 0.0, 0.0] };
        let vertices = mesh.triangles[triangle].map(|v| v as usize);
        let normal = normals.map_or(flat_normal, |normals| {
            let sum: Vector3<f64> = (0..3).map(|i| normals[vertices[i]] * weights[i]).sum();
            sum.try_normalize(0.0).unwrap_or(flat_normal)
        });
        let color = match (&mesh.triangle_colors, &mesh.vertex_colors) {
            (Some(colors), _) => colors[triangle].map(linear_from_srgb),
            (None, Some(colors)) => std::array::from_fn(|channel| {
                (0..3).map(|i| linear_from_srgb(colors[vertices[i]][channel]) * weights[i]).sum::<f64>().max(0.0)
            }),
            (None, None) => plain.map(linear_from_srgb),
        };
        Self { flat_normal, normal, color }
    }
}

/// IEC 61966-2-1.
fn linear_from_srgb(srgb: u8) -> f64 {
    let v = f64::from(srgb) / 255.0;
    if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

fn srgb_from_linear(linear: f32) -> u8 {
    let v = linear.clamp(0.0, 1.0);
    let srgb = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    (srgb * 255.0).round() as u8
}

/// Where a camera looks from, to be used by lamps: far outside of a ball, all of the ball in view.
fn outside_view<F>(middle: &Point3<f64>, radius: f64, direction: &Vector3<f64>, pixels: usize) -> View<F> {
    /// Distance in radii: nearly parallel rays.
    const FAR: f64 = 30.0;
    let rotation = looking(&-direction, &if direction.y.abs() < 0.9 { Vector3::y() } else { Vector3::x() });
    let eye = middle + direction * (radius * FAR);
    let focal = 0.5 * pixels as f64 * (FAR - 1.0);
    let centre = 0.5 * (pixels as f64 - 1.0);
    let cam_from_frame: Rigid3<Camera, F> = Rigid3::from_parts(rotation, -(rotation * eye.coords));
    View {
        intrinsics: Intrinsics { fx: focal, fy: focal, cx: centre, cy: centre },
        size: ImageSize::new(pixels, pixels),
        cam_from_frame,
    }
}
