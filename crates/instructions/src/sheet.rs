//! Measures sections and pieces: from where they are seen, at which scale, and how large their pictures are.

use std::collections::BTreeMap;

use mb_bricks::Model;
use mb_job::{Progress, Result, Steps};

use crate::geometry::{Assembly, PartArt};
use crate::plan::{PieceKind, Plan, Section};
use crate::views::{Frame, Look, choose, frames};

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
    pub look: Look,
    /// What is in it.
    pub frame: Frame,
    /// Paper millimetres for a metre.
    pub scale: f64,
}

impl Shot {
    /// Width and height on paper, millimetres.
    pub fn size_mm(&self) -> [f64; 2] {
        self.frame.size_m.map(|v| v * self.scale + 2.0 * EDGE_MM)
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
                pieces.insert(PieceKind::Submodel(index), piece_shot(last.look, last.frame));
            }
            steps.push(shots);
            counter.step()?;
        }
        for kind in plan.sections.iter().flat_map(|s| &s.steps).flat_map(|s| &s.pieces).map(|piece| piece.kind) {
            if let PieceKind::Part(part, color) = kind
                && !pieces.contains_key(&kind)
            {
                let assembly = Assembly::of_part(model, art, part, color);
                let look = Look::usual();
                pieces.insert(kind, piece_shot(look, frames(&assembly, &look)[1]));
            }
        }
        Ok(Self { steps, pieces })
    }
}

fn piece_shot(look: Look, frame: Frame) -> Shot {
    let scale = (0..2).map(|i| LARGEST_PIECE_MM[i] / frame.size_m[i].max(1e-9)).fold(PIECE_SCALE, f64::min);
    Shot { look, frame, scale }
}

/// The pictures of a section's steps, all at one scale.
fn section_shots(section: &Section, assembly: &Assembly) -> Vec<Shot> {
    let looks = choose(section, assembly);
    let mut known: Vec<(Look, Vec<Frame>)> = vec![];
    let mut bricks = 0;
    let mut shots: Vec<Shot> = vec![];
    for (step, look) in section.steps.iter().zip(looks) {
        bricks += step.bricks().count();
        let at = known.iter().position(|(other, _)| *other == look).unwrap_or_else(|| {
            known.push((look, frames(assembly, &look)));
            known.len() - 1
        });
        shots.push(Shot { look, frame: known[at].1[bricks], scale: LARGEST_SCALE });
    }
    let fits = |shot: &Shot| {
        (0..2)
            .map(|i| (LARGEST_STEP_MM[i] - 2.0 * EDGE_MM) / shot.frame.size_m[i].max(1e-9))
            .fold(f64::INFINITY, f64::min)
    };
    let scale = shots.iter().map(fits).fold(LARGEST_SCALE, f64::min);
    shots.iter_mut().for_each(|shot| shot.scale = scale);
    shots
}
