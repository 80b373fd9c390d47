//! Damaged captures of every kind: an import either succeeds or names what is wrong; it never panics, and never leaves a
//! folder that looks whole.
//!
//! `MOBILEBRICK_FUZZ_CASES=20000 cargo test -p mb-capture --test hostile` looks longer.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::io::Write as _;
use std::path::{Path, PathBuf};

use mb_capture::{
    ExportFormat, FrameId, ImportOptions, Sequence, export, import, write_intrinsics_txt, write_pose_txt,
};
use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_image::RgbImage;
use mb_job::{Error, Silent};
use mb_testdata::{damaged, fuzz_cases};
use nalgebra::Vector6;

const SIZE: ImageSize = ImageSize::new(16, 12);

fn sequence(root: &Path) -> Sequence {
    for i in 0..3u32 {
        let id = FrameId(i);
        let pose = Rigid3::<World, Camera>::exp(&Vector6::new(0.1, 0.2 * f64::from(i), 0.3, 0.4, 0.5, 0.6));
        write_pose_txt(root.join(format!("pose/{id}.txt")), &pose).unwrap();
        let k = Intrinsics { fx: 20.0, fy: 20.0, cx: 7.5, cy: 5.5 };
        write_intrinsics_txt(root.join(format!("intrinsic/{id}.txt")), &k).unwrap();
        let photo = RgbImage::from_fn(SIZE, |x, y| [x as u8 * 15, y as u8 * 20, 7]);
        mb_image::write_jpeg(root.join(format!("image/{id}.jpg")), &photo, 85).unwrap();
        let depth = mb_image::DepthImage::filled(ImageSize::new(8, 6), 0.5);
        mb_image::write_depth_png(root.join(format!("arkit_depth/{id}.png")), &depth).unwrap();
        let confidence = mb_image::Confidence::filled(depth.size(), 2);
        mb_image::write_confidence_png(root.join(format!("arkit_depth/{id}_conf.png")), &confidence).unwrap();
    }
    Sequence::open(root).unwrap()
}

/// Imports; `true` where it worked. Whatever else happens must be an error that names the source.
fn survives(source: &Path, what: &str) -> bool {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("seq");
    match import(source, None, &out, &ImportOptions::default(), &Silent) {
        Ok(summary) => {
            let told = summary.frames_imported + summary.frames_not_selected + summary.frames_skipped.len();
            assert_eq!(summary.frames_found, told, "{what}: a frame was lost in silence");
            assert!(out.join("sequence.json").exists());
            true
        }
        Err(Error::Input(e)) => {
            assert!(!out.exists() && std::fs::read_dir(dir.path()).unwrap().count() == 0, "{what}: {e}");
            false
        }
        Err(e) => panic!("{what}: {e}"),
    }
}

/// Damages one file of a capture again and again.
fn fuzz(source: &Path, file: &str, cases: u64) {
    let path = source.join(file);
    let whole = std::fs::read(&path).unwrap();
    assert!(survives(source, file), "the undamaged {file}");
    let mut refused = 0;
    for seed in 0..fuzz_cases(cases) {
        std::fs::write(&path, damaged(&whole, seed)).unwrap();
        refused += u64::from(!survives(source, &format!("{file}, seed {seed}")));
    }
    std::fs::write(&path, &whole).unwrap();
    assert!(refused > 0, "{file}: no damage was noticed");
    println!("{file}: {refused} of {} damaged copies refused", fuzz_cases(cases));
}

fn exported(dir: &Path, format: ExportFormat) -> PathBuf {
    let sequence = sequence(&dir.join("seq"));
    let out = dir.join("export");
    export(&sequence, format, &out, &Silent).unwrap();
    out
}

#[test]
fn transforms_json() {
    let dir = tempfile::tempdir().unwrap();
    fuzz(&exported(dir.path(), ExportFormat::Nerfstudio), "transforms.json", 120);
}

