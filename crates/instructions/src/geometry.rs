//! Parts and sections as surfaces with lines, ready to be drawn.

use std::collections::{BTreeMap, BTreeSet};

use mb_bricks::{Affine, Color, ColorCode, FileId, Model, PartShape, object_from_ldraw};
use mb_geometry::Aabb;
use mb_mesh::TriangleMesh;
use mb_render::{LineArt, Look, SharpEdge};
use nalgebra::{Matrix3, Point3, Vector3};
use rayon::prelude::*;

use crate::plan::Section;

/// Neighbouring triangles that meet at a smaller angle than this belong to one round surface: the cosine of 32 degrees
/// (circles of the library have 16 sides, which turn by 22.5).
const ROUND_COS: f64 = 0.848;

/// The shapes of all parts of a model, each once, with normals.
pub(crate) struct PartArt {
    of_part: BTreeMap<FileId, SmoothShape>,
}

/// A part with a normal at each corner of each triangle.
struct SmoothShape {
    shape: PartShape,
    normals: Vec<[Vector3<f32>; 3]>,
}

impl PartArt {
    pub fn of(model: &Model) -> Self {
        let parts: BTreeSet<FileId> = model.instances().iter().map(|brick| brick.part).collect();
        let of_part = parts
            .into_iter()
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|part| {
                let shape = model.part_shape(part);
                let normals = corner_normals(&shape);
                (part, SmoothShape { shape, normals })
            })
            .collect();
        Self { of_part }
    }
}

/// `[T]` normals at the corners of each triangle: its own, or on a round surface the mean around the corner.
fn corner_normals(shape: &PartShape) -> Vec<[Vector3<f32>; 3]> {
    let scaled: Vec<Vector3<f64>> = shape
        .triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|v| shape.vertices[v as usize]);
            (b - a).cross(&(c - a))
        })
        .collect();
    let mut around: Vec<Vec<u32>> = vec![vec![]; shape.vertices.len()];
    for (index, triangle) in shape.triangles.iter().enumerate() {
        triangle.iter().for_each(|&v| around[v as usize].push(index as u32));
    }
    let units: Vec<Vector3<f64>> = scaled.iter().map(|n| n.try_normalize(1e-12).unwrap_or_default()).collect();
    shape
        .triangles
        .iter()
        .enumerate()
        .map(|(index, triangle)| {
            let own = units[index];
            triangle.map(|v| {
                let mut sum = Vector3::zeros();
                for &other in &around[v as usize] {
                    let cosine = own.dot(&units[other as usize]);
                    // Uncertified parts may be wound either way.
                    if cosine.abs() > ROUND_COS {
                        sum += scaled[other as usize] * cosine.signum();
                    }
                }
                sum.try_normalize(1e-12).unwrap_or(own).cast()
            })
        })
        .collect()
}

/// Bricks in building order, in a frame of their own: metres, y up.
pub(crate) struct Assembly {
    mesh: TriangleMesh,
    normals: Vec<[Vector3<f32>; 3]>,
    opacity: Vec<u8>,
    edges: Vec<SharpEdge>,
    lines: Vec<[u8; 3]>,
    /// Where each brick ends among vertices, triangles and edges.
    ends: Vec<[usize; 3]>,
}

impl Assembly {
    fn empty() -> Self {
        let mesh =
            TriangleMesh { triangle_colors: Some(vec![]), triangle_parts: Some(vec![]), ..TriangleMesh::default() };
        Self { mesh, normals: vec![], opacity: vec![], edges: vec![], lines: vec![], ends: vec![] }
    }

    /// A single part in a colour, in its own frame.
    pub fn of_part(model: &Model, art: &PartArt, part: FileId, color: ColorCode) -> Self {
        let mut assembly = Self::empty();
        assembly.add(model, art, part, color, &Affine::identity(), false);
        assembly
    }

    /// All bricks of a section, step after step, in the frame of its file.
    pub fn of_section(model: &Model, art: &PartArt, section: &Section) -> Self {
        let mut assembly = Self::empty();
        let occurrence = &model.occurrences()[section.occurrence];
        let file_from_ldraw = occurrence.ldraw_from_file.inverse().unwrap_or_else(Affine::identity);
        for brick in section.steps.iter().flat_map(|step| step.bricks()) {
            let brick = &model.instances()[brick];
            let file_from_part = file_from_ldraw.then_inner(&brick.ldraw_from_part);
            assembly.add(model, art, brick.part, brick.color, &file_from_part, brick.inverted);
        }
        assembly
    }

