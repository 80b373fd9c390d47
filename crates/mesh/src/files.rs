//! Mesh files of any kind.

use std::fs;
use std::path::Path;

use mb_job::{Error, InputError, Result};
use nalgebra::Point3;

use crate::{TriangleMesh, glb, obj, ply, stl};

/// What a lenient reader left out of a mesh.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Vertices with a coordinate that is not finite.
    pub vertices: usize,
    /// Triangles with such a corner.
    pub triangles: usize,
    /// Faces with fewer than three corners.
    pub faces: usize,
}

impl Dropped {
    /// Whether the mesh is whole.
    pub fn is_nothing(&self) -> bool {
        *self == Self::default()
    }
}

impl std::fmt::Display for Dropped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let counted = |count: usize, one: &str, many: &str| match count {
            0 => None,
            1 => Some(format!("1 {one}")),
            n => Some(format!("{n} {many}")),
        };
        let parts = [
            counted(self.vertices, "vertex that is not finite", "vertices that are not finite"),
            counted(self.triangles, "triangle at such a vertex", "triangles at such vertices"),
            counted(self.faces, "face with fewer than three corners", "faces with fewer than three corners"),
        ];
        f.write_str(&parts.into_iter().flatten().collect::<Vec<_>>().join(", "))
    }
}

/// Reads a PLY, OBJ, STL or GLB file; PLY and GLB are known by their first bytes, the others by their extension.
///
/// Faces with more than three corners become fans of triangles around their first corner. Positions are taken as they
/// stand; the file's owner says in which unit.
///
/// # Errors
/// The file is missing, truncated, malformed or of another kind, or anything of it would have to be left out: a
/// coordinate that is not finite, a face with fewer than three corners.
pub fn read_mesh(path: impl AsRef<Path>) -> Result<TriangleMesh> {
    let path = path.as_ref();
    whole(path, read_mesh_lenient(path)?)
}

/// Reads like [`read_mesh`], but leaves out what cannot be used, and counts it.
///
/// # Errors
/// The file is missing, truncated, malformed or of another kind, or no vertex of it is finite.
pub fn read_mesh_lenient(path: impl AsRef<Path>) -> Result<(TriangleMesh, Dropped)> {
    let path = path.as_ref();
    let bytes = read(path)?;
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
        ply::parse(path, &bytes)
    } else if bytes.starts_with(b"glTF") {
        glb::parse(path, &bytes)
    } else {
        match extension.as_str() {
            "ply" => ply::parse(path, &bytes),
            "glb" => glb::parse(path, &bytes),
            "obj" => obj::parse(path, &bytes),
            "stl" => stl::parse(path, &bytes),
            _ => Err(InputError::new(path, "not a mesh file that can be read")
                .help("Use a PLY, OBJ, STL or GLB file")
                .into()),
        }
    }
}

/// Reads a PLY file like [`read_mesh`].
///
/// # Errors
/// As [`read_mesh`].
pub fn read_ply(path: impl AsRef<Path>) -> Result<TriangleMesh> {
    let path = path.as_ref();
    whole(path, ply::parse(path, &read(path)?)?)
}

/// Writes a mesh in the format that the extension names: `ply`, `obj`, `stl` or `glb`. The file appears whole or not at
/// all.
///
/// # Errors
/// The extension is another one, or the file cannot be written.
pub fn write_mesh(path: impl AsRef<Path>, mesh: &TriangleMesh) -> Result<()> {
    let path = path.as_ref();
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    match extension.as_str() {
        "ply" => ply::write_ply(path, mesh),
        "obj" => obj::write_obj(path, mesh),
        "stl" => stl::write_stl(path, mesh),
        "glb" => glb::write_glb(path, mesh),
        _ => Err(InputError::new(path, format!("no mesh format has the extension {extension:?}"))
            .help("Name the output .ply, .obj, .stl or .glb")
            .into()),
    }
}

fn read(path: &Path) -> Result<Vec<u8>> {
    fs::read(path).map_err(|e| InputError::unreadable(path, &e).into())
}

