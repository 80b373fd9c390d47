//! Importers on real captures, and exports that come back as they went.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::{CaptureFormat, ExportFormat, FrameId, ImportOptions, ImportSummary, Sequence, export, import};
use mb_geometry::ImageSize;
use mb_job::{Error, Result, Silent};
use nalgebra::{Matrix3, Vector3};

fn import_all(source: &Path, out: &Path) -> Result<ImportSummary> {
    import(source, None, out, &ImportOptions::default(), &Silent)
}

fn input_error(result: Result<ImportSummary>) -> String {
    match result {
        Err(Error::Input(e)) => e.to_string(),
        other => panic!("expected an input error, got {other:?}"),
    }
}

/// Symmetric distance (pixels) of a match from the epipolar lines that two frames' cameras imply.
fn epipolar_px(sequence: &Sequence, a: u32, b: u32, matched: [f64; 4]) -> f64 {
    let (a, b) = (sequence.frame(FrameId(a)).unwrap(), sequence.frame(FrameId(b)).unwrap());
    let b_from_a = b.world_from_cam.inverse() * a.world_from_cam;
    let essential = b_from_a.translation().cross_matrix() * b_from_a.rotation_matrix();
    let inverse = |m: Matrix3<f64>| m.try_inverse().unwrap();
    let fundamental = inverse(b.intrinsics.to_matrix()).transpose() * essential * inverse(a.intrinsics.to_matrix());
    let (p, q) = (Vector3::new(matched[0], matched[1], 1.0), Vector3::new(matched[2], matched[3], 1.0));
    let (line_b, line_a) = (fundamental * p, fundamental.transpose() * q);
    let residual = q.dot(&line_b).abs();
    0.5 * (residual / line_b.xy().norm() + residual / line_a.xy().norm())
}

#[test]
fn the_published_layout_comes_in_and_the_frame_without_a_pose_is_named() {
    let Some(source) = mb_testdata::find("mobilebrick_5frames") else { return };
    let dir = tempfile::tempdir().unwrap();
    let summary = import_all(&source, &dir.path().join("seq")).unwrap();
    assert_eq!((summary.format, summary.frames_found, summary.frames_imported), (CaptureFormat::Mobilebrick, 5, 4));
    assert_eq!(summary.frames_skipped[0].frame, "000003");
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    assert_eq!(sequence.image_size(), ImageSize::new(1920, 1440));
    let original = std::fs::read(source.join("image/000002.jpg")).unwrap();
    assert_eq!(std::fs::read(dir.path().join("seq/image/000002.jpg")).unwrap(), original);
    // Matches between frames 0 and 4 (38 mm apart) that OpenCV's SIFT found. With any other convention of axes
    // or direction their median is 16 px or more.
    let matches: Vec<[f64; 4]> = include_str!("matches_0_4.txt")
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| <[f64; 4]>::try_from(line.split(' ').map(|w| w.parse().unwrap()).collect::<Vec<f64>>()).unwrap())
        .collect();
    let mut distances: Vec<f64> = matches.iter().map(|m| epipolar_px(&sequence, 0, 4, *m)).collect();
    distances.sort_by(f64::total_cmp);
    assert!(distances[distances.len() / 2] < 0.6, "median {} px", distances[distances.len() / 2]);
}

#[test]
fn a_colmap_model_with_distortion_comes_in_undistorted() {
    let Some(source) = mb_testdata::find("mobilebrick-video") else { return };
    let dir = tempfile::tempdir().unwrap();
    let options = ImportOptions { every: 10, ..ImportOptions::default() };
    let summary = import(&source, None, &dir.path().join("seq"), &options, &Silent).unwrap();
    assert_eq!((summary.format, summary.frames_found, summary.frames_imported), (CaptureFormat::Colmap, 61, 7));
    assert_eq!((summary.undistorted, summary.metric), (7, false));
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let frame = sequence.frame(FrameId(10)).unwrap();
    // The corner of COLMAP's images is (0, 0), ours is (-0.5, -0.5).
    assert!((frame.intrinsics.cx - 269.5).abs() < 1e-12 && (frame.intrinsics.fx - 554.2219).abs() < 1e-4);
    let cam_from_world = frame.world_from_cam.inverse();
    let (translation, rotation) = (cam_from_world.translation(), cam_from_world.rotation());
    let expected = Vector3::new(-0.784_190_743_034, -3.292_548_755_115, 2.032_226_181_256);
    assert!((translation - expected).norm() < 1e-9, "{translation:?}");
    assert!((rotation.w.abs() - 0.991_181_484_695).abs() < 1e-9, "{rotation:?}");
    assert!(dir.path().join("seq/image_valid/000010.png").exists());
}