#[test]
fn colmap_models() {
    let dir = tempfile::tempdir().unwrap();
    let source = exported(dir.path(), ExportFormat::Colmap);
    fuzz(&source, "sparse/0/images.bin", 120);
    fuzz(&source, "sparse/0/cameras.bin", 60);
    for file in ["cameras", "images"] {
        std::fs::remove_file(source.join(format!("sparse/0/{file}.bin"))).unwrap();
    }
    fuzz(&source, "sparse/0/images.txt", 60);
    fuzz(&source, "sparse/0/cameras.txt", 40);
}

#[test]
fn neus_archives_of_arrays() {
    let dir = tempfile::tempdir().unwrap();
    fuzz(&exported(dir.path(), ExportFormat::Neus), "cameras_sphere.npz", 150);
}

#[test]
fn mvsnet_cameras() {
    let dir = tempfile::tempdir().unwrap();
    fuzz(&exported(dir.path(), ExportFormat::Mvsnet), "cams/00000001_cam.txt", 60);
}

#[test]
fn published_layout() {
    let dir = tempfile::tempdir().unwrap();
    sequence(dir.path());
    let files = [
        "pose/000001.txt",
        "intrinsic/000001.txt",
        "image/000001.jpg",
        "arkit_depth/000001.png",
        "arkit_depth/000001_conf.png",
    ];
    for file in files {
        fuzz(dir.path(), file, 40);
    }
}

fn lzfse(bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    lzfse_rust::encode_bytes(bytes, &mut out).unwrap();
    out
}

const METADATA: &str = r#"{"w":16,"h":12,"dw":8,"dh":6,"fps":30,"K":[20,0,0,0,20,0,7.5,5.5,1],
    "perFrameIntrinsicCoeffs":[[20,20,7.5,5.5]],"frameTimestamps":[0.5],"poses":[[0,0,0,1,0.1,0.2,0.3]]}"#;

/// The entries of a recording with one frame.
fn recording() -> Vec<(&'static str, Vec<u8>)> {
    let dir = tempfile::tempdir().unwrap();
    let photo = RgbImage::filled(SIZE, [10, 200, 30]);
    mb_image::write_jpeg(dir.path().join("0.jpg"), &photo, 90).unwrap();
    let depth: Vec<u8> = (0..48).flat_map(|i| (0.4 + 0.01 * i as f32).to_le_bytes()).collect();
    vec![
        ("metadata", METADATA.as_bytes().to_vec()),
        ("rgbd/0.jpg", std::fs::read(dir.path().join("0.jpg")).unwrap()),
        ("rgbd/0.depth", lzfse(&depth)),
        ("rgbd/0.conf", lzfse(&[2; 48])),
    ]
}

