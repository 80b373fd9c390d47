//! STL files, binary and text.

use std::collections::HashMap;
use std::path::Path;

use mb_job::{InputError, Result, write_atomic_with};
use nalgebra::Point3;

use crate::TriangleMesh;
use crate::files::{Builder, Dropped};

const HEADER: usize = 84;
const RECORD: usize = 50;

/// Reads either kind. STL repeats the corners of every triangle: those with the very same coordinates become one vertex.
/// Each `solid` of a text file with several is a part.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<(TriangleMesh, Dropped)> {
    let declared = bytes.get(80..HEADER).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    // Some binary files begin with "solid" too; their size gives them away.
    let is_binary =
        declared.is_some_and(|count| bytes.len() == HEADER + RECORD * count) || !bytes.starts_with(b"solid");
    if is_binary { binary(path, bytes, declared) } else { text(path, bytes) }
}

/// Gives corners with the same coordinates the same vertex.
struct Corners<'a> {
    builder: Builder<'a>,
    vertex_at: HashMap<[u64; 3], f64>,
}

impl<'a> Corners<'a> {
    fn new(path: &'a Path) -> Self {
        Self { builder: Builder::new(path), vertex_at: HashMap::new() }
    }

    fn vertex(&mut self, position: [f64; 3]) -> f64 {
        // Adding 0 turns -0 into 0.
        let key = position.map(|v| (v + 0.0).to_bits());
        *self.vertex_at.entry(key).or_insert_with(|| {
            self.builder.vertex(Point3::from(position), None);
            self.builder.vertex_count() as f64 - 1.0
        })
    }
}

fn binary(path: &Path, bytes: &[u8], declared: Option<usize>) -> Result<(TriangleMesh, Dropped)> {
    let Some(declared) = declared else {
        return Err(InputError::new(path, "too short for an STL file").into());
    };
    let records = &bytes[HEADER..];
    if records.len() / RECORD < declared {
        let found = format!(
            "the header declares {declared} triangles, but the file holds {}; it is truncated or no STL file",
            records.len() / RECORD
        );
        return Err(InputError::new(path, found).into());
    }
    let mut corners = Corners::new(path);
    for (index, record) in records.chunks_exact(RECORD).take(declared).enumerate() {
        let number = |i: usize| {
            let at = 12 + 4 * i;
            f64::from(f32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]))
        };
        let face: [f64; 3] = std::array::from_fn(|c| corners.vertex(std::array::from_fn(|axis| number(3 * c + axis))));
        corners
            .builder
            .face(&face, None, None)
            .map_err(|found| InputError::new(path, found).at(format!("triangle {index}")))?;
    }
    corners.builder.finish()
}

fn text(path: &Path, bytes: &[u8]) -> Result<(TriangleMesh, Dropped)> {
    let text = String::from_utf8_lossy(bytes);
    let solids = text.lines().filter(|line| line.trim_start().starts_with("solid")).count();
    let mut corners = Corners::new(path);
    let mut part = 0;
    let mut face = Vec::new();
    let mut ended = false;
    for (number, line) in text.lines().enumerate() {
        let bad = |found: String| InputError::new(path, found).at_line(number + 1);
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("vertex") => {
                let values: Vec<f64> = words
                    .map(|word| word.parse().map_err(|_| bad(format!("{word:?} is no number"))))
                    .collect::<Result<_, _>>()?;
                let position: [f64; 3] = values
                    .try_into()
                    .map_err(|found: Vec<f64>| bad(format!("a vertex with {} coordinates", found.len())))?;
                face.push(corners.vertex(position));
            }
            Some("endloop") => {
                corners.builder.face(&face, None, (solids > 1).then_some(part)).map_err(bad)?;
                face.clear();
            }
            Some("endsolid") => {
                part += 1;
                ended = true;
            }
            Some("solid") => ended = false,
            Some("facet" | "outer" | "endfacet") | None => {}
            Some(other) => return Err(bad(format!("{other:?} is no word of an STL file")).into()),
        }
    }
    if !ended {
        return Err(InputError::new(path, "the file ends before \"endsolid\"; it is truncated").into());
    }
    corners.builder.finish()
}

/// Writes a binary STL file: positions rounded to `f32`, no colours, no parts.
///
/// # Errors
/// The file cannot be written.
pub fn write_stl(path: impl AsRef<Path>, mesh: &TriangleMesh) -> Result<()> {
    write_atomic_with(path, |out| {
        let mut header = [0; 80];
        let title = b"binary STL, metres";
        header[..title.len()].copy_from_slice(title);
        out.write_all(&header)?;
        out.write_all(&(mesh.triangles.len() as u32).to_le_bytes())?;
        for index in 0..mesh.triangles.len() {
            let normal = mesh.scaled_normal(index).try_normalize(0.0).unwrap_or_default();
            let corners = mesh.triangle(index);
            for vector in [normal, corners[0].coords, corners[1].coords, corners[2].coords] {
                for value in vector.iter() {
                    out.write_all(&(*value as f32).to_le_bytes())?;
                }
            }
            out.write_all(&[0; 2])?;
        }
        Ok(())
    })
}
