//! Pictures of surfaces and of their errors, all of one sequence from the same places.

use mb_eval::{SurfaceTruth, vertex_distances_mm};
use mb_geometry::{ImageSize, World};
use mb_image::RgbImage;
use mb_mesh::TriangleMesh;
use mb_render::{ShadeOptions, heat_colors, over, shade, three_quarter_view};
use nalgebra::Vector3;

/// Colours of all heat maps end here, millimetres: the larger of the two published thresholds.
pub(crate) const HEAT_LIMIT_MM: f64 = 5.0;
/// What lies behind a surface.
const PAPER: [u8; 3] = [244, 246, 249];

/// A place to photograph surfaces of one sequence.
pub(crate) struct Studio<'a> {
    /// What they are compared with, and where they can be judged.
    pub truth: &'a SurfaceTruth,
    /// Up in the world.
    pub up: Vector3<f64>,
    /// Size of the pictures.
    pub size: ImageSize,
}

impl Studio<'_> {
    /// A surface from a place around the object; `azimuth` in radians.
    pub fn look(&self, mesh: &TriangleMesh, azimuth: f64, smooth: bool) -> RgbImage {
        let view = three_quarter_view::<World>(&self.truth.mesh.bounds(), &self.up, self.size, azimuth, 0.45);
        let options = ShadeOptions { up: self.up, smooth, ground: false, ..ShadeOptions::default() };
        over(&shade(mesh, &view, &options), PAPER)
    }

    /// The triangles of which every corner can be judged: without the table around and whatever lies behind.
    pub fn judged_part(&self, mesh: TriangleMesh) -> TriangleMesh {
        let inside: Vec<bool> = mesh.vertices.iter().map(|p| self.truth.visibility.contains(p)).collect();
        let keep: Vec<bool> = mesh.triangles.iter().map(|t| t.iter().all(|&v| inside[v as usize])).collect();
        let mut judged = mesh;
        judged.retain_triangles(&keep);
        judged
    }
}

/// The surface `mesh` coloured by its distance from `against`, 0 to [`HEAT_LIMIT_MM`].
pub(crate) fn heated(mesh: &TriangleMesh, against: &TriangleMesh) -> TriangleMesh {
    let distances: Vec<f64> = vertex_distances_mm(mesh, against).into_iter().map(f64::from).collect();
    let colors = heat_colors(&distances, 0.0, HEAT_LIMIT_MM);
    TriangleMesh { vertex_colors: Some(colors), triangle_colors: None, ..mesh.clone() }
}
