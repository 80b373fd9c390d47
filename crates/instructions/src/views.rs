//! From where the model is seen, step after step: always the same way, unless what is new would be hidden.

use mb_bricks::StepView;
use mb_geometry::{Aabb, ImageSize};
use mb_render::{NO_TRIANGLE, Scene, View};
use nalgebra::{Matrix3, Point3, Rotation3, Vector3};
use rayon::prelude::*;

use crate::geometry::Assembly;
use crate::plan::Section;

/// How far the usual view is turned to the side and lifted, degrees.
const AZIMUTH_DEG: f64 = -38.0;
const ELEVATION_DEG: f64 = 30.0;
/// Long side of the pictures in which visible pixels are counted.
const TRIAL_PX: f64 = 400.0;
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
}

/// A look at a section from a place that all its pictures share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sight {
    pub look: Look,
    /// Middle of the finished section, in its frame.
    middle: Point3<f64>,
    /// Radius about the middle that holds everything.
    reach: f64,
}

impl Sight {
    /// `bounds` is the box around the finished section.
    pub fn new(look: Look, bounds: &Aabb) -> Self {
        let (middle, reach) =
            if bounds.is_empty() { (Point3::origin(), 0.0) } else { (bounds.center(), 0.5 * bounds.extent().norm()) };
        Self { look, middle, reach }
    }

    /// The picture of `size` pixels whose first one is the pixel `first`, counted from the section's middle.
    pub fn view(&self, first: [i64; 2], size: ImageSize, metres_per_px: f64) -> View<Shown> {
        let Look { forward, up } = &self.look;
        let mut view = View::from_afar(&self.middle, forward, up, size, metres_per_px, self.reach);
        (view.intrinsics.cx, view.intrinsics.cy) = (-first[0] as f64, -first[1] as f64);
        view
    }

    /// The frames of the first bricks of an assembly: entry `n` is that of the first `n`.
    pub fn frames(&self, assembly: &Assembly) -> Vec<Frame> {
        let in_metres = self.view([0; 2], ImageSize::new(1, 1), 1.0);
        let mut frame = Frame { low: [f64::INFINITY; 2], high: [f64::NEG_INFINITY; 2] };
        let mut frames = vec![Frame { low: [0.0; 2], high: [0.0; 2] }];
        for brick in 0..assembly.bricks() {
            for p in assembly.vertices(brick) {
                let Some(p) = in_metres.intrinsics.img_from_cam(&(in_metres.cam_from_frame * p)) else { continue };
                for axis in 0..2 {
                    frame.low[axis] = frame.low[axis].min(p[axis]);
                    frame.high[axis] = frame.high[axis].max(p[axis]);
                }
            }
            frames.push(if frame.low[0] <= frame.high[0] { frame } else { frames[0] });
        }
        frames
    }
}

/// The rectangle that bricks fill in a picture: metres from the section's middle, rightwards and downwards.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Frame {
    pub low: [f64; 2],
    pub high: [f64; 2],
}

impl Frame {
    /// Width and height.
    pub fn size_m(&self) -> [f64; 2] {
        [self.high[0] - self.low[0], self.high[1] - self.low[1]]
    }

    /// The frame with more around it: shares of its width and height.
    pub fn grown(&self, shares: [f64; 2]) -> Self {
        let size = self.size_m();
        let margin: [f64; 2] = std::array::from_fn(|i| 0.5 * shares[i] * size[i]);
        Self {
            low: std::array::from_fn(|i| self.low[i] - margin[i]),
            high: std::array::from_fn(|i| self.high[i] + margin[i]),
        }
    }
}

/// The view of each step.
pub(crate) fn choose(section: &Section, assembly: &Assembly) -> Vec<Look> {
    let looks = [
        Look::usual(),
        Look::around(90.0),
        Look::around(-90.0),
        Look::around(180.0),
        Look::from_below(0.0),
        Look::from_below(180.0),
    ];
    let bounds = assembly.bounds();
    let mut trials: Vec<Trial> = looks.iter().map(|look| Trial::new(assembly, Sight::new(*look, &bounds))).collect();
    let mut current = 0;
    let mut chosen = vec![];
    for (index, step) in section.steps.iter().enumerate() {
        if let Some(view) = step.view {
            chosen.push(Look::of_author(view));
            continue;
        }
        let soon = index..(index + AHEAD).min(section.steps.len());
        if current != 0 {
            trials[0].build(section, assembly, soon.end);
            if !soon.clone().any(|step| trials[0].hides(step)) {
                current = 0;
            }
        }
        trials[current].build(section, assembly, index + 1);
        if trials[current].hides(index) {
            trials.par_iter_mut().for_each(|trial| trial.build(section, assembly, soon.end));
            let cost = |view: usize| {
                // Upside down is the last resort.
                let change = if view == current { 0.0 } else { CHANGE };
                let later: f64 = (index + 1..soon.end).map(|step| trials[view].cost(section, step)).sum();
                trials[view].cost(section, index) + LATER * later + change + if view >= 4 { OVER } else { 0.0 }
            };
            let costs: Vec<f64> = (0..trials.len()).map(cost).collect();
            current = (0..costs.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b])).unwrap_or(current);
        }
        chosen.push(looks[current]);
    }
    chosen
}

