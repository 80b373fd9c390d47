//! Writing PLY files.

use std::path::Path;

use mb_job::{Result, write_atomic_with};

use crate::TriangleMesh;

/// Writes a binary little-endian PLY file: `double` positions; `red green blue` of vertices and faces where the mesh has
/// them; the `part` of each face where it has parts. [`crate::read_ply`] gives the same mesh back.
///
/// # Errors
/// The file cannot be written.
pub fn write_ply(path: impl AsRef<Path>, mesh: &TriangleMesh) -> Result<()> {
    write_atomic_with(path, |out| {
        write!(out, "ply\nformat binary_little_endian 1.0\ncomment positions in metres\n")?;
        write!(
            out,
            "element vertex {}\nproperty double x\nproperty double y\nproperty double z\n",
            mesh.vertices.len()
        )?;
        let colors = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
        if mesh.vertex_colors.is_some() {
            out.write_all(colors.as_bytes())?;
        }
        write!(out, "element face {}\nproperty list uchar int vertex_indices\n", mesh.triangles.len())?;
        if mesh.triangle_colors.is_some() {
            out.write_all(colors.as_bytes())?;
        }
        if mesh.triangle_parts.is_some() {
            out.write_all(b"property uint part\n")?;
        }
        out.write_all(b"end_header\n")?;
        for (i, vertex) in mesh.vertices.iter().enumerate() {
            for value in vertex.coords.iter() {
                out.write_all(&value.to_le_bytes())?;
            }
            if let Some(colors) = &mesh.vertex_colors {
                out.write_all(&colors[i])?;
            }
        }
        for (i, triangle) in mesh.triangles.iter().enumerate() {
            out.write_all(&[3])?;
            for vertex in triangle {
                out.write_all(&vertex.to_le_bytes())?;
            }
            if let Some(colors) = &mesh.triangle_colors {
                out.write_all(&colors[i])?;
            }
            if let Some(parts) = &mesh.triangle_parts {
                out.write_all(&parts[i].to_le_bytes())?;
            }
        }
        Ok(())
    })
}
