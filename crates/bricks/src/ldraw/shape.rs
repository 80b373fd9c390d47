//! One part, flattened: the triangles of all its pieces in its own frame, facing outwards.

use std::collections::HashMap;

use mb_mesh::TriangleMesh;
use nalgebra::Point3;

use super::colors::ColorCode;
use super::file::{Affine, EdgeLine, FileId, LdrawFile};

/// Corners closer than this are one vertex, LDraw units (0.04 micrometres). Library files are written to 1e-3 or finer.
const WELD_LDU: f64 = 1e-4;

/// A part's surface in the part's own frame, LDraw units, -y up.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PartShape {
    /// `[V]` positions.
    pub vertices: Vec<Point3<f64>>,
    /// `[T]` vertex indices, counter-clockwise seen from outside. Degenerate triangles of the source are kept.
    pub triangles: Vec<[u32; 3]>,
    /// `[T]` colours; [`ColorCode::INHERIT`] is the brick's own.
    pub colors: Vec<ColorCode>,
    /// Sharp edges, for drawings.
    pub edges: Vec<EdgeLine>,
    /// How many triangles have no trusted outside (uncertified files, `NOCLIP`).
    pub two_sided: usize,
}

impl PartShape {
    /// The triangles alone, LDraw units.
    pub(crate) fn to_mesh(&self) -> TriangleMesh {
        TriangleMesh::new(self.vertices.clone(), self.triangles.clone())
    }

    /// Flattens the file `id`; with `with_references` false, only its own polygons.
    pub(crate) fn of(files: &[LdrawFile], id: FileId, with_references: bool) -> Self {
        let mut flattening = Flattening { files, shape: Self::default(), vertex_of_cell: HashMap::new() };
        let view =
            View { part_from_file: Affine::identity(), color: ColorCode::INHERIT, flip: false, two_sided: false };
        flattening.file(id, &view, with_references);
        flattening.shape
    }
}

/// How a file is seen from the part.
struct View {
    part_from_file: Affine,
    color: ColorCode,
    /// Whether an odd number of `INVERTNEXT` and mirrorings lies between.
    flip: bool,
    two_sided: bool,
}

struct Flattening<'a> {
    files: &'a [LdrawFile],
    shape: PartShape,
    vertex_of_cell: HashMap<[i64; 3], u32>,
}

impl Flattening<'_> {
    /// The depth of references was bounded when the model was loaded.
    fn file(&mut self, id: FileId, view: &View, with_references: bool) {
        let file = &self.files[id.index()];
        for face in &file.faces {
            let mut corners = face.corners.map(|p| self.vertex(view.part_from_file.apply(&p)));
            if view.flip {
                corners.swap(1, 2);
            }
            self.shape.triangles.push(corners);
            self.shape.colors.push(face.color.within(view.color));
            self.shape.two_sided += usize::from(view.two_sided || face.two_sided);
        }
        for edge in &file.edges {
            let ends = edge.ends.map(|p| view.part_from_file.apply(&p));
            self.shape.edges.push(EdgeLine { color: edge.color.within(view.color), ends });
        }
        if !with_references {
            return;
        }
        for reference in &file.references {
            let Some(target) = reference.target else { continue };
            let mirrored = reference.parent_from_child.is_mirrored();
            let inner = View {
                part_from_file: view.part_from_file.then_inner(&reference.parent_from_child),
                color: reference.color.within(view.color),
                flip: view.flip ^ reference.inverted ^ mirrored,
                two_sided: view.two_sided || !reference.clipped || file.certified == Some(false),
            };
            self.file(target, &inner, true);
        }
    }

    fn vertex(&mut self, p: Point3<f64>) -> u32 {
        let cell = [p.x, p.y, p.z].map(|v| (v / WELD_LDU).round() as i64);
        let next = self.shape.vertices.len() as u32;
        let index = *self.vertex_of_cell.entry(cell).or_insert(next);
        if index == next {
            self.shape.vertices.push(p);
        }
        index
    }
}