/// A small picture of one view in which a section is built and visible pixels are counted.
struct Trial {
    view: View<Shown>,
    /// Depth of what is nearest, 0 where there is nothing.
    depth: Vec<f32>,
    /// Number of the piece that is nearest, counted through all steps.
    piece: Vec<u32>,
    /// Bricks and pieces that are built.
    bricks: usize,
    pieces: u32,
    /// Of each step that is built, how well each piece is seen, 0 to 1.
    seen: Vec<Vec<f64>>,
}

impl Trial {
    fn new(assembly: &Assembly, sight: Sight) -> Self {
        let frame = sight.frames(assembly)[assembly.bricks()];
        let [w, h] = frame.size_m();
        let metres_per_px = w.max(h).max(1e-6) / TRIAL_PX;
        let px = |m: f64| (m / metres_per_px).ceil() as usize + 2;
        let first = frame.low.map(|m| (m / metres_per_px).floor() as i64);
        let size = ImageSize::new(px(w), px(h));
        Self {
            view: sight.view(first, size, metres_per_px),
            depth: vec![0.0; size.pixels()],
            piece: vec![u32::MAX; size.pixels()],
            bricks: 0,
            pieces: 0,
            seen: vec![],
        }
    }

    fn hides(&self, step: usize) -> bool {
        self.seen[step].iter().any(|&seen| seen < HIDDEN)
    }

    /// Hidden pieces; half as bad where an equal one is well seen, as with the wheels on the far side of a car.
    fn cost(&self, section: &Section, step: usize) -> f64 {
        let (pieces, seen) = (&section.steps[step].pieces, &self.seen[step]);
        let shown = |kind| pieces.iter().zip(seen).any(|(other, &seen)| other.kind == kind && seen >= 1.0);
        pieces.iter().zip(seen).map(|(piece, seen)| (1.0 - seen) * if shown(piece.kind) { 0.5 } else { 1.0 }).sum()
    }

    /// Builds on until `steps` steps are there.
    fn build(&mut self, section: &Section, assembly: &Assembly, steps: usize) {
        for step in self.seen.len()..steps {
            let first = self.pieces;
            // Of each piece, what could be seen if it stood alone.
            let mut alone = vec![];
            for piece in &section.steps[step].pieces {
                alone.push(self.add(&assembly.mesh(self.bricks..self.bricks + piece.bricks.len())));
                self.bricks += piece.bricks.len();
            }
            let mut visible = vec![0_usize; alone.len()];
            for &piece in self.piece.iter().filter(|&&piece| piece >= first && piece < self.pieces) {
                visible[(piece - first) as usize] += 1;
            }
            let share = |(&visible, &alone): (&usize, &usize)| match alone {
                0 => 1.0,
                alone => (visible as f64 / alone as f64 / WELL_SEEN).min(1.0),
            };
            self.seen.push(visible.iter().zip(&alone).map(share).collect());
        }
    }

    /// Adds a piece; returns how many pixels it has by itself.
    fn add(&mut self, mesh: &mb_mesh::TriangleMesh) -> usize {
        let number = self.pieces;
        self.pieces += 1;
        let Some((window, raster)) = Scene::new(mesh).render_where_seen(&self.view) else { return 0 };
        let mut alone = 0;
        for (row, pixels) in raster.triangle.data().chunks(window.size.width).enumerate() {
            let start = (window.y + row) * self.view.size.width + window.x;
            for (x, _) in pixels.iter().enumerate().filter(|&(_, &t)| t != NO_TRIANGLE) {
                alone += 1;
                let z = raster.depth[(x, row)];
                if self.depth[start + x] == 0.0 || z <= self.depth[start + x] {
                    (self.depth[start + x], self.piece[start + x]) = (z, number);
                }
            }
        }
        alone
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point2;

    fn pixel(view: &View<Shown>, p: &Point3<f64>) -> Point2<f64> {
        view.intrinsics.img_from_cam(&(view.cam_from_frame * *p)).expect("in front")
    }

    #[test]
    fn the_usual_view_shows_top_and_front_and_keeps_scale() {
        let bounds = Aabb { min: Point3::new(-0.1, -0.1, -0.1), max: Point3::new(0.1, 0.1, 0.1) };
        let view = Sight::new(Look::usual(), &bounds).view([-100, -80], ImageSize::new(200, 200), 0.001);
        let middle = pixel(&view, &Point3::origin());
        assert!((middle - Point2::new(100.0, 80.0)).norm() < 1e-9);
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
