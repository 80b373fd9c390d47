//! Importers of phone apps and RGB-D layouts: their variants, on real files where there are some.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::{CaptureFormat, FrameId, ImportOptions, ImportSummary, Sequence, import};
use mb_geometry::ImageSize;
use mb_image::RgbImage;
use mb_job::{Error, Result, Silent};

fn import_all(source: &Path, out: &Path) -> Result<ImportSummary> {
    import(source, None, out, &ImportOptions::default(), &Silent)
}

fn input_error(result: Result<ImportSummary>) -> String {
    match result {
        Err(Error::Input(e)) => e.to_string(),
        other => panic!("expected an input error, got {other:?}"),
    }
}

/// `found = imported + not selected + skipped`: no frame is lost in silence.
fn assert_counted(summary: &ImportSummary) {
    let told = summary.frames_imported + summary.frames_not_selected + summary.frames_skipped.len();
    assert_eq!(summary.frames_found, told, "{summary:?}");
}

/// A photograph of the test pattern's size whose sharpness falls with `blur`.
fn pattern(blur: usize) -> RgbImage {
    RgbImage::from_fn(ImageSize::new(96, 72), |x, y| {
        let cell = ((x / (2 + blur)) + (y / (2 + blur))) % 2;
        [if cell == 0 { 90 } else { 160 }; 3]
    })
}

#[test]
fn frames_of_a_stray_video_are_joined_with_their_rows() {
    let (Some(videos), Some(_)) = (mb_testdata::find("hevc_mp4"), mb_testdata::find_program("ffmpeg")) else { return };
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("stray");
    std::fs::create_dir(&source).unwrap();
    std::fs::copy(videos.join("h265_video.mp4"), source.join("rgb.mp4")).unwrap();
    // Rows out of order and with gaps; the last one lies beyond the video's ten frames.
    let row = |frame: u32| format!("{}.5, {frame:06}, {frame}, 0, 0, 0, 0, 0, 1, 100, 101, 63, 64, , \n", frame);
    let header =
        "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, distortion_center_y\n";
    let rows: String = [5, 0, 9, 12].map(row).concat();
    std::fs::write(source.join("odometry.csv"), header.to_owned() + &rows).unwrap();
    let summary = import_all(&source, &dir.path().join("seq")).unwrap();
    assert_counted(&summary);
    assert_eq!((summary.format, summary.frames_imported), (CaptureFormat::Stray, 3));
    assert_eq!(summary.frames_skipped[0].frame, "000012");
    assert!(summary.frames_skipped[0].reason.contains("the video ends after 10 frames"));
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let frame = sequence.frame(FrameId(5)).unwrap();
    assert_eq!((frame.world_from_cam.translation().x, frame.intrinsics.fy), (5.0, 101.0));
    let (found, reference) =
        (sequence.read_image(frame).unwrap(), mb_image::read_rgb(videos.join("h265_video.frame5.png")).unwrap());
    let off: u64 = found
        .data()
        .as_flattened()
        .iter()
        .zip(reference.data().as_flattened())
        .map(|(a, b)| u64::from(a.abs_diff(*b)))
        .sum();
    assert!(off as f64 / (128.0 * 128.0 * 3.0) < 3.0, "not frame 5");
}

#[test]
fn a_video_that_is_damaged_ends_the_import_and_leaves_nothing() {
    let (Some(videos), Some(_)) = (mb_testdata::find("hevc_mp4"), mb_testdata::find_program("ffmpeg")) else { return };
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("stray"), dir.path().join("seq"));
    std::fs::create_dir(&source).unwrap();
    let whole = std::fs::read(videos.join("h265_video.mp4")).unwrap();
    std::fs::write(source.join("rgb.mp4"), &whole[..whole.len() / 2]).unwrap();
    let text = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy\n0, 0, 0, 0, 0, 0, 0, 0, 1, 99, 99, 63, 64\n";
    std::fs::write(source.join("odometry.csv"), text).unwrap();
    let message = input_error(import_all(&source, &out));
    assert!(message.contains("rgb.mp4: frame ") && message.contains("ffmpeg says"), "{message}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "only the source is there");
}

