//! Joints other than studs: known answers on parts made of one cylinder, and real models.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::fmt::Write as _;

use mb_bricks::{CheckOptions, CheckReport, Model, PartLibrary};

/// A cylinder of radius and height 1, as the library's primitive has it, with eight sides.
fn cylinder() -> String {
    let mut text = String::from("0 FILE 4-4cyli.dat\n0 Cylinder 1.0\n0 !LDRAW_ORG Primitive\n0 BFC CERTIFY CCW\n");
    for side in 0..8 {
        let corner = |side: i32| {
            let angle = std::f64::consts::TAU * f64::from(side) / 8.0;
            (angle.cos(), angle.sin())
        };
        let ((a, b), (c, d)) = (corner(side), corner(side + 1));
        let _ = writeln!(text, "4 16 {a} 1 {b} {c} 1 {d} {c} 0 {d} {a} 0 {b}");
    }
    text + "0 NOFILE\n"
}

/// A part of one cylinder along y from 0 to `length`, as a peg or, with a box around it, as a hole.
fn part(name: &str, radius: f64, length: f64, hollow: bool) -> String {
    let statement = if hollow { "0 BFC INVERTNEXT\n" } else { "" };
    format!(
        "0 FILE {name}\n0 Test part\n0 !LDRAW_ORG Part\n0 BFC CERTIFY CCW\n{statement}\
         1 16 0 0 0 {radius} 0 0 0 {length} 0 0 0 {radius} 4-4cyli.dat\n0 NOFILE\n"
    )
}

/// A brick on the ground, the hole at its place, and the peg shifted.
fn check(peg: (f64, f64), hole: (f64, f64, bool), shift: [f64; 3], turn: &str) -> CheckReport {
    let [x, y, z] = shift;
    let text = format!(
        "0 FILE m.ldr\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 hole.dat\n1 4 {x} {y} {z} {turn} peg.dat\n0 NOFILE\n{}{}{}",
        part("hole.dat", hole.0, hole.1, hole.2),
        part("peg.dat", peg.0, peg.1, false),
        cylinder()
    );
    Model::from_text(&text, "m.mpd", None).unwrap().check(&CheckOptions::default()).unwrap()
}

const UPRIGHT: &str = "1 0 0 0 1 0 0 0 1";
const TILTED: &str = "1 0 0 0 .995 -.0998 0 .0998 .995";
const LYING: &str = "0 1 0 -1 0 0 0 0 1";

#[test]
fn pegs_in_holes_of_their_size_are_joined() {
    let joined = |peg, hole, shift, turn| {
        let report = check(peg, hole, shift, turn);
        let joints = report.joints;
        let count = joints.bars + joints.pins + joints.others;
        assert_eq!(count > 0, report.covered_parts == 2 && report.connected, "{report:?}");
        count
    };
    let hole = (4.0, 8.0, true);
    assert_eq!(joined((4.0, 20.0), hole, [0.0, -6.0, 0.0], UPRIGHT), 1);
    // A pin with play, and one that is gripped.
    assert_eq!(joined((3.5, 20.0), hole, [0.0, -6.0, 0.0], UPRIGHT), 1);
    assert_eq!(joined((4.3, 20.0), hole, [0.0, -6.0, 0.0], UPRIGHT), 1);
    // Turned over, still on the axis.
    assert_eq!(joined((4.0, 20.0), hole, [0.0, 10.0, 0.0], "1 0 0 0 -1 0 0 0 -1"), 1);
    // Too thin, too thick, beside, above, tilted, across.
    assert_eq!(joined((2.5, 20.0), hole, [0.0, -6.0, 0.0], UPRIGHT), 0);
    assert_eq!(joined((5.0, 20.0), hole, [0.0, -6.0, 0.0], UPRIGHT), 0);
    assert_eq!(joined((4.0, 20.0), hole, [1.0, -6.0, 0.0], UPRIGHT), 0);
    assert_eq!(joined((4.0, 20.0), hole, [0.0, -19.8, 0.0], UPRIGHT), 0);
    assert_eq!(joined((4.0, 20.0), hole, [0.0, -6.0, 0.0], TILTED), 0);
    assert_eq!(joined((4.0, 20.0), hole, [0.0, 4.0, 0.0], LYING), 0);
    // Two pegs on one axis are no joint unless they are fingers that meet.
    assert_eq!(joined((6.0, 20.0), (6.0, 8.0, false), [0.0, -6.0, 0.0], UPRIGHT), 0);
    assert_eq!(joined((4.0, 8.0), (4.0, 8.0, false), [0.0, -8.0, 0.0], UPRIGHT), 1);
    assert_eq!(joined((4.0, 8.0), (4.0, 8.0, false), [0.0, -10.0, 0.0], UPRIGHT), 0);
}