#[test]
fn transforms_json_lists_photographs_that_do_not_exist() {
    let Some(source) = mb_testdata::find("ngp_fox/transforms_original_67frames.json") else { return };
    let dir = tempfile::tempdir().unwrap();
    let options = ImportOptions { every: 8, ..ImportOptions::default() };
    let summary = import(&source, None, &dir.path().join("seq"), &options, &Silent).unwrap();
    assert_eq!((summary.format, summary.frames_found, summary.frames_imported), (CaptureFormat::Nerfstudio, 67, 5));
    assert_eq!(summary.frames_skipped.len(), 27);
    assert_eq!(summary.undistorted, 5);
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let frame = &sequence.frames()[0];
    assert!((frame.intrinsics.cx - 554.058).abs() < 1e-9 && (frame.intrinsics.fy - 1374.49).abs() < 1e-9);
    // OpenGL's z axis points backwards: ours is the third column of the file, negated.
    assert_eq!(frame.id, FrameId(1));
    let forward = frame.world_from_cam.rotate(&Vector3::z());
    let expected = -Vector3::new(0.44209, -0.89407, -0.07209);
    assert!((forward - expected).norm() < 1e-4, "{forward:?}");
}

#[test]
fn stray_rows_are_joined_by_frame_number_and_keep_their_own_intrinsics() {
    let Some(source) = mb_testdata::find("stray_scanner_excerpt") else { return };
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("stray");
    std::fs::create_dir_all(copy.join("rgb")).unwrap();
    for file in ["odometry.csv", "camera_matrix.csv"] {
        std::fs::copy(source.join(file), copy.join(file)).unwrap();
    }
    let photo = mb_image::RgbImage::filled(ImageSize::new(1920, 1440), [90; 3]);
    for id in [0, 1031, 2062] {
        mb_image::write_jpeg(copy.join(format!("rgb/{id:06}.jpg")), &photo, 50).unwrap();
    }
    let summary = import_all(&copy, &dir.path().join("seq")).unwrap();
    assert_eq!((summary.frames_found, summary.frames_imported, summary.metric), (4, 3, true));
    assert_eq!(summary.frames_skipped[0].frame, "001758");
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let fx: Vec<f64> = sequence.frames().iter().map(|f| f.intrinsics.fx).collect();
    assert!((fx[0] - 1382.7905).abs() < 1e-9 && (fx[1] - 1420.2943).abs() < 1e-9, "{fx:?}");
    let looks = sequence.frames()[0].world_from_cam.rotate(&Vector3::z());
    assert!((looks - Vector3::new(-0.005, -0.813, -0.582)).norm() < 0.02, "{looks:?}");
    let times = sequence.meta().unwrap().frame_times_s.clone().unwrap();
    assert!((times[1] - 17.217_414_416).abs() < 1e-6);
}

#[test]
fn a_camera_path_alone_comes_in_and_says_so() {
    let Some(source) = mb_testdata::find("stray_scanner_excerpt") else { return };
    let dir = tempfile::tempdir().unwrap();
    let summary = import_all(&source, &dir.path().join("seq")).unwrap();
    assert_eq!((summary.frames_imported, summary.frames_with_pose, summary.frames_with_depth), (4, 4, 0));
    assert!(summary.warnings.iter().any(|w| w.contains("only the camera path")), "{:?}", summary.warnings);
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    assert_eq!(sequence.frames().iter().map(|f| f.id.0).collect::<Vec<_>>(), [0, 1031, 1758, 2062]);
    assert!(sequence.frames().iter().all(|f| f.image.is_none()));
}