    fn add(&mut self, model: &Model, art: &PartArt, part: FileId, color: ColorCode, place: &Affine, inverted: bool) {
        let SmoothShape { shape, normals } = &art.of_part[&part];
        let index = self.ends.len() as u32;
        let base = self.mesh.vertices.len() as u32;
        let placed = |p: &Point3<f64>| object_from_ldraw(&place.apply(p));
        self.mesh.vertices.extend(shape.vertices.iter().map(placed));
        let flip = inverted ^ place.is_mirrored();
        let oriented = |[a, b, c]: [u32; 3]| if flip { [a, c, b] } else { [a, b, c] };
        self.mesh.triangles.extend(shape.triangles.iter().map(|t| oriented(t.map(|v| base + v))));
        // Normals turn with the inverse transposed; the change of axes is a half turn.
        let turn: Matrix3<f64> = place.linear.try_inverse().map_or_else(Matrix3::identity, |m| m.transpose());
        let turned = |n: &Vector3<f32>| {
            let n = turn * n.cast::<f64>();
            Vector3::new(n.x, -n.y, -n.z).try_normalize(0.0).unwrap_or_else(Vector3::y).cast()
        };
        self.normals.extend(normals.iter().map(|n| {
            let [a, b, c] = [turned(&n[0]), turned(&n[1]), turned(&n[2])];
            oriented_normals(flip, [a, b, c])
        }));
        let own = model.colors().look(color);
        let mut known: Vec<(ColorCode, Color)> = vec![];
        for &code in &shape.colors {
            let at = known.iter().position(|(other, _)| *other == code).unwrap_or_else(|| {
                known.push((code, surface(model, code, &own)));
                known.len() - 1
            });
            let look = &known[at].1;
            self.mesh.triangle_colors.get_or_insert_default().push(look.rgb);
            self.opacity.push(if look.alpha == 255 { 255 } else { look.alpha.clamp(90, 200) });
        }
        self.mesh.triangle_parts.get_or_insert_default().resize(self.mesh.triangles.len(), index);
        self.edges
            .extend(shape.edges.iter().map(|edge| SharpEdge { ends: edge.ends.map(|p| placed(&p)), part: index }));
        self.lines.push(line_rgb(own.rgb));
        self.ends.push([self.mesh.vertices.len(), self.mesh.triangles.len(), self.edges.len()]);
    }

    /// How many bricks there are.
    pub fn bricks(&self) -> usize {
        self.ends.len()
    }

    /// The first `bricks` bricks; `mesh` is theirs, as [`Assembly::mesh_of`] gives it.
    pub fn art<'a>(&'a self, bricks: usize, mesh: &'a TriangleMesh, looks: &'a [Look]) -> LineArt<'a> {
        let [_, triangles, edges] = self.end(bricks);
        LineArt {
            mesh,
            corner_normals: &self.normals[..triangles],
            opacity: &self.opacity[..triangles],
            edges: &self.edges[..edges],
            looks,
        }
    }

    /// The surface of the first `bricks` bricks.
    pub fn mesh_of(&self, bricks: usize) -> TriangleMesh {
        let [vertices, triangles, _] = self.end(bricks);
        TriangleMesh {
            vertices: self.mesh.vertices[..vertices].to_vec(),
            triangles: self.mesh.triangles[..triangles].to_vec(),
            vertex_colors: None,
            triangle_colors: self.mesh.triangle_colors.as_ref().map(|c| c[..triangles].to_vec()),
            triangle_parts: self.mesh.triangle_parts.as_ref().map(|p| p[..triangles].to_vec()),
        }
    }

    /// The surface of bricks `from..to` alone.
    pub fn mesh_between(&self, from: usize, to: usize) -> TriangleMesh {
        let ([v0, t0, _], [v1, t1, _]) = (self.end(from), self.end(to));
        TriangleMesh {
            vertices: self.mesh.vertices[v0..v1].to_vec(),
            triangles: self.mesh.triangles[t0..t1].iter().map(|t| t.map(|v| v - v0 as u32)).collect(),
            vertex_colors: None,
            triangle_colors: None,
            triangle_parts: self.mesh.triangle_parts.as_ref().map(|p| p[t0..t1].to_vec()),
        }
    }

    /// How the first `bricks` bricks look: those before `new` faded by `fade`, the others highlighted.
    pub fn looks(&self, bricks: usize, new: usize, fade: f32, highlight: bool) -> Vec<Look> {
        let look = |index: usize| Look {
            line: self.lines[index],
            fade: if index < new { fade } else { 0.0 },
            highlighted: highlight && index >= new,
        };
        (0..bricks).map(look).collect()
    }

    /// Vertices of brick `index`.
    pub fn vertices(&self, index: usize) -> &[Point3<f64>] {
        &self.mesh.vertices[self.end(index)[0]..self.end(index + 1)[0]]
    }

    /// The box around the first `bricks` bricks.
    pub fn bounds(&self, bricks: usize) -> Aabb {
        Aabb::of(&self.mesh.vertices[..self.end(bricks)[0]])
    }

    fn end(&self, bricks: usize) -> [usize; 3] {
        if bricks == 0 { [0; 3] } else { self.ends[bricks - 1] }
    }
}

fn oriented_normals(flip: bool, [a, b, c]: [Vector3<f32>; 3]) -> [Vector3<f32>; 3] {
    if flip { [a, c, b] } else { [a, b, c] }
}

/// What a face with `code` looks like on a brick of colour `own`.
fn surface(model: &Model, code: ColorCode, own: &Color) -> Color {
    match code {
        ColorCode::INHERIT => own.clone(),
        ColorCode::EDGE => Color { rgb: own.edge_rgb, alpha: 255, ..own.clone() },
        code => model.colors().look(code),
    }
}

/// Lines on a colour: darker than it, or lighter where it is nearly black.
pub(crate) fn line_rgb(rgb: [u8; 3]) -> [u8; 3] {
    let luma = 0.2126 * f64::from(rgb[0]) + 0.7152 * f64::from(rgb[1]) + 0.0722 * f64::from(rgb[2]);
    if luma < 48.0 {
        rgb.map(|v| (f64::from(v) * 0.5 + 112.0) as u8)
    } else {
        let share = if luma > 180.0 { 0.38 } else { 0.30 };
        rgb.map(|v| (f64::from(v) * share) as u8)
    }
}
