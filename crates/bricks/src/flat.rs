//! The whole model as one mesh.

use std::collections::BTreeMap;

use mb_geometry::Aabb;
use mb_mesh::TriangleMesh;
use nalgebra::Point3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::ldraw::colors::ColorCode;
use crate::ldraw::file::{Affine, FileId, FileKind};
use crate::ldraw::shape::PartShape;
use crate::model::Model;

/// One LDraw unit, metres.
pub const METRES_PER_LDU: f64 = 0.0004;

/// The value of `triangle_parts` for polygons that stand in a model file itself and belong to no brick.
pub const NO_PART: u32 = u32::MAX;

/// How to turn a model into a mesh.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MeshOptions {
    /// How far the outer side walls of bricks stand back from their nominal planes, millimetres. LDraw draws bricks
    /// without play (0, the default); real ones have about 0.1 on each side.
    pub clearance_mm: f64,
}

/// A point in LDraw's frame (units, -y up) as a point of the object frame (metres, y up).
pub fn object_from_ldraw(p: &Point3<f64>) -> Point3<f64> {
    Point3::new(p.x * METRES_PER_LDU, -p.y * METRES_PER_LDU, -p.z * METRES_PER_LDU)
}

/// A shape and one place where it stands.
pub(crate) struct Placed<'a> {
    pub shape: &'a PartShape,
    pub ldraw_from_shape: Affine,
    pub color: ColorCode,
    pub inverted: bool,
    /// Index of the brick, or [`NO_PART`].
    pub part: u32,
}

/// The shapes of a model, each once.
pub(crate) struct Shapes {
    /// Parts with all their pieces; model files with their own polygons alone.
    of_file: BTreeMap<FileId, PartShape>,
}

impl Shapes {
    pub fn of(model: &Model) -> Self {
        let mut wanted: Vec<FileId> = model.instances().iter().map(|i| i.part).collect();
        wanted.extend(model.occurrences().iter().map(|o| o.file));
        wanted.sort_unstable();
        wanted.dedup();
        let of_file = wanted
            .into_par_iter()
            .map(|id| (id, PartShape::of(model.files(), id, model.file(id).kind != FileKind::Model)))
            .collect();
        Self { of_file }
    }

    pub fn get(&self, id: FileId) -> &PartShape {
        &self.of_file[&id]
    }

    pub fn map(&mut self, change: impl FnMut(&mut PartShape)) {
        self.of_file.values_mut().for_each(change);
    }

    /// Every brick, then the polygons that belong to none.
    pub fn placed<'a>(&'a self, model: &'a Model) -> impl Iterator<Item = Placed<'a>> {
        let bricks = model.instances().iter().enumerate().map(|(index, brick)| Placed {
            shape: self.get(brick.part),
            ldraw_from_shape: brick.ldraw_from_part,
            color: brick.color,
            inverted: brick.inverted,
            part: index as u32,
        });
        let models = model.occurrences().iter().filter(|o| model.file(o.file).kind == FileKind::Model);
        let loose = models.map(|o| Placed {
            shape: self.get(o.file),
            ldraw_from_shape: o.ldraw_from_file,
            color: o.color,
            inverted: o.inverted,
            part: NO_PART,
        });
        bricks.chain(loose.filter(|placed| !placed.shape.triangles.is_empty()))
    }
}

/// The box around all corners, LDraw units and axes.
pub(crate) fn bounds_ldu(model: &Model, shapes: &Shapes) -> Aabb {
    let mut bounds = Aabb::empty();
    for placed in shapes.placed(model) {
        placed.shape.vertices.iter().for_each(|p| bounds.add(&placed.ldraw_from_shape.apply(p)));
    }
    bounds
}

impl Model {
    /// The whole model as triangles in the object frame, metres, coloured, each with the index of its brick in
    /// [`Model::instances`] ([`NO_PART`] for polygons outside any brick).
    ///
    /// Parts of the official library are not closed: edges meet without shared corners, studs rest on tops, walls
    /// touch. Vertices are shared within a brick, never between bricks.
    pub fn mesh(&self, options: &MeshOptions) -> TriangleMesh {
        let mut shapes = Shapes::of(self);
        if options.clearance_mm != 0.0 {
            let clearance_ldu = options.clearance_mm * 1e-3 / METRES_PER_LDU;
            shapes.map(|shape| crate::clearance::set_back_side_walls(shape, clearance_ldu));
        }
        let placed: Vec<Placed> = shapes.placed(self).collect();
        let triangle_count = placed.iter().map(|p| p.shape.triangles.len()).sum();
        let mut vertices = Vec::with_capacity(placed.iter().map(|p| p.shape.vertices.len()).sum());
        let mut triangles = Vec::with_capacity(triangle_count);
        let mut colors = Vec::with_capacity(triangle_count);
        let mut parts = Vec::with_capacity(triangle_count);
        for Placed { shape, ldraw_from_shape, color, inverted, part } in placed {
            let base = vertices.len() as u32;
            vertices.extend(shape.vertices.iter().map(|p| object_from_ldraw(&ldraw_from_shape.apply(p))));
            // The change from LDraw's axes to ours is a half turn: it mirrors nothing.
            let flip = inverted ^ ldraw_from_shape.is_mirrored();
            let oriented = |[a, b, c]: [u32; 3]| if flip { [a, c, b] } else { [a, b, c] };
            triangles.extend(shape.triangles.iter().map(|t| oriented(t.map(|v| base + v))));
            let own = self.surface_rgb(color, color);
            let mut last = (ColorCode::INHERIT, own);
            colors.extend(shape.colors.iter().map(|&code| {
                if code != last.0 {
                    last = (code, self.surface_rgb(code, color));
                }
                last.1
            }));
            parts.resize(triangles.len(), part);
        }
        TriangleMesh {
            vertices,
            triangles,
            vertex_colors: None,
            triangle_colors: Some(colors),
            triangle_parts: Some(parts),
        }
    }

    /// The colour of a face with `code` on a brick of colour `brick`.
    fn surface_rgb(&self, code: ColorCode, brick: ColorCode) -> [u8; 3] {
        match code {
            ColorCode::EDGE => self.colors().look(brick).edge_rgb,
            code => self.colors().look(code.within(brick)).rgb,
        }
    }
}