fn write_r3d(path: &Path, entries: &[(&str, Vec<u8>)]) {
    let mut zip = zip::ZipWriter::new(std::fs::File::create(path).unwrap());
    for (name, bytes) in entries {
        zip.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap();
}

#[test]
fn record3d_archives_and_their_entries() {
    let dir = tempfile::tempdir().unwrap();
    write_r3d(&dir.path().join("a.r3d"), &recording());
    let path = dir.path().join("a.r3d");
    let whole = std::fs::read(&path).unwrap();
    assert!(survives(&path, "the undamaged archive"));
    for seed in 0..fuzz_cases(100) {
        std::fs::write(&path, damaged(&whole, seed)).unwrap();
        survives(&path, &format!("archive, seed {seed}"));
    }
    for i in 0..recording().len() {
        for seed in 0..fuzz_cases(60) {
            let mut entries = recording();
            entries[i].1 = damaged(&entries[i].1, seed);
            write_r3d(&path, &entries);
            survives(&path, &format!("{}, seed {seed}", entries[i].0));
        }
    }
}

#[test]
fn bombs_are_refused_before_they_unfold() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.r3d");
    let failing = |entry: usize, bytes: Vec<u8>| {
        let mut entries = recording();
        entries[entry].1 = bytes;
        write_r3d(&path, &entries);
        let out = dir.path().join("seq");
        import(&path, None, &out, &ImportOptions::default(), &Silent).unwrap_err().to_string()
    };
    // Zeros by the hundred megabytes, of which a kilobyte or two is left when packed.
    let zeros = vec![0; 300 << 20];
    let message = failing(0, zeros.clone());
    assert!(message.contains("unpacks to more than 256 MiB"), "{message}");
    let message = failing(2, lzfse(&zeros[..64 << 20]));
    assert!(message.contains("rgbd/0.depth") && message.contains("unpacks to more than 192 bytes"), "{message}");
    // The same without a stated size.
    let mut entries = recording();
    entries[0].1 = METADATA.replace(r#""dw":8,"dh":6,"#, "").into_bytes();
    entries[2].1 = lzfse(&zeros[..80 << 20]);
    write_r3d(&path, &entries);
    let out = dir.path().join("seq");
    let message = import(&path, None, &out, &ImportOptions::default(), &Silent).unwrap_err().to_string();
    assert!(message.contains("unpacks to more than"), "{message}");
    // A photograph whose header claims 65,500 pixels a side.
    let mut jpeg = recording()[1].1.clone();
    let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0xff, 0xdc, 0xff, 0xdc]);
    let message = failing(1, jpeg);
    assert!(message.contains("rgbd/0.jpg") && message.contains("65500x65500 pixels"), "{message}");
}

#[test]
fn stray_scanner_tables_and_arrays() {
    let dir = tempfile::tempdir().unwrap();
    for folder in ["rgb", "depth"] {
        std::fs::create_dir(dir.path().join(folder)).unwrap();
    }
    let rows = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy\n0.1, 000000, 1, 2, 3, 0, 0, 0, 1, 20, 20, 7.5, 5.5\n\
                0.2, 000004, 1, 2, 3, 0, 0, 0, 1, , , , \n";
    std::fs::write(dir.path().join("odometry.csv"), rows).unwrap();
    std::fs::write(dir.path().join("camera_matrix.csv"), "20, 0, 7.5\n0, 20, 5.5\n0, 0, 1").unwrap();
    for i in [0, 4] {
        let path = dir.path().join(format!("rgb/{i:06}.png"));
        mb_image::write_rgb_png(path, &RgbImage::filled(SIZE, [9; 3])).unwrap();
    }
    let mut npy = b"\x93NUMPY\x01\x00\x46\x00{'descr': '<u2', 'fortran_order': False, 'shape': (2, 3), }".to_vec();
    npy.resize(10 + 0x46 - 1, b' ');
    npy.push(b'\n');
    npy.extend([1, 2, 1, 2, 1, 2, 1, 2, 1, 2, 1, 2]);
    std::fs::write(dir.path().join("depth/000000.npy"), npy).unwrap();
    fuzz(dir.path(), "odometry.csv", 120);
    fuzz(dir.path(), "camera_matrix.csv", 40);
    fuzz(dir.path(), "depth/000000.npy", 80);
}