#[test]
fn record3d_metadata_alone_says_what_is_missing() {
    let Some(source) = mb_testdata::find("record3d_metadata_r3d/data.r3d") else { return };
    assert_eq!(CaptureFormat::detect(&source), Some(CaptureFormat::Record3d));
    let dir = tempfile::tempdir().unwrap();
    let message = input_error(import_all(&source, &dir.path().join("seq")));
    assert!(message.contains("data.r3d") && message.contains("no photograph of it in rgbd/"), "{message}");
    assert!(!dir.path().join("seq").exists());
}

#[test]
fn a_record3d_archive_with_lzfse_depth_comes_in_metric() {
    use std::io::Write as _;
    let dir = tempfile::tempdir().unwrap();
    let photo = mb_image::RgbImage::filled(ImageSize::new(72, 96), [10, 200, 30]);
    mb_image::write_jpeg(dir.path().join("0.jpg"), &photo, 90).unwrap();
    let depth: Vec<u8> =
        (0..6 * 8).flat_map(|i| if i == 5 { f32::NAN } else { 0.4 + 0.01 * i as f32 }.to_le_bytes()).collect();
    let packed = |bytes: &[u8]| {
        let mut out = Vec::new();
        lzfse_rust::encode_bytes(bytes, &mut out).unwrap();
        out
    };
    let metadata = r#"{"w":72,"h":96,"dw":6,"dh":8,"fps":30,"K":[70,0,0,0,71,0,35,47,1],
        "perFrameIntrinsicCoeffs":[[72,73,36,48]],"poses":[[0,0,0,1,0.1,0.2,0.3]]}"#;
    let write = |name: &str, depth: &[u8]| {
        let path = dir.path().join(name);
        let mut zip = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
        let options = zip::write::SimpleFileOptions::default();
        let entries: [(&str, Vec<u8>); 4] = [
            ("metadata", metadata.as_bytes().to_vec()),
            ("rgbd/0.jpg", std::fs::read(dir.path().join("0.jpg")).unwrap()),
            ("rgbd/0.depth", packed(depth)),
            ("rgbd/0.conf", packed(&[2; 48])),
        ];
        for (name, bytes) in entries {
            zip.start_file(name, options).unwrap();
            zip.write_all(&bytes).unwrap();
        }
        zip.finish().unwrap();
        path
    };
    let summary = import_all(&write("a.r3d", &depth), &dir.path().join("seq")).unwrap();
    assert_eq!((summary.frames_imported, summary.frames_with_depth), (1, 1));
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let frame = &sequence.frames()[0];
    assert_eq!(frame.intrinsics.fx, 72.0);
    // Identity in OpenGL axes looks along -z.
    assert!((frame.world_from_cam.rotate(&Vector3::z()) + Vector3::z()).norm() < 1e-12);
    let (read, confidence) = sequence.read_arkit_depth(frame).unwrap();
    assert_eq!((read[(5, 0)], confidence[(0, 0)]), (0.0, 2));
    assert!((read[(3, 2)] - 0.55).abs() < 6e-4);
    // Depth of another size than stated.
    let message = input_error(import_all(&write("b.r3d", &depth[..100]), &dir.path().join("b")));
    assert!(message.contains("rgbd/0.depth") && message.contains("expected 48 (6x8)"), "{message}");
}

