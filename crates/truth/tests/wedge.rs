//! Ground truth of a published-layout sequence, made again from its exact mesh and cameras.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::{Alignment, AlignmentStage, Sequence, VisibilityVolume};
use mb_geometry::{Camera, Rigid3, World};
use mb_job::Silent;
use mb_mesh::{Bvh, read_mesh, sample_uniform, write_mesh};
use mb_render::View;
use mb_truth::{ExactScene, PoseStudyOptions, TruthOptions, perturbed_pose_study, truth, visibility};
use nalgebra::Vector6;

/// A sequence with the wedge's cameras (every `every`-th), its exact mesh as the model, and an alignment that keeps it
/// in place.
fn aligned_wedge(wedge: &Path, folder: &Path, every: usize) -> Sequence {
    let published = Sequence::open(wedge).unwrap();
    for frame in published.frames().iter().step_by(every) {
        let name = format!("{}.txt", frame.id);
        for part in ["pose", "intrinsic"] {
            std::fs::create_dir_all(folder.join(part)).unwrap();
            std::fs::copy(wedge.join(part).join(&name), folder.join(part).join(&name)).unwrap();
        }
    }
    write_mesh(folder.join("model/mesh.ply"), &read_mesh(wedge.join("mesh/cad_mesh.ply")).unwrap()).unwrap();
    let alignment = Alignment {
        version: 1,
        stage: AlignmentStage::Truth,
        world_from_object: Rigid3::identity(),
        object_covariance: None,
        rms_px: None,
        frames: Vec::new(),
    };
    alignment.write(folder.join(Alignment::FILE)).unwrap();
    Sequence::open(folder).unwrap()
}

#[test]
fn the_wedge_comes_out_as_published() {
    let Some(wedge) = mb_testdata::find("official_scorer/wedge") else { return };
    let dir = tempfile::tempdir().unwrap();
    let sequence = aligned_wedge(&wedge, dir.path(), 4);
    let summary = truth(&sequence, &TruthOptions::default(), &Silent).unwrap();
    assert_eq!(summary.frames, 10);
    assert_eq!(summary.warnings, Vec::<String>::new());
    assert!(summary.visible_area_mm2 < 0.5 * summary.model_area_mm2, "inner walls are not seen");

    // Depth and masks: equal but for rounding to millimetres, and for silhouettes that another renderer cut differently.
    let published = Sequence::open(&wedge).unwrap();
    let (mut off_mm, mut object, mut mask_differs) = (0usize, 0usize, 0usize);
    for frame in sequence.frames() {
        let (ours, theirs) = (sequence.read_gt_depth(frame).unwrap(), published.read_gt_depth(frame).unwrap());
        for (a, b) in ours.data().iter().zip(theirs.data()) {
            object += usize::from(*b > 0.0);
            mask_differs += usize::from((*a > 0.0) != (*b > 0.0));
            off_mm += usize::from(*a > 0.0 && *b > 0.0 && (a - b).abs() > 1.5e-3);
        }
        let mask = sequence.read_mask(frame).unwrap();
        assert!(mask.data().iter().zip(ours.data()).all(|(m, z)| *m == (*z > 0.0)));
    }
    assert!(object > 1_000_000);
    assert!(mask_differs * 2000 < object, "{mask_differs} of {object} mask pixels differ");
    assert!(off_mm * 2000 < object, "{off_mm} of {object} depths are more than 1.5 mm off");

    // The published mesh is a fusion of the same surface with larger voxels, from four times as many frames.
    let gt_mesh = read_mesh(sequence.gt_mesh_path()).unwrap();
    let theirs = read_mesh(published.gt_mesh_path()).unwrap();
    let exact = Bvh::new(&read_mesh(wedge.join("mesh/cad_mesh.ply")).unwrap());
    let fused = Bvh::new(&gt_mesh);
    let mean = |bvh: &Bvh, mesh: &mb_mesh::TriangleMesh| {
        let samples = sample_uniform(mesh, 20_000, 0);
        samples.iter().map(|s| bvh.closest(&s.point).unwrap().distance).sum::<f64>() / 20_000.0
    };
    let (to_exact, from_theirs) = (mean(&exact, &gt_mesh), mean(&fused, &theirs));
    assert!(to_exact < 0.2e-3, "gt_mesh lies {:.3} mm from the exact surface", to_exact * 1e3);
    assert!(from_theirs < 1e-3, "the published gt_mesh lies {:.3} mm from ours", from_theirs * 1e3);

    // The visible surface is the model's own.
    let visible = read_mesh(sequence.visible_surface_path()).unwrap();
    let worst = visible.vertices.iter().map(|p| exact.closest(p).unwrap().distance).fold(0.0, f64::max);
    assert!(worst < 1e-9, "a vertex of the visible surface lies {worst} m off the model");

    // Rounded files against the depth behind them.
    let scene = ExactScene::open(&sequence).unwrap();
    let frame = &scene.frames[0];
    let (exact_depth, rounded) = (scene.render(frame).depth, sequence.read_gt_depth(frame).unwrap());
    assert!(exact_depth.data().iter().zip(rounded.data()).all(|(a, b)| (a - b).abs() < 0.501e-3));
}

