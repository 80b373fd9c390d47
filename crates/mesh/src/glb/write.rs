//! Writing GLB files.

use std::collections::BTreeMap;
use std::path::Path;

use mb_job::{Result, write_atomic_with};
use serde_json::{Value, json};

use super::{BIN_CHUNK, F32, JSON_CHUNK, MAGIC, TRIANGLES, U16, U32, linear_from_srgb};
use crate::TriangleMesh;

const ARRAY_BUFFER: u64 = 34962;
const ELEMENT_ARRAY_BUFFER: u64 = 34963;

/// Writes a binary glTF 2.0 file: one node and mesh a part, one primitive a triangle colour, vertex colours as `COLOR_0`.
/// Positions are rounded to `f32`. Normals are left to the viewer, which then shades flat, as bricks want it.
///
/// # Errors
/// The file cannot be written, or its data exceeds the 4 GiB of the format.
pub fn write_glb(path: impl AsRef<Path>, mesh: &TriangleMesh) -> Result<()> {
    let mut triangles: BTreeMap<u32, BTreeMap<Option<[u8; 3]>, Vec<usize>>> = BTreeMap::new();
    for index in 0..mesh.triangles.len() {
        let part = mesh.triangle_parts.as_ref().map_or(0, |parts| parts[index]);
        let color = mesh.triangle_colors.as_ref().map(|colors| colors[index]);
        triangles.entry(part).or_default().entry(color).or_default().push(index);
    }
    let mut out = Document::default();
    let mut nodes = Vec::new();
    let mut meshes = Vec::new();
    let mut material_of_color: BTreeMap<[u8; 3], usize> = BTreeMap::new();
    let mut materials = Vec::new();
    for (part, by_color) in &triangles {
        let mut primitives = Vec::new();
        for (color, triangles) in by_color {
            let mut primitive = out.primitive(mesh, triangles);
            if let Some(color) = color {
                let material = *material_of_color.entry(*color).or_insert_with(|| {
                    let [r, g, b] = color.map(linear_from_srgb);
                    materials.push(json!({
                        "name": format!("rgb_{:02x}{:02x}{:02x}", color[0], color[1], color[2]),
                        "pbrMetallicRoughness": {
                            "baseColorFactor": [r, g, b, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.4
                        },
                        "doubleSided": true,
                    }));
                    materials.len() - 1
                });
                primitive["material"] = material.into();
            }
            primitives.push(primitive);
        }
        nodes.push(json!({ "name": format!("part_{part}"), "mesh": meshes.len() }));
        meshes.push(json!({ "primitives": primitives }));
    }
    let mut json = json!({
        "asset": { "version": "2.0", "generator": "MobileBrick" },
        "scene": 0,
        "scenes": [{}],
    });
    // The format allows no empty lists.
    if !nodes.is_empty() {
        json["scenes"][0]["nodes"] = (0..nodes.len()).collect();
        json["nodes"] = nodes.into();
        json["meshes"] = meshes.into();
        json["accessors"] = out.accessors.into();
        json["bufferViews"] = out.views.into();
        json["buffers"] = json!([{ "byteLength": out.bin.len() }]);
    }
    if !materials.is_empty() {
        json["materials"] = materials.into();
    }
    let mut json = json.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    write_atomic_with(path, |file| {
        let bin_chunk = if out.bin.is_empty() { 0 } else { 8 + out.bin.len() };
        let length = u32::try_from(12 + 8 + json.len() + bin_chunk)
            .map_err(|_| std::io::Error::other("the mesh exceeds the 4 GiB of a GLB file; write a PLY file"))?;
        for word in [MAGIC, 2, length, json.len() as u32, JSON_CHUNK] {
            file.write_all(&word.to_le_bytes())?;
        }
        file.write_all(&json)?;
        if !out.bin.is_empty() {
            file.write_all(&(out.bin.len() as u32).to_le_bytes())?;
            file.write_all(&BIN_CHUNK.to_le_bytes())?;
            file.write_all(&out.bin)?;
        }
        Ok(())
    })
}

/// The binary chunk and the tables that describe it.
#[derive(Default)]
struct Document {
    bin: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Document {
    /// Stores the vertices that some triangles use, and the triangles.
    fn primitive(&mut self, mesh: &TriangleMesh, triangles: &[usize]) -> Value {
        let mut used: Vec<u32> = triangles.iter().flat_map(|&t| mesh.triangles[t]).collect();
        used.sort_unstable();
        used.dedup();
        let mut min = [f32::INFINITY; 3];
        let mut max = [f32::NEG_INFINITY; 3];
        let mut positions = Vec::with_capacity(12 * used.len());
        for &vertex in &used {
            for axis in 0..3 {
                let value = mesh.vertices[vertex as usize][axis] as f32;
                (min[axis], max[axis]) = (min[axis].min(value), max[axis].max(value));
                positions.extend(value.to_le_bytes());
            }
        }
        let positions = self.store(&positions, ARRAY_BUFFER);
        let position = self.accessor(json!({
            "bufferView": positions, "componentType": F32, "type": "VEC3", "count": used.len(), "min": min, "max": max
        }));
        let mut attributes = json!({ "POSITION": position });
        if let Some(colors) = &mesh.vertex_colors {
            let bytes: Vec<u8> = used
                .iter()
                .flat_map(|&v| {
                    let [r, g, b] = colors[v as usize].map(|c| (linear_from_srgb(c) * 65535.0).round() as u16);
                    [r, g, b, u16::MAX].into_iter().flat_map(u16::to_le_bytes)
                })
                .collect();
            let view = self.store(&bytes, ARRAY_BUFFER);
            attributes["COLOR_0"] = self.accessor(json!({
                "bufferView": view, "componentType": U16, "type": "VEC4", "count": used.len(), "normalized": true
            }));
        }
        let indices: Vec<u8> = triangles
            .iter()
            .flat_map(|&t| mesh.triangles[t])
            .flat_map(|v| (used.binary_search(&v).expect("collected from these triangles") as u32).to_le_bytes())
            .collect();
        let view = self.store(&indices, ELEMENT_ARRAY_BUFFER);
        let indices = self.accessor(json!({
            "bufferView": view, "componentType": U32, "type": "SCALAR", "count": 3 * triangles.len()
        }));
        json!({ "attributes": attributes, "indices": indices, "mode": TRIANGLES })
    }

    /// Appends bytes (always a multiple of 4) as a buffer view; returns its number.
    fn store(&mut self, bytes: &[u8], target: u64) -> usize {
        self.views.push(json!({
            "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len(), "target": target
        }));
        self.bin.extend_from_slice(bytes);
        self.views.len() - 1
    }

    fn accessor(&mut self, accessor: Value) -> Value {
        self.accessors.push(accessor);
        (self.accessors.len() - 1).into()
    }
}