/// A `[2, 3]` array in NumPy's format.
fn npy(kind: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': (2, 3), }}");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend(((header.len() + 1) as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.push(b'\n');
    bytes.extend(data);
    bytes
}

#[test]
fn the_first_stray_recordings_have_no_header_and_depth_as_arrays() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("stray");
    for folder in ["rgb", "depth", "confidence"] {
        std::fs::create_dir_all(source.join(folder)).unwrap();
    }
    std::fs::write(source.join("odometry.csv"), "1, 2, 3, 0, 0, 0, 1\n4, 5, 6, 0.6, 0, 0, 0.8").unwrap();
    std::fs::write(source.join("camera_matrix.csv"), "80, 0, 47.5\n0, 80, 35.5\n0, 0, 1").unwrap();
    for i in 0..2 {
        mb_image::write_rgb_png(source.join(format!("rgb/{i:06}.png")), &pattern(0)).unwrap();
    }
    let mm: Vec<u8> = [500u16, 501, 502, 503, 0, 505].iter().flat_map(|v| v.to_le_bytes()).collect();
    let m: Vec<u8> = [0.5f32, f32::NAN, 0.502, -1.0, 0.0, 0.505].iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(source.join("depth/000000.npy"), npy("<u2", &mm)).unwrap();
    std::fs::write(source.join("depth/000001.npy"), npy("<f4", &m)).unwrap();
    std::fs::write(source.join("confidence/000000.npy"), npy("|u1", &[0, 1, 2, 2, 1, 0])).unwrap();
    let summary = import_all(&source, &dir.path().join("seq")).unwrap();
    assert_counted(&summary);
    assert_eq!((summary.frames_imported, summary.frames_with_depth), (2, 2));
    assert!(summary.warnings[0].contains("camera_matrix.csv"));
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let [a, b] = sequence.frames() else { panic!("two frames") };
    assert!((b.world_from_cam.rotation().w - 0.8).abs() < 1e-12 && b.world_from_cam.translation().y == 5.0);
    let (depth, confidence) = sequence.read_arkit_depth(a).unwrap();
    assert!((depth[(2, 0)] - 0.502).abs() < 1e-6 && depth[(1, 1)] == 0.0);
    assert_eq!(confidence.data(), [0, 1, 2, 2, 1, 0]);
    let (depth, _) = sequence.read_arkit_depth(b).unwrap();
    assert!(depth[(1, 0)] == 0.0 && (depth[(2, 1)] - 0.505).abs() < 1e-6);
    // An array that is shorter than it says, and one that is no depth at all.
    std::fs::write(source.join("depth/000001.npy"), npy("<f4", &m[..20])).unwrap();
    let message = input_error(import_all(&source, &dir.path().join("bad")));
    assert!(message.contains("000001.npy: frame 000001"), "{message}");
    std::fs::write(source.join("depth/000001.npy"), npy("<c8", &m)).unwrap();
    assert!(input_error(import_all(&source, &dir.path().join("bad"))).contains("expected uint8"));
}

