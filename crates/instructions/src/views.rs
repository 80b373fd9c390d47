//! From where the model is seen, step after step: always the same way, unless what is new would be hidden.

use mb_bricks::StepView;
use mb_geometry::ImageSize;
use mb_render::{NO_TRIANGLE, Scene, View};
use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::geometry::Assembly;
use crate::plan::Section;

/// How far the usual view is turned to the side and lifted, degrees.
const AZIMUTH_DEG: f64 = -38.0;
const ELEVATION_DEG: f64 = 30.0;
/// Long side of the pictures in which visible pixels are counted.
const TRIAL_PX: f64 = 320.0;
/// A piece is seen well enough when this share of it is visible.
const WELL_SEEN: f64 = 0.22;
/// A piece that is seen less than this (as a share of [`WELL_SEEN`]) asks for another view.
const HIDDEN: f64 = 0.45;
/// What a change of view costs, in hidden pieces.
const CHANGE: f64 = 0.35;
/// Steps that a view is chosen for, and what hidden pieces of the later ones count: a model that turns back and forth is
/// worse than one that stays turned for a while.
const AHEAD: usize = 4;
const LATER: f64 = 0.3;
/// What it costs besides to turn the model upside down.
const OVER: f64 = 0.5;

/// The object frame of a section; only pictures know it.
pub(crate) enum Shown {}

/// A direction of view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Look {
    /// Into the picture, of unit length.
    pub forward: Vector3<f64>,
    /// Upwards in the picture, about.
    pub up: Vector3<f64>,
}

/// How the model is turned from one step to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Turn {
    /// About the vertical.
    Round,
    /// Upside down, or back on its feet.
    Over,
}

impl Look {
    /// The usual view.
    pub fn usual() -> Self {
        Self::around(0.0)
    }

    /// The usual view, walked about the model by some degrees.
    pub fn around(turned_deg: f64) -> Self {
        let (azimuth, elevation) = ((AZIMUTH_DEG + turned_deg).to_radians(), ELEVATION_DEG.to_radians());
        let outward = Vector3::new(azimuth.sin() * elevation.cos(), elevation.sin(), azimuth.cos() * elevation.cos());
        Self { forward: -outward, up: Vector3::y() }
    }

    /// The model turned over: its bottom on top.
    fn from_below(turned_deg: f64) -> Self {
        let Self { forward, .. } = Self::around(turned_deg);
        Self { forward: Vector3::new(forward.x, -forward.y, forward.z), up: -Vector3::y() }
    }

    /// What a `ROTSTEP` line asks for. It turns the model about LDraw's axes, before the usual view or instead of it.
    fn of_author(view: StepView) -> Self {
        let (base, angles) = match view {
            StepView::Relative(angles) | StepView::Additive(angles) => (Self::usual(), angles),
            StepView::Absolute(angles) => (Self { forward: -Vector3::z(), up: Vector3::y() }, angles),
            StepView::Default => return Self::usual(),
        };
        let [x, y, z] = angles.map(f64::to_radians);
        let about = |axis, angle| Rotation3::from_axis_angle(&axis, angle);
        let ldraw = about(Vector3::x_axis(), x) * about(Vector3::y_axis(), y) * about(Vector3::z_axis(), z);
        // LDraw's axes are ours after a half turn about x.
        let half: Matrix3<f64> = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0));
        let model_from_turned = (half * ldraw.matrix() * half).transpose();
        Self { forward: model_from_turned * base.forward, up: model_from_turned * base.up }
    }

    /// The picture's right and down.
    fn axes(&self) -> (Vector3<f64>, Vector3<f64>) {
        let right = self.forward.cross(&self.up).normalize();
        (right, self.forward.cross(&right))
    }

    /// What turns the model from `self` to `other`; `None` where they are the same.
    pub fn turn_to(&self, other: &Self) -> Option<Turn> {
        if (self.forward - other.forward).norm() < 1e-6 && (self.up - other.up).norm() < 1e-6 {
            None
        } else if self.up.dot(&other.up) < 0.5 {
            Some(Turn::Over)
        } else {
            Some(Turn::Round)
        }
    }

    /// The picture of bricks from this view at a scale, and its size.
    pub fn view(&self, frame: &Frame, size: ImageSize, metres_per_px: f64) -> View<Shown> {
        View::from_afar(&frame.middle, &self.forward, &self.up, size, metres_per_px, frame.reach)
    }
}

