//! The visibility volume: where the capture could have noticed that something is wrong.

use mb_capture::VisibilityVolume;
use mb_geometry::{Aabb, World};
use mb_image::DepthImage;
use mb_job::{Error, Result};
use mb_render::View;
use nalgebra::Point3;
use rayon::prelude::*;

/// A voxel up to this far behind the surface still counts as seen, metres: the surface itself must lie inside.
const BEHIND_SURFACE_M: f64 = 0.010;

/// More voxels than this are refused.
const MAX_VOXELS: f64 = 2e8;

/// A volume around `bounds_in_world` and `margin_m` more on every side, in which nothing is seen yet.
///
/// # Errors
/// The volume would be too large.
pub fn empty_volume(bounds_in_world: &Aabb, margin_m: f64, voxel_size_m: f64) -> Result<VisibilityVolume> {
    let bounds = bounds_in_world.grown(margin_m);
    let counts = bounds.extent().map(|side| (side / voxel_size_m).ceil() + 1.0);
    if counts.product() > MAX_VOXELS {
        return Err(Error::Failed(format!(
            "the visibility volume would have {:.0} million voxels of {} mm; use larger voxels",
            counts.product() / 1e6,
            voxel_size_m * 1e3
        )));
    }
    let resolutions = [counts.x as usize, counts.y as usize, counts.z as usize];
    Ok(VisibilityVolume {
        mask: vec![false; resolutions.iter().product()],
        resolutions,
        voxel_size_m,
        min_pt_in_world: bounds.min,
    })
}

/// Marks the voxels that one frame sees: those whose centre falls on a pixel without surface (free up to infinity), or
/// lies no more than 10 mm behind the surface there.
pub fn observe(volume: &mut VisibilityVolume, depth: &DepthImage, view: &View<World>) {
    let [_, ny, nz] = volume.resolutions;
    let voxel = volume.voxel_size_m;
    let origin = volume.min_pt_in_world;
    let k = view.intrinsics;
    // Homogeneous pixel coordinates are linear along a row of voxels: three additions a voxel.
    let homogeneous = |p_in_world: Point3<f64>| {
        let p = view.cam_from_frame * p_in_world;
        nalgebra::Vector3::new(k.fx * p.x + k.cx * p.z, k.fy * p.y + k.cy * p.z, p.z)
    };
    let step = homogeneous(origin + nalgebra::Vector3::z() * voxel) - homogeneous(origin);
    let (width, height) = (view.size.width as f64, view.size.height as f64);
    volume.mask.par_chunks_mut(nz).enumerate().for_each(|(row, mask)| {
        let (x, y) = (row / ny, row % ny);
        let start = homogeneous(origin + nalgebra::Vector3::new(x as f64, y as f64, 0.0) * voxel);
        for (z, seen) in mask.iter_mut().enumerate().filter(|(_, seen)| !**seen) {
            let p = start + step * z as f64;
            if p.z <= 0.0 {
                continue;
            }
            // Half a pixel to the right and down, so that truncation rounds to the nearest centre.
            let (u, v) = (p.x / p.z + 0.5, p.y / p.z + 0.5);
            if u >= 0.0 && u < width && v >= 0.0 && v < height {
                let surface = f64::from(depth[(u as usize, v as usize)]);
                *seen = surface == 0.0 || p.z < surface + BEHIND_SURFACE_M;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::{ImageSize, Intrinsics, Rigid3};

    #[test]
    fn a_wall_hides_what_lies_more_than_a_centimetre_behind_it() {
        let view = View {
            intrinsics: Intrinsics { fx: 100.0, fy: 100.0, cx: 31.5, cy: 23.5 },
            size: ImageSize::new(64, 48),
            cam_from_frame: Rigid3::<_, World>::identity(),
        };
        // The wall fills the left half of the picture.
        let depth = DepthImage::from_fn(view.size, |x, _| if x < 32 { 0.5 } else { 0.0 });
        let bounds = Aabb { min: Point3::new(-0.1, -0.05, 0.4), max: Point3::new(0.1, 0.05, 0.6) };
        let mut volume = empty_volume(&bounds, 0.02, 0.005).unwrap();
        observe(&mut volume, &depth, &view);
        for (p, expected) in [
            (Point3::new(-0.05, 0.0, 0.45), true),
            (Point3::new(-0.05, 0.0, 0.505), true),
            (Point3::new(-0.05, 0.0, 0.52), false),
            (Point3::new(0.05, 0.0, 0.59), true),
            (Point3::new(0.119, 0.069, 0.4), true),
        ] {
            assert_eq!(volume.contains(&p), expected, "at {p}");
        }
        // Nothing is seen outside the picture: at 0.4 m it ends 0.128 m right of the axis.
        let narrow = View { size: ImageSize::new(40, 48), ..view };
        let mut volume = empty_volume(&bounds, 0.02, 0.005).unwrap();
        observe(&mut volume, &DepthImage::filled(narrow.size, 0.0), &narrow);
        assert!(!volume.contains(&Point3::new(0.1, 0.0, 0.4)));
    }
}
