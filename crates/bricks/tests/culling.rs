//! Back-face culling statements: every triangle of a mesh faces outwards, whatever the file did to it.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use mb_bricks::{MeshOptions, Model};

/// A unit square in the plane y = 0 that faces up (-y), seen counter-clockwise.
const UP: &str = "4 16 0 0 0 1 0 0 1 0 1 0 0 1";

/// The upward (+y in the object frame) parts of the triangles' normals, by sign.
fn facings(model: &str) -> Vec<f64> {
    let model = Model::from_text(model, "m.mpd", None).unwrap();
    let mesh = model.mesh(&MeshOptions::default());
    (0..mesh.triangles.len()).map(|t| mesh.scaled_normal(t).y.signum()).collect()
}

#[track_caller]
fn check(part: &str, placement: &str, expected: f64) {
    let model = format!("0 FILE m.ldr\n{placement} part.dat\n0 FILE part.dat\n0 Part\n{part}\n");
    assert_eq!(facings(&model), [expected; 2], "{model}");
}

const PLAIN: &str = "1 4 0 0 0 1 0 0 0 1 0 0 0 1";
const MIRRORED: &str = "1 4 0 0 0 -1 0 0 0 1 0 0 0 1";
const UPSIDE_DOWN: &str = "1 4 0 0 0 1 0 0 0 -1 0 0 0 1";

#[test]
fn windings_follow_statements_and_mirrors() {
    check(&format!("0 BFC CERTIFY CCW\n{UP}"), PLAIN, 1.0);
    check(&format!("0 BFC CERTIFY CW\n{UP}"), PLAIN, -1.0);
    check(&format!("0 BFC CERTIFY CCW\n0 BFC CW\n{UP}"), PLAIN, -1.0);
    // A mirror changes nothing about which side is out.
    check(&format!("0 BFC CERTIFY CCW\n{UP}"), MIRRORED, 1.0);
    check(&format!("0 BFC CERTIFY CCW\n{UP}"), UPSIDE_DOWN, -1.0);
    check(&format!("0 BFC CERTIFY CCW\n{UP}"), &format!("0 BFC INVERTNEXT\n{PLAIN}"), -1.0);
    check(&format!("0 BFC CERTIFY CCW\n{UP}"), &format!("0 BFC INVERTNEXT\n{MIRRORED}"), -1.0);
}

#[test]
fn invertnext_is_spent_on_the_next_reference_even_when_that_is_missing() {
    let part = format!("0 BFC CERTIFY CCW\n{UP}");
    check(&part, &format!("0 BFC INVERTNEXT\n{PLAIN} nowhere.dat\n{PLAIN}"), 1.0);
    check(&part, &format!("0 BFC INVERTNEXT\n1 4 broken line\n{PLAIN}"), 1.0);
    check(&part, &format!("0 BFC INVERTNEXT\n0 a comment between\n\n{PLAIN}"), -1.0);
}

#[test]
fn inversions_add_up_over_levels() {
    let piece = format!("0 FILE piece.dat\n0 !LDRAW_ORG Subpart\n0 BFC CERTIFY CCW\n{UP}\n");
    for (first, second, expected) in
        [("", "", 1.0), ("0 BFC INVERTNEXT", "", -1.0), ("0 BFC INVERTNEXT", "0 BFC INVERTNEXT", 1.0)]
    {
        let model = format!(
            "0 FILE m.ldr\n{first}\n{MIRRORED} part.dat\n0 FILE part.dat\n0 Part\n0 BFC CERTIFY CCW\n{second}\n{MIRRORED} piece.dat\n{piece}"
        );
        assert_eq!(facings(&model), [expected; 2]);
    }
}

#[test]
fn uncertified_and_unclipped_triangles_are_counted() {
    let count = |statements: &str| {
        let text = format!("0 FILE m.ldr\n{PLAIN} part.dat\n0 FILE part.dat\n0 Part\n{statements}\n{UP}\n");
        Model::from_text(&text, "m.mpd", None).unwrap().info().two_sided_triangles
    };
    assert_eq!(count("0 BFC CERTIFY CCW"), 0);
    assert_eq!(count("0 BFC NOCERTIFY"), 2);
    assert_eq!(count(""), 2);
    assert_eq!(count("0 BFC CERTIFY CCW\n0 BFC NOCLIP"), 2);
    assert_eq!(count("0 BFC CERTIFY CCW\n0 BFC NOCLIP\n0 BFC CLIP CCW"), 0);
    let below = |statement: &str| {
        let text = format!(
            "0 FILE m.ldr\n{PLAIN} part.dat\n0 FILE part.dat\n0 Part\n{statement}\n{PLAIN} piece.dat\n0 FILE piece.dat\n\
             0 !LDRAW_ORG Subpart\n0 BFC CERTIFY CCW\n{UP}\n"
        );
        Model::from_text(&text, "m.mpd", None).unwrap().info().two_sided_triangles
    };
    assert_eq!((below("0 BFC CERTIFY CCW"), below("0 BFC NOCERTIFY"), below("0 BFC NOCLIP")), (0, 2, 2));
}

#[test]
fn textured_branches_are_replaced_by_their_fallback() {
    let text = format!(
        "0 !TEXMAP START PLANAR 0 0 0 1 0 0 0 0 1 a.png\n0 !: {UP}\n{UP}\n0 !TEXMAP FALLBACK\n{UP}\n0 !TEXMAP END\n"
    );
    let model = Model::from_text(&text, "m.ldr", None).unwrap();
    // The lines without `!:` before and after FALLBACK: the first is drawn by everyone.
    assert_eq!(model.info().triangles, 4);
    assert!(model.warnings()[0].contains("line 1: the texture a.png is not drawn"));
}

#[test]
fn side_walls_stand_back_by_the_clearance_and_studs_do_not() {
    let model = Model::from_text(&format!("{PLAIN} 3001.dat\n"), "m.ldr", None).unwrap();
    let mesh = model.mesh(&MeshOptions { clearance_mm: 0.1 });
    let size_mm = mesh.bounds().extent() * 1e3;
    for (found, expected) in size_mm.iter().zip([31.8, 11.2, 15.8]) {
        assert!((found - expected).abs() < 1e-9, "{size_mm}");
    }
    let nominal = model.mesh(&MeshOptions::default());
    let studs =
        |mesh: &mb_mesh::TriangleMesh| -> Vec<_> { mesh.vertices.iter().filter(|p| p.y > 1e-6).copied().collect() };
    assert_eq!(studs(&mesh), studs(&nominal));
    // The corner's notch is an outer wall too.
    let corner = Model::from_text(&format!("{PLAIN} 2357.dat\n"), "m.ldr", None).unwrap();
    let mesh = corner.mesh(&MeshOptions { clearance_mm: 0.1 });
    let notch =
        mesh.vertices.iter().filter(|p| p.x > 0.005 && p.z < -0.002).map(|p| p.z).fold(f64::NEG_INFINITY, f64::max);
    assert!(notch < 0.0, "{notch}");
    assert!(mesh.vertices.iter().any(|p| (p.z + 0.0039).abs() < 1e-9 && p.x > 0.0041));
}
