//! The law of exports: what is exported and imported again has the same cameras, pixels and masks.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::{
    ExportFormat, FrameId, ImportOptions, Sequence, export, import, write_intrinsics_txt, write_pose_txt,
};
use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_image::{Mask, RgbImage};
use mb_job::Silent;
use nalgebra::Vector6;
use proptest::prelude::*;

/// Frames with cameras as drawn, photographs in both formats, and masks.
fn write_sequence(root: &Path, cameras: &[([f64; 6], [f64; 4])]) -> Sequence {
    let size = ImageSize::new(24, 18);
    for (i, (pose, k)) in cameras.iter().enumerate() {
        // Numbers with gaps.
        let id = FrameId(3 * i as u32 + 2);
        let world_from_cam = Rigid3::<World, Camera>::exp(&Vector6::from(*pose));
        write_pose_txt(root.join(format!("pose/{id}.txt")), &world_from_cam).unwrap();
        let k = Intrinsics { fx: k[0], fy: k[1], cx: k[2], cy: k[3] };
        write_intrinsics_txt(root.join(format!("intrinsic/{id}.txt")), &k).unwrap();
        let photo = RgbImage::from_fn(size, |x, y| [x as u8 * 9, y as u8 * 11, 40 * i as u8]);
        if i % 2 == 0 {
            mb_image::write_jpeg(root.join(format!("image/{id}.jpg")), &photo, 85).unwrap();
        } else {
            mb_image::write_rgb_png(root.join(format!("image/{id}.png")), &photo).unwrap();
        }
        let mask = Mask::from_fn(size, |x, y| (x + y + i) % 3 == 0);
        mb_image::write_mask_png(root.join(format!("mask/{id}.png")), &mask).unwrap();
    }
    Sequence::open(root).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn imports_of_exports_are_the_sequence(
        cameras in prop::collection::vec(
            (prop::array::uniform6(-2.0..2.0f64), [300.0..3000.0f64, 300.0..3000.0f64, 0.0..24.0f64, 0.0..18.0f64]),
            1..5,
        ),
    ) {
        let dir = tempfile::tempdir().unwrap();
        let sequence = write_sequence(&dir.path().join("seq"), &cameras);
        let formats = [
            (ExportFormat::Colmap, "bin", true),
            (ExportFormat::Colmap, "txt", true),
            (ExportFormat::Nerfstudio, "", true),
            // These two number frames in their order.
            (ExportFormat::Neus, "", false),
            (ExportFormat::Mvsnet, "", false),
        ];
        for (format, form, keeps_numbers) in formats {
            let name = format!("{format:?}{form}");
            let (out, back) = (dir.path().join(&name), dir.path().join(format!("{name}-back")));
            let exported = export(&sequence, format, &out, &Silent).unwrap();
            prop_assert_eq!((exported.frames, exported.masks), (cameras.len(), cameras.len()));
            for file in ["cameras", "images", "points3D"].map(|f| out.join(format!("sparse/0/{f}.bin"))) {
                if form == "txt" {
                    std::fs::remove_file(file).unwrap();
                }
            }
            let imported = import(&out, None, &back, &ImportOptions::default(), &Silent).unwrap();
            prop_assert_eq!((imported.frames_imported, imported.frames_with_mask, imported.undistorted),
                (cameras.len(), cameras.len(), 0));
            let back = Sequence::open(&back).unwrap();
            for (i, (there, here)) in sequence.frames().iter().zip(back.frames()).enumerate() {
                prop_assert_eq!(here.id, if keeps_numbers { there.id } else { FrameId(i as u32) });
                let moved = (there.world_from_cam.to_matrix() - here.world_from_cam.to_matrix()).amax();
                prop_assert!(moved < 1e-9, "{}: pose off by {}", name, moved);
                let k = (there.intrinsics.to_matrix() - here.intrinsics.to_matrix()).amax();
                prop_assert!(k < 1e-9, "{}: intrinsics off by {}", name, k);
                let bytes = |frame: &mb_capture::Frame| std::fs::read(frame.image.as_ref().unwrap()).unwrap();
                prop_assert_eq!(bytes(there), bytes(here));
                prop_assert_eq!(sequence.read_mask(there).unwrap(), back.read_mask(here).unwrap());
            }
        }
    }
}
