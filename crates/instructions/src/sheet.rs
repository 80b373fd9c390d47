//! Measures sections and pieces: from where they are seen, at which scale, and how large their pictures are.

use std::collections::BTreeMap;

use mb_bricks::Model;
use mb_geometry::ImageSize;
use mb_job::{Progress, Result, Steps};
use mb_render::View;

use crate::geometry::{Assembly, PartArt};
use crate::plan::{PieceKind, Plan, Section};
use crate::views::{Frame, Look, Shown, Sight, choose};

/// Paper millimetres for a metre of the model, at most: four fifths of the real size.
const LARGEST_SCALE: f64 = 800.0;
/// The same for pieces in parts lists, and the largest picture there, millimetres.
const PIECE_SCALE: f64 = 620.0;
const LARGEST_PIECE_MM: [f64; 2] = [40.0, 26.0];
/// What the pictures of steps must fit into, millimetres.
pub(crate) const LARGEST_STEP_MM: [f64; 2] = [250.0, 142.0];
/// White around a picture, for lines that reach over the surface, millimetres.
pub(crate) const EDGE_MM: f64 = 1.2;

/// A picture to be drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Shot {
    /// From where.
    pub sight: Sight,
    /// What is in it.
    pub frame: Frame,
    /// Paper millimetres for a metre.
    pub scale: f64,
}

impl Shot {
    /// Width and height on paper, millimetres.
    pub fn size_mm(&self) -> [f64; 2] {
        self.frame.size_m().map(|v| v * self.scale + 2.0 * EDGE_MM)
    }

    /// The first pixel, counted from the section's middle, and width and height in pixels.
    pub fn pixels(&self, px_per_mm: f64) -> ([i64; 2], ImageSize) {
        let first = self.frame.low.map(|v| ((v * self.scale - EDGE_MM) * px_per_mm).floor() as i64);
        let [w, h] = self.size_mm().map(|v| (v * px_per_mm).round().clamp(1.0, 8000.0) as usize);
        (first, ImageSize::new(w, h))
    }

    /// The view of these pixels.
    pub fn view(&self, px_per_mm: f64) -> View<Shown> {
        let (first, size) = self.pixels(px_per_mm);
        self.sight.view(first, size, 1.0 / (self.scale * px_per_mm))
    }
}

/// All that is known of the pictures of a plan before any is drawn.
pub(crate) struct Sheets {
    /// Of each section, of each step.
    pub steps: Vec<Vec<Shot>>,
    /// Of each piece in parts lists.
    pub pieces: BTreeMap<PieceKind, Shot>,
}

impl Sheets {
    pub fn measure(model: &Model, art: &PartArt, plan: &Plan, progress: &dyn Progress) -> Result<Self> {
        let (mut steps, mut pieces) = (vec![], BTreeMap::new());
        let counter = Steps::new(progress, "choosing views", plan.sections.len());
        for (index, section) in plan.sections.iter().enumerate() {
            let assembly = Assembly::of_section(model, art, section);
            let shots = section_shots(section, &assembly);
            if let Some(last) = shots.last() {
                pieces.insert(PieceKind::Submodel(index), piece_shot(last.sight, last.frame));
            }
            steps.push(shots);
            counter.step()?;
        }
        for kind in plan.sections.iter().flat_map(|s| &s.steps).flat_map(|s| &s.pieces).map(|piece| piece.kind) {
            if let PieceKind::Part(part, color) = kind
                && !pieces.contains_key(&kind)
            {
                let assembly = Assembly::of_part(model, art, part, color);
                let sight = Sight::new(Look::usual(), &assembly.bounds());
                pieces.insert(kind, piece_shot(sight, sight.frames(&assembly)[1]));
            }
        }
        Ok(Self { steps, pieces })
    }
}

fn piece_shot(sight: Sight, frame: Frame) -> Shot {
    let size = frame.size_m();
    let scale = (0..2).map(|i| LARGEST_PIECE_MM[i] / size[i].max(1e-9)).fold(PIECE_SCALE, f64::min);
    Shot { sight, frame, scale }
}

/// The pictures of a section's steps, all at one scale.
fn section_shots(section: &Section, assembly: &Assembly) -> Vec<Shot> {
    let bounds = assembly.bounds();
    let mut known: Vec<(Sight, Vec<Frame>)> = vec![];
    let mut bricks = 0;
    let mut shots: Vec<Shot> = vec![];
    for (step, look) in section.steps.iter().zip(choose(section, assembly)) {
        bricks += step.bricks().count();
        let at = known.iter().position(|(other, _)| other.look == look).unwrap_or_else(|| {
            let sight = Sight::new(look, &bounds);
            known.push((sight, sight.frames(assembly)));
            known.len() - 1
        });
        let (sight, frames) = &known[at];
        shots.push(Shot { sight: *sight, frame: frames[bricks], scale: LARGEST_SCALE });
    }
    let fits = |shot: &Shot| {
        let size = shot.frame.size_m();
        (0..2).map(|i| (LARGEST_STEP_MM[i] - 2.0 * EDGE_MM) / size[i].max(1e-9)).fold(f64::INFINITY, f64::min)
    };
    let scale = shots.iter().map(fits).fold(LARGEST_SCALE, f64::min);
    shots.iter_mut().for_each(|shot| shot.scale = scale);
    shots
}
