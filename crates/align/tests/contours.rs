//! `align refine` and `align bundle` on photographs of coloured boxes, made by the renderer.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

mod capture;

use capture::{boxes, capture, errors};
use mb_align::{BundleOptions, RefineOptions, align_bundle, align_refine};
use mb_capture::{Alignment, AlignmentStage, Sequence, read_pose_txt, write_pose_txt};
use mb_geometry::Rigid3;
use mb_job::{Error, Silent};
use mb_mesh::write_mesh;
use nalgebra::{Point3, Vector3};

#[test]
fn edges_and_bundle_bring_the_object_into_every_camera() {
    let dir = tempfile::tempdir().unwrap();
    let truth = capture(dir.path(), 6.0, 2.5);
    let (start_mm, _) = errors(dir.path(), &truth);
    assert!(start_mm > 5.0);

    let sequence = Sequence::open(dir.path()).unwrap();
    let refined = align_refine(&sequence, &RefineOptions::default(), &Silent).unwrap();
    let (mm, deg) = errors(dir.path(), &truth);
    // A pixel is 0.7 mm wide at the object; edges are found to a small share of it, depth to several times less.
    assert!(mm < 0.6 && deg < 0.3, "{mm} mm, {deg} deg, {refined:?}");
    assert!(refined.confidence > 0.3, "{refined:?}");
    assert!(dir.path().join("alignment/overlays/000000.jpg").exists());

    let phone = std::fs::read(dir.path().join("pose/000003.txt")).unwrap();
    let bundled = align_bundle(&sequence, &BundleOptions::default(), &Silent).unwrap();
    let (bundle_mm, bundle_deg) = errors(dir.path(), &truth);
    assert!(bundle_mm < 0.6 && bundle_deg < 0.3, "{bundle_mm} mm, {bundle_deg} deg, {bundled:?}");
    assert_eq!(std::fs::read(dir.path().join("pose_arkit/000003.txt")).unwrap().len(), phone.len());
    assert!(dir.path().join("alignment/bundle.json").exists());
    let alignment = sequence.read_alignment().unwrap();
    assert_eq!(alignment.stage, AlignmentStage::Bundle);
    assert!(alignment.frames.iter().all(|f| f.covariance.is_some()));

    // What pose/ says now is what the alignment says, and a second run starts from the phone's own poses.
    let again = Sequence::open(dir.path()).unwrap();
    for (frame, aligned) in again.frames().iter().zip(&alignment.frames) {
        assert!((frame.world_from_cam.inverse() * aligned.world_from_cam).log().norm() < 1e-9);
    }
    align_bundle(&again, &BundleOptions::default(), &Silent).unwrap();
    let (twice_mm, _) = errors(dir.path(), &truth);
    assert!(twice_mm < 0.6, "{twice_mm}");
}

/// The others settle first: their small residuals must not shut out the edges of the one that is still far off.
#[test]
fn a_frame_that_drifted_further_than_the_others_settles_too() {
    let dir = tempfile::tempdir().unwrap();
    let truth = capture(dir.path(), 1.0, 0.5);
    let path = dir.path().join("pose/000005.txt");
    let (world_from_cam, _) = read_pose_txt(&path).unwrap();
    let across = world_from_cam.rotate(&Vector3::new(0.009, 0.006, 0.0));
    write_pose_txt(&path, &(Rigid3::from_translation(across) * world_from_cam)).unwrap();

    let sequence = Sequence::open(dir.path()).unwrap();
    align_refine(&sequence, &RefineOptions::default(), &Silent).unwrap();
    let (mm, deg) = errors(dir.path(), &truth);
    assert!(mm < 0.6 && deg < 0.3, "{mm} mm, {deg} deg");
}

#[test]
fn another_model_is_refused_and_the_alignment_stays() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path(), 1.0, 0.5);
    let before = std::fs::read(dir.path().join(Alignment::FILE)).unwrap();
    let mut other = boxes();
    other.vertices.iter_mut().for_each(|v| *v = Point3::new(1.7 * v.z, 0.4 * v.x + 0.1, 0.6 * v.y));
    write_mesh(dir.path().join("model/mesh.ply"), &other).unwrap();
    let sequence = Sequence::open(dir.path()).unwrap();
    let refused = align_refine(&sequence, &RefineOptions::default(), &Silent);
    assert!(matches!(refused, Err(Error::Failed(_))), "{refused:?}");
    assert_eq!(std::fs::read(dir.path().join(Alignment::FILE)).unwrap(), before);
}