#[test]
fn a_motion_that_all_cameras_share_costs_nothing_and_errors_between_them_do() {
    let Some(wedge) = mb_testdata::find("official_scorer/wedge") else { return };
    let dir = tempfile::tempdir().unwrap();
    let scene = ExactScene::open(&aligned_wedge(&wedge, dir.path(), 8)).unwrap();
    let options = PoseStudyOptions { voxel_size_mm: 2.0, samples: 20_000, ..PoseStudyOptions::default() };
    let study = |perturb: &dyn Fn(f64) -> Vector6<f64>| {
        let poses: Vec<Rigid3<World, Camera>> = (0..)
            .zip(&scene.frames)
            .map(|(i, f)| Rigid3::<World, World>::exp(&perturb(f64::from(i))) * f.world_from_cam)
            .collect();
        perturbed_pose_study(&scene, &poses, &options, &Silent).unwrap()
    };
    let common = study(&|_| Vector6::new(0.03, -0.02, 0.05, 0.01, 0.02, -0.015));
    assert!(common.camera_rmse_mm < 1e-6 && common.camera_mean_deg < 1e-6, "{common:?}");
    assert!(common.accuracy > 0.9999 && common.recall > 0.9999, "{common:?}");

    // Every second camera 4 mm to the right, the others 4 mm to the left.
    let apart = study(&|i| Vector6::new(0.0, 0.0, 0.0, if i % 2.0 == 0.0 { 0.004 } else { -0.004 }, 0.0, 0.0));
    assert!((3.0..5.0).contains(&apart.camera_rmse_mm), "{apart:?}");
    assert!(apart.accuracy < 0.9 && apart.recall < 0.9, "{apart:?}");
}

#[test]
fn the_visibility_volume_of_the_published_depth_is_the_published_one() {
    let Some(wedge) = mb_testdata::find("official_scorer/wedge") else { return };
    let published = VisibilityVolume::read(wedge.join("visibility_mask.npy")).unwrap();
    let sequence = Sequence::open(&wedge).unwrap();
    let bounds = read_mesh(wedge.join("mesh/cad_mesh.ply")).unwrap().bounds();
    let mut ours = visibility::empty_volume(&bounds, 0.02, 0.0025).unwrap();
    assert_eq!(ours.resolutions, published.resolutions);
    assert!((ours.min_pt_in_world - published.min_pt_in_world).norm() < 1e-9);
    for frame in sequence.frames() {
        let depth = sequence.read_gt_depth(frame).unwrap();
        let cam_from_frame = frame.world_from_cam.inverse();
        let view = View { intrinsics: frame.intrinsics, size: depth.size(), cam_from_frame };
        visibility::observe(&mut ours, &depth, &view);
    }
    // The published depth is rounded to millimetres, the volume was made before: a few voxels lie that close to the edge.
    let differ = ours.mask.iter().zip(&published.mask).filter(|(a, b)| a != b).count();
    eprintln!("{differ} of {} voxels differ", ours.mask.len());
    assert!(differ * 1000 < ours.mask.len(), "{differ} of {} voxels differ", ours.mask.len());
}

#[test]
fn what_is_missing_or_in_the_wrong_unit_is_named() {
    let Some(wedge) = mb_testdata::find("official_scorer/wedge") else { return };
    let dir = tempfile::tempdir().unwrap();
    let sequence = aligned_wedge(&wedge, dir.path(), 20);
    let fails = || truth(&sequence, &TruthOptions::default(), &Silent).unwrap_err().to_string();

    let mesh = read_mesh(sequence.model_mesh_path()).unwrap();
    let mut in_millimetres = mesh.clone();
    in_millimetres.vertices.iter_mut().for_each(|v| *v *= 1000.0);
    write_mesh(sequence.model_mesh_path(), &in_millimetres).unwrap();
    assert!(fails().contains("millimetres"), "{}", fails());

    let mut behind = mesh.clone();
    behind.vertices.iter_mut().for_each(|v| v.y += 15.0);
    write_mesh(sequence.model_mesh_path(), &behind).unwrap();
    assert!(fails().contains("no frame"), "{}", fails());

    std::fs::remove_file(sequence.model_mesh_path()).unwrap();
    assert!(fails().contains("model"), "{}", fails());
    write_mesh(sequence.model_mesh_path(), &mesh).unwrap();
    std::fs::remove_file(dir.path().join(Alignment::FILE)).unwrap();
    assert!(fails().contains("align keypoints"), "{}", fails());
}
