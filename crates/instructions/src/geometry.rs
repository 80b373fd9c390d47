//! Parts and sections as surfaces with lines, ready to be drawn.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

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

/// Bricks in building order, in a frame of their own: metres, y up. Surfaces are made when asked for.
pub(crate) struct Assembly<'a> {
    model: &'a Model,
    art: &'a PartArt,
    bricks: Vec<Placed>,
}

/// A part where it stands.
struct Placed {
    part: FileId,
    color: ColorCode,
    frame_from_part: Affine,
    inverted: bool,
}

/// The surface of some bricks of an assembly; its parts are numbered from 0.
pub(crate) struct Surface {
    pub mesh: TriangleMesh,
    normals: Vec<[Vector3<f32>; 3]>,
    opacity: Vec<u8>,
    edges: Vec<SharpEdge>,
}

impl Surface {
    pub fn art<'a>(&'a self, looks: &'a [Look]) -> LineArt<'a> {
        LineArt { mesh: &self.mesh, corner_normals: &self.normals, opacity: &self.opacity, edges: &self.edges, looks }
    }
}

impl<'a> Assembly<'a> {
    /// A single part in a colour, in its own frame.
    pub fn of_part(model: &'a Model, art: &'a PartArt, part: FileId, color: ColorCode) -> Self {
        let placed = Placed { part, color, frame_from_part: Affine::identity(), inverted: false };
        Self { model, art, bricks: vec![placed] }
    }

    /// All bricks of a section, step after step, in the frame of its file.
    pub fn of_section(model: &'a Model, art: &'a PartArt, section: &Section) -> Self {
        let occurrence = &model.occurrences()[section.occurrence];
        let file_from_ldraw = occurrence.ldraw_from_file.inverse().unwrap_or_else(Affine::identity);
        let placed = |brick: usize| {
            let brick = &model.instances()[brick];
            let frame_from_part = file_from_ldraw.then_inner(&brick.ldraw_from_part);
            Placed { part: brick.part, color: brick.color, frame_from_part, inverted: brick.inverted }
        };
        let bricks = section.steps.iter().flat_map(|step| step.bricks()).map(placed).collect();
        Self { model, art, bricks }
    }

    /// How many bricks there are.
    pub fn bricks(&self) -> usize {
        self.bricks.len()
    }

    /// The places of a brick's vertices.
    pub fn vertices(&self, brick: usize) -> impl Iterator<Item = Point3<f64>> {
        let Placed { part, frame_from_part, .. } = &self.bricks[brick];
        self.art.of_part[part].shape.vertices.iter().map(|p| object_from_ldraw(&frame_from_part.apply(p)))
    }

    /// The box around all bricks.
    pub fn bounds(&self) -> Aabb {
        let mut bounds = Aabb::empty();
        (0..self.bricks()).for_each(|brick| self.vertices(brick).for_each(|p| bounds.add(&p)));
        bounds
    }

    /// The bare geometry of some bricks.
    pub fn mesh(&self, bricks: Range<usize>) -> TriangleMesh {
        let (mut vertices, mut triangles) = (vec![], vec![]);
        for brick in bricks {
            let base = vertices.len() as u32;
            vertices.extend(self.vertices(brick));
            let shape = &self.art.of_part[&self.bricks[brick].part].shape;
            triangles.extend(shape.triangles.iter().map(|t| t.map(|v| base + v)));
        }
        TriangleMesh::new(vertices, triangles)
    }

    /// The surface of some bricks.
    pub fn surface(&self, bricks: Range<usize>) -> Surface {
        let mut mesh = self.mesh(bricks.clone());
        let (mut colors, mut parts) = (vec![], vec![]);
        let (mut normals, mut opacity, mut edges) = (vec![], vec![], vec![]);
        let mut first = 0;
        for (index, brick) in bricks.enumerate() {
            let Placed { part, color, frame_from_part, inverted } = &self.bricks[brick];
            let SmoothShape { shape, normals: of_part } = &self.art.of_part[part];
            let triangles = first..first + shape.triangles.len();
            first = triangles.end;
            let flip = inverted ^ frame_from_part.is_mirrored();
            if flip {
                mesh.triangles[triangles].iter_mut().for_each(|t| t.swap(1, 2));
            }
            // Normals turn with the inverse transposed; the change of axes is a half turn.
            let turn = frame_from_part.linear.try_inverse().map_or_else(Matrix3::identity, |m| m.transpose());
            let turned = |n: &Vector3<f32>| {
                let n = turn * n.cast::<f64>();
                Vector3::new(n.x, -n.y, -n.z).try_normalize(0.0).unwrap_or_else(Vector3::y).cast()
            };
            normals.extend(of_part.iter().map(|[a, b, c]| {
                let [a, b, c] = [turned(a), turned(b), turned(c)];
                if flip { [a, c, b] } else { [a, b, c] }
            }));
            let own = self.model.colors().look(*color);
            let mut known: Vec<(ColorCode, Color)> = vec![];
            for &code in &shape.colors {
                let at = known.iter().position(|(other, _)| *other == code).unwrap_or_else(|| {
                    known.push((code, surface_color(self.model, code, &own)));
                    known.len() - 1
                });
                let look = &known[at].1;
                colors.push(look.rgb);
                opacity.push(if look.alpha == 255 { 255 } else { look.alpha.clamp(90, 200) });
            }
            parts.resize(first, index as u32);
            let placed = |p: &Point3<f64>| object_from_ldraw(&frame_from_part.apply(p));
            edges.extend(
                shape.edges.iter().map(|edge| SharpEdge { ends: edge.ends.map(|p| placed(&p)), part: index as u32 }),
            );
        }
        (mesh.triangle_colors, mesh.triangle_parts) = (Some(colors), Some(parts));
        Surface { mesh, normals, opacity, edges }
    }

    /// How a brick looks.
    pub fn look(&self, brick: usize, fade: f32, highlighted: bool) -> Look {
        Look { line: line_rgb(self.model.colors().look(self.bricks[brick].color).rgb), fade, highlighted }
    }
}

/// What a face with `code` looks like on a brick of colour `own`.
fn surface_color(model: &Model, code: ColorCode, own: &Color) -> Color {
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