#[test]
fn arkit_json_turns_the_cameras_axes() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("scan");
    std::fs::create_dir(&source).unwrap();
    let photo = mb_image::RgbImage::filled(ImageSize::new(192, 144), [90; 3]);
    mb_image::write_jpeg(source.join("frame_00010.jpg"), &photo, 80).unwrap();
    // Row-major: a camera 0.5 m up that looks straight down (its backward axis is world up), x to the east.
    let pose = "[1,0,0,0.1, 0,0,1,0.5, 0,-1,0,0.2, 0,0,0,1]";
    let json =
        |pose: &str| format!(r#"{{"cameraPoseARFrame":{pose},"intrinsics":[146,0,96.2,0,146,72.4,0,0,1],"time":3.5}}"#);
    std::fs::write(source.join("frame_00010.json"), json(pose)).unwrap();
    std::fs::write(source.join("frame_00011.json"), json(pose)).unwrap();
    let summary = import_all(&source, &dir.path().join("seq")).unwrap();
    assert_eq!((summary.format, summary.frames_imported), (CaptureFormat::ArkitJson, 1));
    assert!(summary.warnings[0].contains("1 frames have a pose but no photograph"), "{:?}", summary.warnings);
    let camera = Sequence::open(dir.path().join("seq")).unwrap().frames()[0].world_from_cam;
    assert!((camera.rotate(&Vector3::z()) + Vector3::y()).norm() < 1e-12);
    assert!((camera.translation() - Vector3::new(0.1, 0.5, 0.2)).norm() < 1e-12);
    std::fs::write(source.join("frame_00010.json"), json("[1,2,3]")).unwrap();
    let message = input_error(import_all(&source, &dir.path().join("bad")));
    assert!(message.contains("frame_00010.json") && message.contains("3 numbers, expected 16"), "{message}");
}

#[test]
fn arkitscenes_poses_are_interpolated_between_the_times_of_its_path() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("scene");
    for folder in ["lowres_wide", "lowres_wide_intrinsics"] {
        std::fs::create_dir_all(source.join(folder)).unwrap();
    }
    let photo = mb_image::RgbImage::filled(ImageSize::new(256, 192), [90; 3]);
    for time in ["100.050", "200.000"] {
        mb_image::write_rgb_png(source.join(format!("lowres_wide/4_{time}.png")), &photo).unwrap();
        std::fs::write(source.join(format!("lowres_wide_intrinsics/4_{time}.pincam")), "256 192 212 212 127 95")
            .unwrap();
    }
    // World-to-camera: the camera moves from x = 1 to x = 2.
    std::fs::write(source.join("lowres_wide.traj"), "100.0 0 0 0 -1 0 0\n100.1 0 0 0 -2 0 0\n").unwrap();
    let summary = import_all(&source, &dir.path().join("seq")).unwrap();
    assert_eq!((summary.format, summary.frames_imported), (CaptureFormat::Arkitscenes, 1));
    assert!(summary.frames_skipped[0].reason.contains("gap"));
    let camera = Sequence::open(dir.path().join("seq")).unwrap().frames()[0].world_from_cam;
    assert!((camera.translation().x - 1.5).abs() < 1e-6);
}

#[test]
fn photographs_alone_come_in_without_cameras() {
    let Some(source) = mb_testdata::find("gtsfm_lund_door/images") else { return };
    let dir = tempfile::tempdir().unwrap();
    let options = ImportOptions { every: 6, ..ImportOptions::default() };
    let summary = import(&source, None, &dir.path().join("seq"), &options, &Silent).unwrap();
    assert_eq!((summary.format, summary.frames_imported, summary.frames_with_pose), (CaptureFormat::Photos, 2, 0));
    assert!(summary.warnings[0].contains("structure-from-motion"));
}

#[test]
fn exports_come_back_with_the_same_cameras_and_pixels() {
    let Some(source) = mb_testdata::find("mobilebrick_5frames") else { return };
    let dir = tempfile::tempdir().unwrap();
    import_all(&source, &dir.path().join("seq")).unwrap();
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    for format in [ExportFormat::Colmap, ExportFormat::Nerfstudio] {
        for binary in [true, false] {
            let name = format!("{format:?}-{binary}");
            let out = dir.path().join(&name);
            export(&sequence, format, &out, &Silent).unwrap();
            if !binary {
                for file in ["cameras", "images", "points3D"] {
                    let _ = std::fs::remove_file(out.join(format!("sparse/0/{file}.bin")));
                }
            }
            let back = dir.path().join(format!("{name}-back"));
            let summary = import_all(&out, &back).unwrap();
            assert_eq!((summary.frames_imported, summary.undistorted), (4, 0));
            let back = Sequence::open(&back).unwrap();
            for (there, here) in sequence.frames().iter().zip(back.frames()) {
                assert_eq!(there.id, here.id);
                let moved = (there.world_from_cam.inverse() * here.world_from_cam).log().amax();
                assert!(moved < 1e-9, "{name}: {moved}");
                let (k, found) = (there.intrinsics.to_matrix(), here.intrinsics.to_matrix());
                assert!((k - found).amax() < 1e-9, "{name}");
                let read = |frame: &mb_capture::Frame| std::fs::read(frame.image.as_ref().unwrap()).unwrap();
                assert_eq!(read(there), read(here));
            }
        }
    }
}

