//! Damaged mesh files: a reader either returns a mesh whose indices are in range, or names what is wrong; it never panics.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use mb_mesh::{read_mesh, write_mesh};
use mb_testdata::{damaged, fuzz_cases};
use nalgebra::Point3;

const ASCII: &str = "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 4\nproperty float x\nproperty float y\n\
    property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n\
    property list uchar int vertex_indices\nend_header\n0 0 0 1 2 3\n1 0 0 4 5 6\n0 1 0 7 8 9\n0 0 1 1 1 1\n3 0 1 2\n4 0 1 2 3\n";

fn fuzz(name: &str, whole: &[u8]) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, whole).unwrap();
    assert!(read_mesh(&path).is_ok(), "the undamaged {name}");
    let mut refused = 0;
    for seed in 0..fuzz_cases(400) {
        std::fs::write(&path, damaged(whole, seed)).unwrap();
        match read_mesh(&path) {
            Ok(mesh) => {
                let count = mesh.vertices.len();
                let in_range = mesh.triangles.iter().flatten().all(|&v| (v as usize) < count);
                assert!(in_range, "{name}, seed {seed}: an index beyond the vertices");
            }
            Err(mb_job::Error::Input(e)) => {
                assert!(e.path == path, "{name}, seed {seed}: {e}");
                refused += 1;
            }
            Err(e) => panic!("{name}, seed {seed}: {e}"),
        }
    }
    assert!(refused > 0);
    println!("{name}: {refused} of {} damaged copies refused", fuzz_cases(400));
}

#[test]
fn ply_as_text() {
    fuzz("a.ply", ASCII.as_bytes());
}

#[test]
fn ply_obj_and_stl_as_written_here() {
    let dir = tempfile::tempdir().unwrap();
    let mesh = mb_mesh::TriangleMesh {
        vertices: [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(Point3::from).to_vec(),
        triangles: vec![[0, 1, 2], [0, 3, 1], [1, 3, 2]],
        ..mb_mesh::TriangleMesh::default()
    };
    for name in ["b.ply", "b.obj", "b.stl"] {
        let path = dir.path().join(name);
        write_mesh(&path, &mesh).unwrap();
        fuzz(name, &std::fs::read(&path).unwrap());
    }
}