/// An OpenEXR image of one channel.
fn exr(channel: &str, size: (usize, usize), value: impl Fn(usize, usize) -> f32, half: bool) -> Vec<u8> {
    use exr::prelude::*;
    let values: Vec<f32> = (0..size.0 * size.1).map(|i| value(i % size.0, i / size.0)).collect();
    let samples =
        if half { FlatSamples::F16(values.into_iter().map(f16::from_f32).collect()) } else { FlatSamples::F32(values) };
    let channels = AnyChannels::sort(vec![AnyChannel::new(channel, samples)].into());
    let image = Image::from_channels(size, channels);
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

#[test]
fn the_exr_export_of_record3d_comes_in_portrait() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("recording/EXR_RGBD");
    for folder in ["rgb", "depth"] {
        std::fs::create_dir_all(source.join(folder)).unwrap();
    }
    let metadata = r#"{"w":72,"h":96,"dw":6,"dh":8,"fps":30,"K":[70,0,0,0,71,0,35,47,1],
        "poses":[[0,0,0,1,0.1,0.2,0.3],[0,0,0,1,0.2,0.2,0.3],[0,0,0,1,0.3,0.2,0.3]]}"#;
    std::fs::write(source.join("metadata.json"), metadata).unwrap();
    let photo = RgbImage::filled(ImageSize::new(72, 96), [10, 200, 30]);
    for i in 0..2 {
        mb_image::write_jpeg(source.join(format!("rgb/{i}.jpg")), &photo, 90).unwrap();
        let depth = exr("R", (6, 8), |x, y| if x == 5 { f32::NAN } else { 0.5 + 0.25 * y as f32 }, i == 0);
        std::fs::write(source.join(format!("depth/{i}.exr")), depth).unwrap();
    }
    // The folder that the app makes, and the one around it.
    for (name, from) in [("inner", source.clone()), ("outer", dir.path().join("recording"))] {
        let out = dir.path().join(name);
        let summary = import_all(&from, &out).unwrap();
        assert_counted(&summary);
        assert_eq!((summary.format, summary.frames_imported), (CaptureFormat::Record3d, 2));
        assert_eq!((summary.frames_with_depth, summary.image_size), (2, ImageSize::new(72, 96)));
        let sequence = Sequence::open(&out).unwrap();
        for frame in sequence.frames() {
            let (depth, _) = sequence.read_arkit_depth(frame).unwrap();
            assert_eq!(depth.size(), ImageSize::new(6, 8));
            // 0.5, 0.75, .. are exact in half floats.
            assert!(depth[(2, 3)] == 1.25 && depth[(5, 3)] == 0.0);
            assert_eq!(frame.intrinsics.cy, 47.0);
        }
    }
    let whole = std::fs::read(source.join("depth/1.exr")).unwrap();
    std::fs::write(source.join("depth/1.exr"), &whole[..whole.len() - 9]).unwrap();
    let message = input_error(import_all(&source, &dir.path().join("bad")));
    assert!(message.contains("depth/1.exr: frame 000001") && message.contains("damaged"), "{message}");
    std::fs::write(source.join("depth/1.exr"), exr("alpha", (6, 8), |_, _| 1.0, false)).unwrap();
    assert!(import_all(&source, &dir.path().join("one")).is_ok(), "the only channel is depth");
}

#[test]
fn an_exr_header_that_claims_gigapixels_is_refused() {
    let mut bytes = exr("R", (4, 4), |_, _| 1.0, false);
    // dataWindow: box2i, 16 bytes of xMin yMin xMax yMax after the attribute's name, type and size.
    let at = bytes.windows(11).position(|w| w == b"dataWindow\0").unwrap() + 11 + b"box2i\0".len() + 4;
    for (i, value) in [0i32, 0, 99_999, 99_999].into_iter().enumerate() {
        bytes[at + 4 * i..at + 4 * i + 4].copy_from_slice(&value.to_le_bytes());
    }
    let message = mb_image::decode_depth_exr(&bytes, Path::new("a.exr")).unwrap_err().to_string();
    assert!(message.contains("a.exr") && message.contains("100000x100000 pixels"), "{message}");
}

#[test]
fn the_seven_scenes_layout_comes_in_with_its_depth() {
    let Some(source) = mb_testdata::find("seven_scenes_tsdf") else { return };
    let dir = tempfile::tempdir().unwrap();
    let options = ImportOptions { range: Some((0, 100)), every: 2, ..ImportOptions::default() };
    let summary = import(&source, None, &dir.path().join("seq"), &options, &Silent).unwrap();
    assert_counted(&summary);
    assert_eq!((summary.format, summary.frames_found), (CaptureFormat::SevenScenes, 40));
    assert_eq!((summary.frames_imported, summary.frames_with_depth, summary.metric), (3, 3, true));
    assert!(summary.warnings.iter().any(|w| w.contains("not exactly orthonormal")), "{:?}", summary.warnings);
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    assert_eq!(sequence.frames().iter().map(|f| f.id.0).collect::<Vec<_>>(), [0, 50, 100]);
    assert_eq!(sequence.frames()[0].intrinsics.fx, 585.0);
    // Its README: valid depth of frame 0 is 0.801 to 3.493 m, 89.2 % of the pixels.
    let (depth, _) = sequence.read_arkit_depth(&sequence.frames()[0]).unwrap();
    let valid: Vec<f32> = depth.data().iter().copied().filter(|z| *z > 0.0).collect();
    let (near, far) = valid.iter().fold((f32::MAX, 0.0f32), |(near, far), z| (near.min(*z), far.max(*z)));
    assert!((near - 0.801).abs() < 1e-6 && (far - 3.493).abs() < 1e-6, "{near} to {far}");
    assert!((valid.len() as f64 / depth.size().pixels() as f64 - 0.892).abs() < 1e-3);
}

