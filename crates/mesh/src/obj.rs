//! Wavefront OBJ files and their colours.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::path::Path;

use mb_job::{InputError, Result, write_atomic_with};
use nalgebra::Point3;

use crate::TriangleMesh;
use crate::files::{Builder, Dropped};

/// Reads positions, the usual `r g b` after them, polygons, and the `Kd` colour of each `usemtl` where the material file
/// lies beside. Each `o` or `g` with faces is a part where there are several. Texture coordinates, normals, lines and
/// points carry no surface and are passed over.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<(TriangleMesh, Dropped)> {
    let text = String::from_utf8_lossy(bytes);
    let mut builder = Builder::new(path);
    let mut materials = HashMap::new();
    let mut color = None;
    // Parts are numbered in the order of their first face.
    let mut part_of_group: HashMap<&str, u32> = HashMap::new();
    let mut group = "";
    let mut faces = Vec::new();
    let lines: Vec<&str> = text.lines().collect();
    let mut at = 0;
    while at < lines.len() {
        let number = at + 1;
        let bad = |found: String| InputError::new(path, found).at_line(number);
        let (line, next) = joined(&lines, at);
        at = next;
        let line = line.split('#').next().unwrap_or_default();
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => {
                let values: Vec<f64> = words
                    .map(|word| word.parse().map_err(|_| bad(format!("{word:?} is no number"))))
                    .collect::<Result<_, _>>()?;
                let &[x, y, z, ref rest @ ..] = values.as_slice() else {
                    return Err(bad(format!("a vertex with {} coordinates", values.len())).into());
                };
                let color = match *rest {
                    [r, g, b] => Some([r, g, b].map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8)),
                    _ => None,
                };
                builder.vertex(Point3::new(x, y, z), color);
            }
            Some("f") => {
                let count = builder.vertex_count() as f64;
                let corners = words
                    .map(|word| {
                        let index: i64 = word
                            .split('/')
                            .next()
                            .and_then(|index| index.parse().ok())
                            .ok_or_else(|| bad(format!("{word:?} is no corner of a face")))?;
                        // Negative numbers count back from the latest vertex.
                        Ok(if index < 0 { count + index as f64 } else { index as f64 - 1.0 })
                    })
                    .collect::<Result<Vec<f64>, InputError>>()?;
                let parts = part_of_group.len() as u32;
                let part = *part_of_group.entry(group).or_insert(parts);
                faces.push((number, corners, color, part));
            }
            Some("o" | "g") => group = lines[number - 1].trim_start().get(1..).unwrap_or_default().trim(),
            Some("usemtl") => color = words.next().and_then(|name| materials.get(name).copied()),
            Some("mtllib") => {
                let file = line.trim_start()["mtllib".len()..].trim();
                materials.extend(read_materials(&path.with_file_name(file)));
            }
            _ => {}
        }
    }
    let parts = part_of_group.len();
    for (number, corners, color, part) in faces {
        builder
            .face(&corners, color, (parts > 1).then_some(part))
            .map_err(|found| InputError::new(path, found).at_line(number))?;
    }
    builder.finish()
}

/// The line at `at` with those that continue it (a backslash at the end), and the number of the line after.
fn joined<'a>(lines: &[&'a str], at: usize) -> (std::borrow::Cow<'a, str>, usize) {
    let Some(head) = lines[at].strip_suffix('\\') else { return (lines[at].into(), at + 1) };
    let mut whole = head.to_owned();
    let mut next = at + 1;
    while next < lines.len() {
        let continues = lines[next].strip_suffix('\\');
        whole.push_str(continues.unwrap_or(lines[next]));
        next += 1;
        if continues.is_none() {
            break;
        }
    }
    (whole.into(), next)
}

/// Diffuse colours by material name; none where the file is missing or says nothing: a mesh is whole without colours.
fn read_materials(path: &Path) -> HashMap<String, [u8; 3]> {
    let mut colors = HashMap::new();
    let mut name = None;
    for line in fs::read_to_string(path).unwrap_or_default().lines() {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["newmtl", new] => name = Some((*new).to_owned()),
            ["Kd", rgb @ ..] => {
                let values: Vec<f64> = rgb.iter().filter_map(|v| v.parse().ok()).collect();
                if let (Some(name), &[r, g, b]) = (&name, values.as_slice()) {
                    colors.insert(name.clone(), [r, g, b].map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8));
                }
            }
            _ => {}
        }
    }
    colors
}

/// Writes positions (and vertex colours after them), one object a part, and, where triangles have colours, a material
/// file of the same name beside.
///
/// # Errors
/// A file cannot be written.
pub fn write_obj(path: impl AsRef<Path>, mesh: &TriangleMesh) -> Result<()> {
    let path = path.as_ref();
    let material = |[r, g, b]: [u8; 3]| format!("rgb_{r:02x}{g:02x}{b:02x}");
    let material_path = path.with_extension("mtl");
    if let Some(colors) = &mesh.triangle_colors {
        let mut distinct: Vec<[u8; 3]> = colors.clone();
        distinct.sort_unstable();
        distinct.dedup();
        write_atomic_with(&material_path, |out| {
            distinct.iter().try_for_each(|&color| {
                let [r, g, b] = color.map(|v| f64::from(v) / 255.0);
                writeln!(out, "newmtl {}\nKd {r:.6} {g:.6} {b:.6}", material(color))
            })
        })?;
    }
    let mut triangles_of_part: BTreeMap<u32, Vec<usize>> = BTreeMap::new();
    for index in 0..mesh.triangles.len() {
        let part = mesh.triangle_parts.as_ref().map_or(0, |parts| parts[index]);
        triangles_of_part.entry(part).or_default().push(index);
    }
    write_atomic_with(path, |out| {
        writeln!(out, "# positions in metres")?;
        if let (Some(_), Some(name)) = (&mesh.triangle_colors, material_path.file_name()) {
            writeln!(out, "mtllib {}", name.to_string_lossy())?;
        }
        for (i, p) in mesh.vertices.iter().enumerate() {
            write!(out, "v {} {} {}", p.x, p.y, p.z)?;
            if let Some(colors) = &mesh.vertex_colors {
                let [r, g, b] = colors[i].map(|v| f64::from(v) / 255.0);
                write!(out, " {r:.6} {g:.6} {b:.6}")?;
            }
            writeln!(out)?;
        }
        for (part, triangles) in &triangles_of_part {
            if mesh.triangle_parts.is_some() {
                writeln!(out, "o part_{part}")?;
            }
            let mut current = None;
            for &index in triangles {
                let color = mesh.triangle_colors.as_ref().map(|colors| colors[index]);
                if let Some(color) = color.filter(|_| color != current) {
                    writeln!(out, "usemtl {}", material(color))?;
                }
                current = color;
                let [a, b, c] = mesh.triangles[index].map(|v| v + 1);
                writeln!(out, "f {a} {b} {c}")?;
            }
        }
        Ok(())
    })
}