#[test]
fn mvsnet_and_neus_exports_hold_the_cameras() {
    let Some(source) = mb_testdata::find("mobilebrick_5frames") else { return };
    let dir = tempfile::tempdir().unwrap();
    import_all(&source, &dir.path().join("seq")).unwrap();
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let out = dir.path().join("mvsnet");
    export(&sequence, ExportFormat::Mvsnet, &out, &Silent).unwrap();
    let text = std::fs::read_to_string(out.join("cams/00000002_cam.txt")).unwrap();
    let numbers: Vec<f64> = text.split_whitespace().filter_map(|w| w.parse().ok()).collect();
    let expected = sequence.frames()[2].world_from_cam.inverse().to_matrix();
    for (i, value) in numbers[..16].iter().enumerate() {
        assert!((value - expected[(i / 4, i % 4)]).abs() < 1e-12);
    }
    let (near, far) = (numbers[25], numbers[28]);
    assert!(0.05 < near && near < far && far < 2.0, "{near} to {far}");
    let pairs = std::fs::read_to_string(out.join("pair.txt")).unwrap();
    assert_eq!(pairs.lines().count(), 1 + 2 * 4);
    let out = dir.path().join("neus");
    export(&sequence, ExportFormat::Neus, &out, &Silent).unwrap();
    assert!(out.join("cameras_sphere.npz").exists() && out.join("image/003.jpg").exists());
}

#[test]
fn damaged_sources_are_named_and_leave_nothing_that_looks_whole() {
    let Some(source) = mb_testdata::find("mobilebrick_5frames") else { return };
    let dir = tempfile::tempdir().unwrap();
    import_all(&source, &dir.path().join("seq")).unwrap();
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let model = dir.path().join("colmap");
    export(&sequence, ExportFormat::Colmap, &model, &Silent).unwrap();
    for file in ["cameras.bin", "images.bin"] {
        let path = model.join("sparse/0").join(file);
        let whole = std::fs::read(&path).unwrap();
        for cut in [0, 4, 9, 40, whole.len() - 1] {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let message = input_error(import_all(&model, &dir.path().join("bad")));
            assert!(message.contains(file) && message.contains("truncated"), "{cut}: {message}");
        }
        std::fs::write(&path, &whole).unwrap();
    }
    // A count of images that no file could hold.
    let path = model.join("sparse/0/images.bin");
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    std::fs::write(&path, &bytes).unwrap();
    assert!(input_error(import_all(&model, &dir.path().join("bad"))).contains("truncated"));
    // A photograph cut short.
    let photo = dir.path().join("seq/image/000001.jpg");
    let bytes = std::fs::read(&photo).unwrap();
    std::fs::write(&photo, &bytes[..300]).unwrap();
    let message = input_error(import_all(&dir.path().join("seq"), &dir.path().join("cut")));
    assert!(message.contains("000001.jpg"), "{message}");
    assert!(!dir.path().join("cut/sequence.json").exists());
    assert!(input_error(import_all(&dir.path().join("none"), &dir.path().join("x"))).contains("no such file"));
    std::fs::create_dir(dir.path().join("empty")).unwrap();
    assert!(
        input_error(import_all(&dir.path().join("empty"), &dir.path().join("x"))).contains("looks like no capture")
    );
}