/// The rectangle that bricks fill in a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Frame {
    /// Width and height, metres.
    pub size_m: [f64; 2],
    /// Middle of the picture, in the section's frame.
    pub middle: nalgebra::Point3<f64>,
    /// Radius about the middle that holds everything.
    pub reach: f64,
}

/// The frames of the first bricks of an assembly, for one view: entry `n` is that of the first `n`.
pub(crate) fn frames(assembly: &Assembly, look: &Look) -> Vec<Frame> {
    let (right, down) = look.axes();
    let axes = [right, down, look.forward];
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    let mut frames = vec![];
    for brick in 0..=assembly.bricks() {
        let empty = low[0] > high[0];
        let middle = if empty { [0.0; 3] } else { std::array::from_fn(|i| 0.5 * (low[i] + high[i])) };
        let size: [f64; 3] = if empty { [0.0; 3] } else { std::array::from_fn(|i| high[i] - low[i]) };
        let middle = right * middle[0] + down * middle[1] + look.forward * middle[2];
        let reach = 0.5 * (size[0].powi(2) + size[1].powi(2) + size[2].powi(2)).sqrt();
        frames.push(Frame { size_m: [size[0], size[1]], middle: middle.into(), reach });
        if brick < assembly.bricks() {
            for p in assembly.vertices(brick) {
                for (i, axis) in axes.iter().enumerate() {
                    let v = p.coords.dot(axis);
                    low[i] = low[i].min(v);
                    high[i] = high[i].max(v);
                }
            }
        }
    }
    frames
}

/// The view of each step.
pub(crate) fn choose(section: &Section, assembly: &Assembly) -> Vec<Look> {
    let candidates = [
        Look::usual(),
        Look::around(90.0),
        Look::around(-90.0),
        Look::around(180.0),
        Look::from_below(0.0),
        Look::from_below(180.0),
    ];
    let mut trial = Trial { section, assembly, candidates, known: std::collections::HashMap::new(), ends: vec![0] };
    for step in &section.steps {
        let last = *trial.ends.last().unwrap_or(&0);
        trial.ends.push(last + step.bricks().count());
    }
    let mut current = 0;
    let mut looks = vec![];
    for (index, step) in section.steps.iter().enumerate() {
        if let Some(view) = step.view {
            looks.push(Look::of_author(view));
            continue;
        }
        let soon = index..(index + AHEAD).min(section.steps.len());
        if current != 0 && !soon.clone().any(|step| trial.hides(step, 0)) {
            current = 0;
        }
        if trial.hides(index, current) {
            let cost = |trial: &mut Trial, view: usize| {
                // Upside down is the last resort.
                let change = if view == current { 0.0 } else { CHANGE };
                let later: f64 = (index + 1..soon.end).map(|step| trial.cost(step, view)).sum();
                trial.cost(index, view) + LATER * later + change + if view >= 4 { OVER } else { 0.0 }
            };
            let costs: Vec<f64> = (0..trial.candidates.len()).map(|view| cost(&mut trial, view)).collect();
            current = (0..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(current);
        }
        looks.push(trial.candidates[current]);
    }
    looks
}

/// Small pictures in which visible pixels are counted.
struct Trial<'a> {
    section: &'a Section,
    assembly: &'a Assembly,
    candidates: [Look; 6],
    /// How well each piece of a step is seen in a view, 0 to 1.
    known: std::collections::HashMap<(usize, usize), Vec<f64>>,
    /// Bricks at the beginning of each step, and at the end.
    ends: Vec<usize>,
}