#[test]
fn arkit_and_opensfm_documents_and_seven_scenes_poses() {
    let dir = tempfile::tempdir().unwrap();
    let photo = RgbImage::filled(SIZE, [9; 3]);
    let arkit = dir.path().join("arkit");
    mb_image::write_jpeg(arkit.join("frame_00010.jpg"), &photo, 80).unwrap();
    let json = r#"{"cameraPoseARFrame":[1,0,0,0.1,0,0,1,0.5,0,-1,0,0.2,0,0,0,1],"intrinsics":[20,0,7.5,0,20,5.5,0,0,1],"time":3.5}"#;
    // A second one, so that the damaged file is not what the format is known by.
    mb_image::write_jpeg(arkit.join("frame_00011.jpg"), &photo, 80).unwrap();
    std::fs::write(arkit.join("frame_00010.json"), json).unwrap();
    std::fs::write(arkit.join("frame_00011.json"), json).unwrap();
    fuzz(&arkit, "frame_00011.json", 80);

    let opensfm = dir.path().join("opensfm");
    mb_image::write_jpeg(opensfm.join("images/01.jpg"), &photo, 80).unwrap();
    let json = r#"[{"cameras":{"c":{"projection_type":"perspective","width":16,"height":12,"focal":0.9,"k1":0.01,"k2":-0.02}},
        "shots":{"01.jpg":{"rotation":[1.0,-0.3,0.5],"translation":[0.5,24.7,-20.5],"camera":"c","capture_time":1.5}}}]"#;
    std::fs::write(opensfm.join("reconstruction.json"), json).unwrap();
    fuzz(&opensfm, "reconstruction.json", 80);

    let scene = dir.path().join("scene");
    mb_image::write_jpeg(scene.join("frame-000000.color.jpg"), &photo, 80).unwrap();
    std::fs::write(scene.join("frame-000000.pose.txt"), "1 0 0 0\n0 1 0 0\n0 0 1 0.5\n0 0 0 1\n").unwrap();
    std::fs::write(scene.join("camera-intrinsics.txt"), "20 0 7.5\n0 20 5.5\n0 0 1\n").unwrap();
    fuzz(&scene, "frame-000000.pose.txt", 60);
    fuzz(&scene, "camera-intrinsics.txt", 40);
}

#[test]
fn files_that_are_missing_renamed_shuffled_or_of_the_wrong_size_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("seq");
    let attempt = |name: &str| {
        let out = dir.path().join(name);
        import(&source, None, &out, &ImportOptions::default(), &Silent)
    };
    let fresh = || {
        let _ = std::fs::remove_dir_all(&source);
        sequence(&source);
    };
    // Missing and renamed files: the frame is left out, with the reason.
    fresh();
    std::fs::remove_file(source.join("pose/000001.txt")).unwrap();
    std::fs::rename(source.join("intrinsic/000002.txt"), source.join("intrinsic/000009.txt")).unwrap();
    let summary = attempt("missing").unwrap();
    let told: Vec<_> = summary.frames_skipped.iter().map(|s| format!("{}: {}", s.frame, s.reason)).collect();
    assert_eq!(told, ["000001: has no pose", "000002: has no intrinsics", "000009: has no pose"]);
    // A photograph of another size: left out, with both sizes.
    fresh();
    let other = RgbImage::filled(ImageSize::new(20, 12), [9; 3]);
    mb_image::write_jpeg(source.join("image/000001.jpg"), &other, 80).unwrap();
    let summary = attempt("size").unwrap();
    assert_eq!(summary.frames_skipped[0].reason, "the photograph is 20x12, those before it are 16x12");
    // Confidence of another size than its depth, depth that is a photograph, and files swapped: errors that name the frame.
    fresh();
    let confidence = mb_image::Confidence::filled(ImageSize::new(4, 4), 2);
    mb_image::write_confidence_png(source.join("arkit_depth/000001_conf.png"), &confidence).unwrap();
    let message = attempt("confidence").unwrap_err().to_string();
    assert!(message.contains("frame 000001") && message.contains("4x4"), "{message}");
    fresh();
    mb_image::write_rgb_png(source.join("arkit_depth/000002.png"), &other).unwrap();
    let message = attempt("depth").unwrap_err().to_string();
    assert!(message.contains("arkit_depth/000002.png: frame 000002") && message.contains("16-bit"), "{message}");
    fresh();
    std::fs::copy(source.join("pose/000001.txt"), source.join("intrinsic/000001.txt")).unwrap();
    let message = attempt("swapped").unwrap_err().to_string();
    assert!(message.contains("intrinsic/000001.txt"), "{message}");
}