fn whole(path: &Path, (mesh, dropped): (TriangleMesh, Dropped)) -> Result<TriangleMesh> {
    if dropped.is_nothing() {
        Ok(mesh)
    } else {
        Err(InputError::new(path, format!("the mesh has {dropped}")).help("Clean the mesh and export it again").into())
    }
}

/// Collects what a reader finds and makes a mesh of it.
pub(crate) struct Builder<'a> {
    path: &'a Path,
    vertices: Vec<Point3<f64>>,
    vertex_colors: Vec<[u8; 3]>,
    triangles: Vec<[u32; 3]>,
    triangle_colors: Vec<[u8; 3]>,
    triangle_parts: Vec<u32>,
    faces_without_area: usize,
}

impl<'a> Builder<'a> {
    pub(crate) fn new(path: &'a Path) -> Self {
        Self {
            path,
            vertices: Vec::new(),
            vertex_colors: Vec::new(),
            triangles: Vec::new(),
            triangle_colors: Vec::new(),
            triangle_parts: Vec::new(),
            faces_without_area: 0,
        }
    }

    /// Makes room for as many vertices and triangles as the file will bring, if that is known.
    pub(crate) fn reserve(&mut self, vertices: usize, triangles: usize) {
        self.vertices.reserve_exact(vertices);
        self.triangles.reserve_exact(triangles);
    }

    /// Vertices so far.
    pub(crate) fn vertex_count(&self) -> usize {
        self.vertices.len()
    }

    /// Triangles so far.
    pub(crate) fn triangle_count(&self) -> usize {
        self.triangles.len()
    }

    pub(crate) fn vertex(&mut self, position: Point3<f64>, color: Option<[u8; 3]>) {
        self.vertices.push(position);
        self.vertex_colors.extend(color);
    }

    /// Adds a polygon; its corners are numbers of vertices added before. The error says what is wrong with them.
    pub(crate) fn face(&mut self, corners: &[f64], color: Option<[u8; 3]>, part: Option<u32>) -> Result<(), String> {
        let vertices = self.vertices.len();
        if let Some(bad) = corners.iter().find(|&&c| !(c >= 0.0 && c < vertices as f64 && c <= f64::from(u32::MAX))) {
            return Err(format!("the face refers to vertex {bad}, but there are {vertices} vertices, numbered from 0"));
        }
        if corners.len() < 3 {
            self.faces_without_area += 1;
        }
        for i in 2..corners.len() {
            self.triangles.push([corners[0] as u32, corners[i - 1] as u32, corners[i] as u32]);
            self.triangle_colors.extend(color);
            self.triangle_parts.extend(part);
        }
        Ok(())
    }

    /// The mesh. Colours and parts are kept where every vertex or triangle has them.
    pub(crate) fn finish(self) -> Result<(TriangleMesh, Dropped)> {
        let finite: Vec<bool> = self.vertices.iter().map(|p| p.coords.iter().all(|v| v.is_finite())).collect();
        let mut dropped = Dropped { faces: self.faces_without_area, ..Dropped::default() };
        dropped.vertices = finite.iter().filter(|f| !**f).count();
        if dropped.vertices == finite.len() && !finite.is_empty() {
            return Err(Error::input(self.path, "no vertex has finite coordinates"));
        }
        let (vertices, triangles) = (self.vertices.len(), self.triangles.len());
        let all = |found: usize, of: usize| found == of && of > 0;
        let mut mesh = TriangleMesh {
            vertex_colors: all(self.vertex_colors.len(), vertices).then_some(self.vertex_colors),
            triangle_colors: all(self.triangle_colors.len(), triangles).then_some(self.triangle_colors),
            triangle_parts: all(self.triangle_parts.len(), triangles).then_some(self.triangle_parts),
            vertices: self.vertices,
            triangles: self.triangles,
        };
        if dropped.vertices > 0 {
            dropped.triangles = mesh.retain_vertices(&finite);
        }
        Ok((mesh, dropped))
    }
}
