//! Planes that objects stand on, known in closed form.

use mb_mesh::TriangleMesh;
use mb_recon::SupportPlane;
use nalgebra::{Point3, UnitQuaternion, Vector3};
use proptest::prelude::*;

/// A rectangle of `n x n` cells, lifted by `height`.
fn sheet(
    mesh: &mut TriangleMesh,
    origin: Point3<f64>,
    u: Vector3<f64>,
    v: Vector3<f64>,
    height: impl Fn(f64, f64) -> f64,
) {
    const N: u32 = 40;
    let (first, up) = (mesh.vertices.len() as u32, u.cross(&v).normalize());
    for j in 0..=N {
        for i in 0..=N {
            let (a, b) = (f64::from(i) / f64::from(N), f64::from(j) / f64::from(N));
            mesh.vertices.push(origin + u * a + v * b + up * height(a, b));
        }
    }
    for j in 0..N {
        for i in 0..N {
            let at = first + j * (N + 1) + i;
            mesh.triangles.extend([[at, at + 1, at + N + 2], [at, at + N + 2, at + N + 1]]);
        }
    }
}

/// The four sides and the top of a block of 80 x 60 x 50 mm that stands on z = 0.
fn block(mesh: &mut TriangleMesh) {
    let (x, y, z) = (Vector3::x() * 0.08, Vector3::y() * 0.06, Vector3::z() * 0.05);
    let corner = Point3::new(-0.04, -0.03, 0.0);
    let flat = |_, _| 0.0;
    sheet(mesh, corner + z, x, y, flat);
    sheet(mesh, corner, x, z, flat);
    sheet(mesh, corner + y, z, x, flat);
    sheet(mesh, corner, z, y, flat);
    sheet(mesh, corner + x, y, z, flat);
}

fn table(mesh: &mut TriangleMesh, roughness: f64) {
    let corner = Point3::new(-0.12, -0.1, 0.0);
    sheet(mesh, corner, Vector3::x() * 0.24, Vector3::y() * 0.2, |a, b| {
        roughness * 2f64.sqrt() * (31.0 * a).sin() * 2f64.sqrt() * (23.0 * b).cos()
    });
}

/// Cameras on a ring above the table.
fn ring() -> Vec<Point3<f64>> {
    (0..8).map(|i| f64::from(i) * 0.7).map(|a| Point3::new(0.3 * a.cos(), 0.3 * a.sin(), 0.2)).collect()
}

proptest! {
    /// However the world lies, the table is found, and the cut leaves the block.
    #[test]
    fn a_table_is_found_in_any_frame(
        axis in proptest::array::uniform3(-3.0..3.0f64),
        shift in proptest::array::uniform3(-2.0..2.0f64),
        roughness_mm in 0.0..1.0f64,
    ) {
        let (turn, shift) = (UnitQuaternion::from_scaled_axis(Vector3::from(axis)), Vector3::from(shift));
        let place = |p: &Point3<f64>| turn * p + shift;
        let mut mesh = TriangleMesh::default();
        block(&mut mesh);
        let of_block = mesh.triangles.len();
        table(&mut mesh, roughness_mm * 1e-3);
        mesh.vertices.iter_mut().for_each(|v| *v = place(v));
        let cameras: Vec<_> = ring().iter().map(place).collect();
        let plane = SupportPlane::find(&mesh, &cameras).expect("a table");
        prop_assert!(plane.normal.dot(&(turn * Vector3::z())) > 0.9999, "{plane:?}");
        prop_assert!(plane.height(&place(&Point3::origin())).abs() < 5e-4, "{plane:?}");
        // The foot of the block is seen beside the table and lies on it too.
        prop_assert!((plane.roughness_m * 1e3 - roughness_mm).abs() < 0.35, "{plane:?} {roughness_mm}");
        plane.cut(&mut mesh, 4e-3);
        prop_assert!(mesh.vertices.iter().all(|v| plane.height(v) >= 4e-3));
        prop_assert!(mesh.triangles.len() > of_block * 3 / 4 && mesh.triangles.len() < of_block);
    }
}

#[test]
fn nothing_is_cut_where_nothing_stands_on_a_plane() {
    let find = |build: &dyn Fn(&mut TriangleMesh)| {
        let mut mesh = TriangleMesh::default();
        build(&mut mesh);
        SupportPlane::find(&mesh, &ring())
    };
    assert_eq!(find(&|_| ()), None);
    // The top of a block has its sides below it, and cameras stand on both sides of those.
    assert_eq!(find(&|mesh| block(mesh)), None);
    // A table with nothing on it is what was photographed.
    assert_eq!(find(&|mesh| table(mesh, 1e-4)), None);
    // No cameras, one triangle, no area.
    let mut mesh = TriangleMesh::default();
    table(&mut mesh, 0.0);
    assert_eq!(SupportPlane::find(&mesh, &[]), None);
    let flat = TriangleMesh::new(vec![Point3::origin(); 3], vec![[0, 1, 2]]);
    assert_eq!(SupportPlane::find(&flat, &ring()), None);
}
