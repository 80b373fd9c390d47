//! What a model is made of, in figures.

use std::collections::{BTreeMap, BTreeSet};

use mb_geometry::Aabb;
use serde::Serialize;

use crate::flat::{METRES_PER_LDU, Shapes, bounds_ldu};
use crate::ldraw::colors::ColorCode;
use crate::ldraw::file::FileKind;
use crate::ldraw::load::MissingPart;
use crate::model::Model;

/// A box, for people and programs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BoxInfo {
    /// Smallest corner.
    pub min: [f64; 3],
    /// Largest corner.
    pub max: [f64; 3],
}

/// One line of a parts list.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BomLine {
    /// The part's file name, as the model refers to it, such as `3001.dat`.
    pub part: String,
    /// Colour code as it stands in a file (`4`, `0x2FF8800`); `16` where the model gives none.
    pub color: String,
    /// How many.
    pub count: usize,
    /// What the part is.
    pub description: String,
    /// What the colour is called.
    pub color_name: String,
}

/// The figures of a model: the document of `model info`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModelInfo {
    /// Placed bricks; an assembly that the library counts as one part (a shortcut) is one.
    pub parts: usize,
    /// Different part files.
    pub distinct_parts: usize,
    /// Flat triangles; a quad is two.
    pub triangles: usize,
    /// `STEP` and `ROTSTEP` lines of the model and its submodels, each file once.
    pub steps: usize,
    /// Bricks placed by a mirroring matrix.
    pub mirrored_parts: usize,
    /// The box around all corners in LDraw's axes (-y up), LDraw units; `null` for nothing.
    pub bbox_ldu: Option<BoxInfo>,
    /// The same box in the object's axes (y up), millimetres.
    pub bbox_mm: Option<BoxInfo>,
    /// References to files that are nowhere.
    pub missing: Vec<MissingPart>,
    /// The parts list, sorted by part and colour.
    pub bom: Vec<BomLine>,
    /// Triangles whose outside nobody vouches for (uncertified files, `NOCLIP`).
    pub two_sided_triangles: usize,
    /// Submodel files that are used.
    pub submodels: usize,
    /// What is odd about the files.
    pub warnings: Vec<String>,
}

impl Model {
    /// The parts list, sorted by part and colour.
    pub fn bom(&self) -> Vec<BomLine> {
        let mut counts: BTreeMap<(&str, ColorCode), usize> = BTreeMap::new();
        for brick in self.instances() {
            *counts.entry((self.file(brick.part).name.as_str(), brick.color)).or_default() += 1;
        }
        let mut descriptions = BTreeMap::new();
        for brick in self.instances() {
            let file = self.file(brick.part);
            descriptions.entry(file.name.as_str()).or_insert(file.description.as_str());
        }
        counts
            .into_iter()
            .map(|((part, color), count)| BomLine {
                part: part.to_owned(),
                color: color.to_string(),
                count,
                description: descriptions[part].to_owned(),
                color_name: self.colors().look(color).name,
            })
            .collect()
    }

    /// The figures of the model.
    pub fn info(&self) -> ModelInfo {
        let shapes = Shapes::of(self);
        let bounds = bounds_ldu(self, &shapes);
        let (mut triangles, mut two_sided_triangles) = (0, 0);
        for placed in shapes.placed(self) {
            triangles += placed.shape.triangles.len();
            two_sided_triangles += placed.shape.two_sided;
        }
        let models = || self.used_files().iter().map(|&id| self.file(id)).filter(|file| file.kind == FileKind::Model);
        let distinct: BTreeSet<_> = self.instances().iter().map(|brick| brick.part).collect();
        ModelInfo {
            parts: self.instances().len(),
            distinct_parts: distinct.len(),
            triangles,
            steps: models().map(|file| file.steps.len()).sum(),
            mirrored_parts: self.instances().iter().filter(|brick| brick.ldraw_from_part.is_mirrored()).count(),
            bbox_ldu: (!bounds.is_empty())
                .then(|| BoxInfo { min: bounds.min.coords.into(), max: bounds.max.coords.into() }),
            bbox_mm: (!bounds.is_empty()).then(|| box_mm(&bounds)),
            missing: self.missing().to_vec(),
            bom: self.bom(),
            two_sided_triangles,
            submodels: models().count() - usize::from(self.file(self.root()).kind == FileKind::Model),
            warnings: self.warnings().to_vec(),
        }
    }
}

/// The half turn about x swaps the ends of y and z.
fn box_mm(ldu: &Aabb) -> BoxInfo {
    let mm = METRES_PER_LDU * 1e3;
    BoxInfo {
        min: [ldu.min.x * mm, -ldu.max.y * mm, -ldu.max.z * mm],
        max: [ldu.max.x * mm, -ldu.min.y * mm, -ldu.min.z * mm],
    }
}
