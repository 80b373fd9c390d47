//! The site of scores: every link leads somewhere, nothing is drawn twice, and what is missing is named.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::{Path, PathBuf};

use mb_capture::VisibilityVolume;
use mb_eval::{SurfaceOptions, SurfaceProtocol, evaluate_surface_method};
use mb_job::Silent;
use mb_mesh::{TriangleMesh, write_mesh};
use mb_pipeline::{LeaderboardOptions, leaderboard};
use nalgebra::{Point3, Vector3};

/// A box of 8 x 6 x 4 cm, each face a grid of 8 x 8 squares.
fn box_mesh() -> TriangleMesh {
    let size = Vector3::new(0.08, 0.06, 0.04);
    let mut mesh = TriangleMesh::default();
    for (axis, side) in [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0), (2, -1.0), (2, 1.0)] {
        let first = mesh.vertices.len() as u32;
        for (i, j) in (0..81).map(|k| (k / 9, k % 9)) {
            let mut corner = Vector3::zeros();
            corner[axis] = side / 2.0;
            corner[(axis + 1) % 3] = f64::from(i) / 8.0 - 0.5;
            corner[(axis + 2) % 3] = side * (f64::from(j) / 8.0 - 0.5);
            mesh.vertices.push(Point3::from(corner.component_mul(&size)));
        }
        for (i, j) in (0..64).map(|k| (k / 8, k % 8)) {
            let at = |i: u32, j: u32| first + 9 * i + j;
            mesh.triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
            mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    mesh
}

fn sequence(folder: &Path) {
    write_mesh(folder.join("mesh/gt_mesh.ply"), &box_mesh()).unwrap();
    VisibilityVolume {
        mask: vec![true; 50 * 50 * 50],
        resolutions: [50; 3],
        voxel_size_m: 0.0025,
        min_pt_in_world: Point3::new(-0.06125, -0.06125, -0.06125),
    }
    .write(folder.join("visibility_mask.npy"))
    .unwrap();
}

/// Two methods on three sequences, one of which the second lacks; their documents.
fn scored(dir: &Path) -> Vec<(Option<String>, PathBuf)> {
    let list = ["audi", "big ben", "cabin"].map(str::to_owned);
    for name in &list {
        sequence(&dir.join("data").join(name));
    }
    let mut documents = Vec::new();
    for (method, grow) in [("good & true", 1.01), ("bad", 1.1)] {
        for name in list.iter().filter(|name| method != "bad" || *name != "cabin") {
            let mut mesh = box_mesh();
            mesh.vertices.iter_mut().for_each(|v| v.coords *= grow);
            write_mesh(dir.join("meshes").join(method).join(format!("{name}.ply")), &mesh).unwrap();
        }
        for protocol in [SurfaceProtocol::MobileBrick2023, SurfaceProtocol::Exact1] {
            let options = SurfaceOptions { protocol, points: 2000, ..SurfaceOptions::default() };
            let meshes = dir.join("meshes").join(method);
            let table = evaluate_surface_method(method, &meshes, &dir.join("data"), &list, &options, &Silent).unwrap();
            let out = dir.join("scores").join(format!("{method}-{protocol}"));
            table.write(&out).unwrap();
            documents.push((None, out.join("scores.json")));
        }
    }
    documents
}

/// Targets of `href` and `src` in a page.
fn links(page: &str) -> Vec<String> {
    let parts = page.split("href=\"").skip(1).chain(page.split("src=\"").skip(1));
    parts.map(|rest| rest.split('"').next().unwrap().to_owned()).collect()
}

#[test]
fn every_link_leads_somewhere_and_nothing_is_drawn_twice() {
    let dir = tempfile::tempdir().unwrap();
    let documents = scored(dir.path());
    let site = dir.path().join("site");
    let options = LeaderboardOptions::default();
    let summary = leaderboard(&documents, &site, &options, &Silent).unwrap();
    assert_eq!(summary.sequences, ["audi", "big ben", "cabin"]);
    assert_eq!(summary.ranking[0].methods, ["good & true", "bad"]);
    assert!(summary.warnings.is_empty(), "{:?}", summary.warnings);
    // The same box everywhere: one picture of the truth, three of each method's.
    assert_eq!(summary.pictures_drawn, 7);
    for page in ["index.html", "sequences/audi.html", "sequences/big_ben.html", "sequences/cabin.html"] {
        let path = site.join(page);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains("http"), "{page} must not reach for the network");
        for link in links(&text).iter().filter(|l| !l.starts_with('#')) {
            assert!(path.parent().unwrap().join(link).exists(), "{page} links to {link}");
        }
        assert!(text.contains("good &amp; true"), "{page}");
    }
    let cabin = std::fs::read_to_string(site.join("sequences/cabin.html")).unwrap();
    assert!(cabin.contains("no prediction for this sequence"), "what is missing is named");
    let index = std::fs::read_to_string(&summary.index).unwrap();
    assert!(index.contains("BNV-Fusion, F1 2.5 mm %: impossible."));
    assert!(index.contains("2 of 3 sequences"));

    let again = leaderboard(&documents, &site, &options, &Silent).unwrap();
    assert_eq!(again.pictures_drawn, 0);
    // A mesh that has changed since it was scored is not shown beside its old score.
    std::fs::write(dir.path().join("meshes/bad/audi.ply"), "changed").unwrap();
    let changed = leaderboard(&documents, &site, &options, &Silent).unwrap();
    assert!(changed.warnings[0].contains("has changed since it was scored"), "{:?}", changed.warnings);
}
