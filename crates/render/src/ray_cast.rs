//! The slow twin: one ray a pixel.

use mb_image::{DepthImage, Image};
use mb_mesh::Bvh;
use rayon::prelude::*;

use crate::{NO_TRIANGLE, Raster, View};

/// What [`crate::Scene::render`] computes, by following the ray through each pixel centre.
pub fn ray_cast<F>(bvh: &Bvh, view: &View<F>) -> Raster {
    let frame_from_cam = view.cam_from_frame.inverse();
    let size = view.size;
    let pixels: Vec<(f32, u32)> = (0..size.pixels())
        .into_par_iter()
        .map(|i| {
            let pixel = [(i % size.width) as f64, (i / size.width) as f64];
            let ray = view.intrinsics.ray(&pixel.into(), &frame_from_cam);
            bvh.cast(&ray, f64::INFINITY).map_or((0.0, NO_TRIANGLE), |hit| (hit.t as f32, hit.triangle))
        })
        .collect();
    let (depth, triangle): (Vec<f32>, Vec<u32>) = pixels.into_iter().unzip();
    let fits = "one value a pixel";
    Raster {
        depth: DepthImage::from_data(size, depth).expect(fits),
        triangle: Image::from_data(size, triangle).expect(fits),
    }
}