#[test]
fn a_seven_scenes_frame_without_tracking_or_pose_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("scene");
    std::fs::create_dir(&source).unwrap();
    std::fs::write(source.join("camera-intrinsics.txt"), "80 0 47.5\n0 80 35.5\n0 0 1\n").unwrap();
    for i in 0..3 {
        mb_image::write_rgb_png(source.join(format!("frame-{i:06}.color.png")), &pattern(0)).unwrap();
    }
    std::fs::write(source.join("frame-000000.pose.txt"), "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n").unwrap();
    std::fs::write(source.join("frame-000001.pose.txt"), "nan nan nan nan\n".repeat(4)).unwrap();
    let summary = import_all(&source, &dir.path().join("seq")).unwrap();
    assert_counted(&summary);
    let reasons: Vec<_> = summary.frames_skipped.iter().map(|s| s.reason.as_str()).collect();
    assert_eq!(reasons, ["its pose is not finite: tracking was lost", "has no pose"]);
    std::fs::remove_file(source.join("camera-intrinsics.txt")).unwrap();
    let message = input_error(import_all(&source, &dir.path().join("bad")));
    assert!(message.contains("camera-intrinsics.txt") && message.contains("585"), "{message}");
}

#[test]
fn one_photograph_with_one_depth_map_is_a_pair() {
    let Some(source) = mb_testdata::find("promptda_arkit_pair") else { return };
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("seq");
    let summary = import_all(&source, &out).unwrap();
    assert_counted(&summary);
    assert_eq!((summary.format, summary.frames_imported), (CaptureFormat::Photos, 1));
    assert_eq!((summary.frames_with_depth, summary.image_size), (1, ImageSize::new(1920, 1440)));
    // Its README: 256x192, every pixel valid, 1.566 to 3.512 m.
    let depth = mb_image::read_depth_png(out.join("arkit_depth/000000.png")).unwrap();
    let (near, far) = depth.data().iter().fold((f32::MAX, 0.0f32), |(near, far), z| (near.min(*z), far.max(*z)));
    assert_eq!(depth.size(), ImageSize::new(256, 192));
    assert!((near - 1.566).abs() < 1e-6 && (far - 3.512).abs() < 1e-6, "{near} to {far}");
    // Several photographs: depth is joined by name, and what belongs to none is told.
    let folder = dir.path().join("several");
    std::fs::create_dir(&folder).unwrap();
    for name in ["a.jpg", "b.jpg"] {
        std::fs::copy(source.join("image.jpg"), folder.join(name)).unwrap();
    }
    for name in ["b_depth.png", "c_depth.png"] {
        std::fs::copy(source.join("arkit_depth.png"), folder.join(name)).unwrap();
    }
    let summary = import_all(&folder, &dir.path().join("two")).unwrap();
    assert_counted(&summary);
    assert_eq!((summary.frames_imported, summary.frames_with_depth), (2, 1));
    assert_eq!(summary.frames_skipped[0].frame, "c_depth.png");
    assert!(dir.path().join("two/arkit_depth/000001.png").exists());
}