impl Trial<'_> {
    fn hides(&mut self, step: usize, view: usize) -> bool {
        self.seen(step, view).iter().any(|&seen| seen < HIDDEN)
    }

    /// Hidden pieces; half as bad where an equal one is well seen, as with the wheels on the far side of a car.
    fn cost(&mut self, step: usize, view: usize) -> f64 {
        let pieces = &self.section.steps[step].pieces;
        let seen = self.seen(step, view);
        let shown = |kind| pieces.iter().zip(seen).any(|(other, &seen)| other.kind == kind && seen >= 1.0);
        pieces.iter().zip(seen).map(|(piece, seen)| (1.0 - seen) * if shown(piece.kind) { 0.5 } else { 1.0 }).sum()
    }

    fn seen(&mut self, step: usize, view: usize) -> &[f64] {
        if !self.known.contains_key(&(step, view)) {
            let seen = self.measure(step, &self.candidates[view]);
            self.known.insert((step, view), seen);
        }
        &self.known[&(step, view)]
    }

    fn measure(&self, step: usize, look: &Look) -> Vec<f64> {
        let (before, after) = (self.ends[step], self.ends[step + 1]);
        let bounds = self.assembly.bounds(after);
        let extent = bounds.extent().norm().max(1e-6);
        let size = ImageSize::new(TRIAL_PX as usize, TRIAL_PX as usize);
        let frame = Frame { size_m: [extent; 2], middle: bounds.center(), reach: 0.5 * extent };
        let view = look.view(&frame, size, extent / TRIAL_PX);
        let count = |mesh: &mb_mesh::TriangleMesh| {
            let raster = Scene::new(mesh).render(&view);
            let mut pixels = vec![0usize; after - before];
            let parts = mesh.triangle_parts.as_deref().unwrap_or_default();
            for &t in raster.triangle.data().iter().filter(|&&t| t != NO_TRIANGLE) {
                let part = parts[t as usize] as usize;
                if part >= before {
                    pixels[part - before] += 1;
                }
            }
            pixels
        };
        let visible = count(&self.assembly.mesh_of(after));
        let mut at = 0;
        self.section.steps[step]
            .pieces
            .iter()
            .map(|piece| {
                let range = at..at + piece.bricks.len();
                at = range.end;
                // What of the piece could be seen if it stood alone.
                let alone: usize = count(&self.assembly.mesh_between(before + range.start, before + range.end))
                    [range.clone()]
                .iter()
                .sum();
                let seen: usize = visible[range].iter().sum();
                if alone == 0 { 1.0 } else { (seen as f64 / alone as f64 / WELL_SEEN).min(1.0) }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Point2, Point3};

    fn pixel(view: &View<Shown>, p: &Point3<f64>) -> Point2<f64> {
        view.intrinsics.img_from_cam(&(view.cam_from_frame * *p)).expect("in front")
    }

    #[test]
    fn the_usual_view_shows_top_and_front_and_keeps_scale() {
        let frame = Frame { size_m: [0.1, 0.1], middle: Point3::origin(), reach: 0.1 };
        let view = Look::usual().view(&frame, ImageSize::new(200, 200), 0.001);
        let middle = pixel(&view, &Point3::origin());
        assert!((middle - Point2::new(99.5, 99.5)).norm() < 1e-9);
        assert!(pixel(&view, &Point3::new(0.0, 0.05, 0.0)).y < middle.y, "up is up");
        assert!(Look::usual().forward.y < 0.0 && Look::usual().forward.z < 0.0, "from above and from the front");
        let near = pixel(&view, &Point3::new(0.01, 0.0, 0.0)) - pixel(&view, &Point3::origin());
        let far = pixel(&view, &Point3::new(0.01, 0.0, -0.1)) - pixel(&view, &Point3::new(0.0, 0.0, -0.1));
        assert!((near.norm() - far.norm()).abs() < 0.03 * near.norm(), "sizes do not shrink with distance");
    }

    #[test]
    fn rotation_steps_turn_the_model() {
        let half_turn = Look::of_author(StepView::Relative([0.0, 180.0, 0.0]));
        let expected = Look::around(180.0);
        assert!((half_turn.forward - expected.forward).norm() < 1e-9);
        assert_eq!(Look::usual().turn_to(&half_turn), Some(Turn::Round));
        let over = Look::of_author(StepView::Relative([180.0, 0.0, 0.0]));
        assert!(over.forward.y > 0.0 && over.up.y < -0.9);
        assert_eq!(Look::usual().turn_to(&over), Some(Turn::Over));
        assert_eq!(Look::usual().turn_to(&Look::of_author(StepView::Relative([0.0; 3]))), None);
    }
}