#[test]
fn kinds_of_joints_are_told_apart_and_do_not_collide() {
    let bar = check((4.0, 20.0), (4.0, 8.0, true), [0.0, -6.0, 0.0], UPRIGHT);
    let pin = check((6.0, 20.0), (6.0, 8.0, true), [0.0, -6.0, 0.0], UPRIGHT);
    let wheel = check((9.0, 20.0), (9.0, 8.0, true), [0.0, -6.0, 0.0], UPRIGHT);
    assert_eq!((bar.joints.bars, pin.joints.pins, wheel.joints.others), (1, 1, 1));
    for report in [bar, pin, wheel] {
        assert_eq!((report.collisions, report.unclear_overlaps), (vec![], vec![]));
        assert!(report.uncovered.is_empty() && report.notes.is_empty(), "{:?}", report.notes);
    }
}

#[test]
fn parts_without_known_joints_are_named_and_do_no_harm() {
    // A post that enters another brick without a hole for it, and stands on the ground with it.
    let report = check((4.0, 14.0), (9.0, 8.0, false), [3.0, -6.0, 0.0], UPRIGHT);
    assert_eq!((report.covered_parts, report.collisions.len()), (0, 0));
    assert_eq!((report.stable, report.connected), (Some(true), true), "{:?}", report.notes);
    assert_eq!(report.uncovered.iter().map(|part| part.count).sum::<usize>(), 2);
    assert!(report.notes.iter().any(|note| note.contains("2 of 2 parts have no known joint")), "{:?}", report.notes);
}

#[test]
fn what_only_a_joint_could_hold_is_undecided() {
    // A peg as long as a tower, far out of the middle of its hole: whether the hole grips it is not modelled.
    let leaning = check((4.0, 200.0), (4.0, 8.0, true), [0.0, 0.0, 0.0], LYING);
    // A post in the air beside another, which touches nothing.
    let apart = check((4.0, 8.0), (9.0, 8.0, false), [40.0, -20.0, 0.0], UPRIGHT);
    for report in [&leaning, &apart] {
        assert_eq!((report.stable, report.buildable), (None, None), "{report:?}");
        assert!(report.falling_parts.is_empty() && report.loose_parts.is_empty(), "{report:?}");
        assert!(report.notes.iter().any(|note| note.contains("cannot be said")), "{:?}", report.notes);
    }
    assert_eq!(apart.undecided_parts, [1]);
}

#[test]
fn official_models_make_sense() {
    let (Some(library), Some(models)) = (mb_testdata::find("ldraw/parts.zip"), mb_testdata::find("ldraw/models"))
    else {
        return;
    };
    let library = PartLibrary::open(library).unwrap();
    let (mut stand, mut fall) = (vec![], vec![]);
    let paths = std::fs::read_dir(models).unwrap().map(|entry| entry.unwrap().path());
    for path in paths.filter(|path| path.extension().is_some_and(|ending| ending == "mpd")) {
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let report = Model::read(&path, Some(&library)).unwrap().check(&CheckOptions::default()).unwrap();
        // Real products stand and can be built; what the check does not understand it must not hold against them.
        if report.stable == Some(false) {
            fall.push(format!("{name}: {:?}", report.notes));
            continue;
        }
        assert_ne!(report.buildable, Some(false), "{name}");
        assert_eq!(report.stable.is_none(), !report.undecided_parts.is_empty(), "{name}");
        // Overlaps that are left are flexible parts and inexact files: few.
        assert!(report.collisions.len() as f64 <= 0.1 * report.parts as f64, "{name}: {}", report.collisions.len());
        assert!(report.joints.bars > 0 || report.joints.others > 0, "{name}: {:?}", report.joints);
        let uncovered: usize = report.uncovered.iter().map(|part| part.count).sum();
        assert_eq!(uncovered + report.covered_parts, report.parts);
        if report.stable == Some(true) {
            stand.push(name);
        }
    }
    assert!(fall.is_empty(), "{fall:#?}");
    for name in ["1180-1-moon-buggy", "5920-1-island-racer", "21022-1-lincoln-memorial", "40448-1-vintage-car"] {
        assert!(stand.iter().any(|other| other == name), "{name} stands, and so do {stand:?}");
    }
}
