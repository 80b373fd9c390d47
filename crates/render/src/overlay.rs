//! A model's edges drawn over a photograph.

use mb_geometry::ImageSize;
use mb_image::{Image, RgbImage};
use mb_mesh::TriangleMesh;
use rayon::prelude::*;

use crate::{NO_TRIANGLE, Scene, View};

/// Samples along each side of a pixel.
const SAMPLES: usize = 2;
/// Neighbouring surfaces that meet at a sharper angle show an edge: cosine of 30 degrees.
const CREASE_COS: f64 = 0.866;

/// Draws the visible silhouettes, creases and borders between parts of `mesh` over `photo`, in the 8-bit sRGB `color`:
/// where they lie beside the edges in the photograph, the pose is wrong. Lines are about a pixel and a half wide.
///
/// # Panics
/// Where the photograph has another size than the view.
pub fn overlay_edges<F>(photo: &RgbImage, mesh: &TriangleMesh, view: &View<F>, color: [u8; 3]) -> RgbImage {
    assert_eq!(photo.size(), view.size, "the view must have the photograph's size");
    let size = view.size;
    let fine = ImageSize::new(size.width * SAMPLES, size.height * SAMPLES);
    let fine_view =
        View::<F> { intrinsics: view.intrinsics.resized(size, fine), size: fine, cam_from_frame: view.cam_from_frame };
    let raster = Scene::new(mesh).render(&fine_view);
    let normals: Vec<_> = (0..mesh.triangles.len())
        .into_par_iter()
        .map(|t| mesh.scaled_normal(t).try_normalize(0.0).unwrap_or_default())
        .collect();
    let part = |t: u32| mesh.triangle_parts.as_ref().map(|parts| parts[t as usize]);
    let differ = |a: (usize, usize), b: (usize, usize)| {
        let (ta, tb) = (raster.triangle[a], raster.triangle[b]);
        if ta == tb {
            return false;
        }
        if ta == NO_TRIANGLE || tb == NO_TRIANGLE || part(ta) != part(tb) {
            return true;
        }
        normals[ta as usize].dot(&normals[tb as usize]).abs() < CREASE_COS || jumps(&raster.depth, a, b)
    };
    let edges: Vec<bool> = (0..fine.pixels())
        .into_par_iter()
        .map(|i| {
            let (x, y) = (i % fine.width, i / fine.width);
            (x + 1 < fine.width && differ((x, y), (x + 1, y))) || (y + 1 < fine.height && differ((x, y), (x, y + 1)))
        })
        .collect();
    let data = (0..size.pixels())
        .into_par_iter()
        .map(|i| {
            let (x, y) = (i % size.width * SAMPLES, i / size.width * SAMPLES);
            // The samples of the pixel and those around it: a soft line.
            let (mut hits, mut all) = (0.0f32, 0.0f32);
            for sy in y.saturating_sub(1)..(y + SAMPLES + 1).min(fine.height) {
                for sx in x.saturating_sub(1)..(x + SAMPLES + 1).min(fine.width) {
                    let own = (x..x + SAMPLES).contains(&sx) && (y..y + SAMPLES).contains(&sy);
                    let weight = if own { 1.0 } else { 0.5 };
                    all += weight;
                    hits += if edges[sy * fine.width + sx] { weight } else { 0.0 };
                }
            }
            let alpha = (2.0 * hits / all).min(1.0);
            let under = photo.data()[i];
            std::array::from_fn(|c| {
                (f32::from(under[c]) + (f32::from(color[c]) - f32::from(under[c])) * alpha).round() as u8
            })
        })
        .collect();
    Image::from_data(size, data).expect("one value a pixel")
}

/// Whether two neighbouring pixels see surfaces one behind the other: a jump of more than 1 % of the depth.
fn jumps(depth: &mb_image::DepthImage, a: (usize, usize), b: (usize, usize)) -> bool {
    let (a, b) = (depth[a], depth[b]);
    (a - b).abs() > 0.01 * a.min(b)
}