#[test]
fn an_opensfm_reconstruction_has_its_origin_in_the_middle_of_the_image() {
    let Some(source) = mb_testdata::find("opensfm_berlin") else { return };
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("berlin");
    for folder in ["images", "masks"] {
        std::fs::create_dir_all(copy.join(folder)).unwrap();
        for entry in std::fs::read_dir(source.join(folder)).unwrap().flatten() {
            std::fs::copy(entry.path(), copy.join(folder).join(entry.file_name())).unwrap();
        }
    }
    std::fs::copy(source.join("reconstruction_example.json"), copy.join("reconstruction.json")).unwrap();
    let options = ImportOptions { range: Some((3, 3)), ..ImportOptions::default() };
    let summary = import(&copy, None, &dir.path().join("seq"), &options, &Silent).unwrap();
    assert_counted(&summary);
    assert_eq!((summary.format, summary.frames_found, summary.frames_imported), (CaptureFormat::Opensfm, 3, 1));
    assert_eq!((summary.undistorted, summary.metric), (1, false));
    let sequence = Sequence::open(dir.path().join("seq")).unwrap();
    let frame = &sequence.frames()[0];
    // 3264 pixels times the normalised focal length; the middle between the pixels 1631 and 1632.
    assert!((frame.intrinsics.fx - 3264.0 * 0.869_665_848_485_535_9).abs() < 1e-9 && frame.intrinsics.cx == 1631.5);
    let t = frame.world_from_cam.inverse().translation();
    assert!(
        (t - nalgebra::Vector3::new(0.508_723_323_389_611_6, 24.781_886_004_913_993, -20.531_969_658_319_593)).norm()
            < 1e-9
    );
}

#[test]
fn every_range_and_the_sharpest_of_each_run() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("stray");
    std::fs::create_dir_all(source.join("rgb")).unwrap();
    let mut rows = String::from("timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy\n");
    // Every third frame is sharp, the others more or less blurred; frame 7 does not exist.
    for i in 0..12u32 {
        rows += &format!("{i}, {i}, {i}, 0, 0, 0, 0, 0, 1, 80, 80, 47.5, 35.5\n");
        if i != 7 {
            let blur = [3, 0, 6][i as usize % 3];
            mb_image::write_rgb_png(source.join(format!("rgb/{i:06}.png")), &pattern(blur)).unwrap();
        }
    }
    std::fs::write(source.join("odometry.csv"), rows).unwrap();
    let ids = |options: ImportOptions| {
        let out = tempfile::tempdir().unwrap();
        let summary = import(&source, None, &out.path().join("seq"), &options, &Silent).unwrap();
        assert_counted(&summary);
        let sequence = Sequence::open(out.path().join("seq")).unwrap();
        let times = sequence.meta().unwrap().frame_times_s.clone().unwrap();
        let ids: Vec<u32> = sequence.frames().iter().map(|f| f.id.0).collect();
        assert_eq!(times.len(), ids.len());
        (ids, summary.frames_not_selected, summary.frames_skipped.len())
    };
    let default = ImportOptions::default;
    assert_eq!(ids(ImportOptions { range: Some((2, 5)), ..default() }), (vec![2, 3, 4, 5], 8, 0));
    assert_eq!(ids(ImportOptions { every: 5, ..default() }), (vec![0, 5, 10], 9, 0));
    // Runs of three, the sharp one of each; in the third it is missing, and the next best is taken.
    assert_eq!(ids(ImportOptions { sharpest: Some(4), ..default() }), (vec![1, 4, 6, 10], 7, 1));
    assert_eq!(ids(ImportOptions { sharpest: Some(99), range: Some((0, 3)), ..default() }), (vec![0, 1, 2, 3], 8, 0));
    let nothing = ImportOptions { range: Some((90, 99)), ..default() };
    let message = input_error(import(&source, None, &dir.path().join("none"), &nothing, &Silent));
    assert!(message.contains("none of its 12 frames"), "{message}");
}

#[test]
fn a_killed_import_is_taken_up_and_a_stopped_one_leaves_nothing() {
    /// Asks for a stop at once.
    struct Stop;
    impl mb_job::Progress for Stop {
        fn report(&self, _what: &str, _done: usize, _total: usize) {}
        fn stop_requested(&self) -> bool {
            true
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("photos");
    std::fs::create_dir(&source).unwrap();
    mb_image::write_rgb_png(source.join("a.png"), &pattern(0)).unwrap();
    let out = dir.path().join("seq");
    assert!(matches!(import(&source, None, &out, &ImportOptions::default(), &Stop), Err(Error::Stopped)));
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    // What a killed run leaves is replaced.
    std::fs::create_dir_all(dir.path().join("seq.partial/image")).unwrap();
    std::fs::write(dir.path().join("seq.partial/image/000077.png"), b"half").unwrap();
    import_all(&source, &out).unwrap();
    assert!(!dir.path().join("seq.partial").exists() && !out.join("image/000077.png").exists());
    assert!(input_error(import_all(&source, &out)).contains("is not empty"));
}
