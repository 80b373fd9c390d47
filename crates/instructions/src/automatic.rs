//! Steps for models whose author gave none.
//!
//! Bricks are taken in an order in which each holds to what is there and can be put in from a free side, low ones
//! first. A step takes up to six that could all be put in at its beginning: none of them rests on another, so none
//! hides another from above. Equal bricks at the same height go together, then near ones.

use mb_bricks::{BuildSite, ColorCode, FileId};
use mb_geometry::Aabb;
use nalgebra::Vector3;

/// Most pieces of a step.
pub(crate) const MAX_PIECES: usize = 6;
/// Most different kinds of pieces in a step.
const MAX_KINDS: usize = 3;
/// Most pieces of a step that are not all of one kind.
const MAX_MIXED: usize = 4;
/// Bricks whose bottoms differ by less lie in one layer, LDraw units (a plate is 8).
const LAYER_LDU: f64 = 4.0;
/// Bricks of different kinds go into one step up to this distance, LDraw units (16 studs).
const NEAR_LDU: f64 = 320.0;
/// Two ways are one when they agree to this cosine.
const SAME_WAY: f64 = 0.99;

/// Something that is put in as a whole.
#[derive(Debug, Clone)]
pub(crate) struct Unit {
    /// Its bricks.
    pub bricks: Vec<usize>,
    /// Part and colour of a single brick.
    pub kind: Option<(FileId, ColorCode)>,
}

/// Divides `units` into steps of 1 to [`MAX_PIECES`] of them (indices), after the bricks `placed` are there.
pub(crate) fn automatic_steps(site: &BuildSite, units: &[Unit], placed: &[usize]) -> Vec<Vec<usize>> {
    let mut yard = Yard::new(site, units, placed);
    let mut steps = vec![];
    while yard.left > 0 {
        steps.push(yard.next_step());
    }
    steps
}

/// How a unit holds to another.
struct Link {
    other: usize,
    /// The direction in which the unit travels onto the other; `None` where they only touch.
    way: Option<Vector3<f64>>,
}

struct Yard<'a> {
    site: &'a BuildSite,
    units: &'a [Unit],
    boxes: Vec<Aabb>,
    links: Vec<Vec<Link>>,
    /// Bricks that are there.
    bricks: Vec<usize>,
    /// Units that are there; what was placed before counts as one more unit, the last.
    there: Vec<bool>,
    left: usize,
    /// The middle of the last step.
    last: Option<nalgebra::Point3<f64>>,
}

impl<'a> Yard<'a> {
    fn new(site: &'a BuildSite, units: &'a [Unit], placed: &[usize]) -> Self {
        let before = units.len();
        let mut unit_of = vec![usize::MAX; site.boxes.len()];
        units.iter().enumerate().for_each(|(u, unit)| unit.bricks.iter().for_each(|&b| unit_of[b] = u));
        placed.iter().for_each(|&b| unit_of[b] = before);
        let mut links: Vec<Vec<Link>> = (0..=before).map(|_| vec![]).collect();
        for c in &site.connections.studs {
            let (stud, grip) = (unit_of[c.stud_brick], unit_of[c.grip_brick]);
            if stud != grip && stud <= before && grip <= before {
                // The brick that grips travels against the stud; the one with the stud travels along it.
                links[grip].push(Link { other: stud, way: Some(-c.axis_in_ldraw) });
                links[stud].push(Link { other: grip, way: Some(c.axis_in_ldraw) });
            }
        }
        let box_of = |bricks: &[usize]| bricks.iter().fold(Aabb::empty(), |sum, &b| sum.union(&site.boxes[b]));
        let mut boxes: Vec<Aabb> = units.iter().map(|unit| box_of(&unit.bricks)).collect();
        boxes.push(box_of(placed));
        // Pins, axles, wheels and figures have no studs that hold them: they hold to what they touch.
        let held: Vec<bool> = links.iter().map(|links| !links.is_empty()).collect();
        for a in 0..=before {
            for b in 0..a {
                let far =
                    (0..3).any(|i| boxes[a].min[i] > boxes[b].max[i] + 2.0 || boxes[b].min[i] > boxes[a].max[i] + 2.0);
                if far || (held[a] && held[b]) {
                    continue;
                }
                let bricks = |u: usize| if u == before { placed } else { &units[u].bricks };
                if bricks(a).iter().any(|&x| bricks(b).iter().any(|&y| site.touch(x, y))) {
                    links[a].push(Link { other: b, way: None });
                    links[b].push(Link { other: a, way: None });
                }
            }
        }
        let mut there = vec![false; before + 1];
        there[before] = !placed.is_empty();
        let last = (!placed.is_empty()).then(|| boxes[before].center());
        Self { site, units, boxes, links, bricks: placed.to_vec(), there, left: before, last }
    }

    /// How a unit can be put in now: `None` where it holds to nothing that is there or is barred.
    fn ready(&self, unit: usize) -> Option<Option<Vector3<f64>>> {
        let links = || self.links[unit].iter().filter(|link| self.there[link.other]);
        links().next()?;
        let mut way: Option<Vector3<f64>> = None;
        for link in links() {
            match (way, link.way) {
                (Some(way), Some(other)) if way.dot(&other) < SAME_WAY => return None,
                (None, other) => way = other,
                _ => {}
            }
        }
        match way {
            Some(way) => self.is_free(unit, &way).then_some(Some(way)),
            None => self.any_free_way(unit).map(Some).or(Some(None)),
        }
    }

    fn is_free(&self, unit: usize, way: &Vector3<f64>) -> bool {
        self.units[unit].bricks.iter().all(|&brick| self.site.is_free(brick, way, &self.bricks))
    }

    /// From above where that is free, else from a side or from below.
    fn any_free_way(&self, unit: usize) -> Option<Vector3<f64>> {
        let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
        [y, x, -x, z, -z, -y].into_iter().find(|way| self.is_free(unit, way))
    }

    /// Bottom of a unit: LDraw's y points down.
    fn bottom(&self, unit: usize) -> f64 {
        self.boxes[unit].max.y
    }

    fn distance(&self, unit: usize) -> f64 {
        self.last.map_or(0.0, |last| (self.boxes[unit].center() - last).norm())
    }

    fn next_step(&mut self) -> Vec<usize> {
        let waiting: Vec<usize> = (0..self.units.len()).filter(|&u| !self.there[u]).collect();
        let ready: Vec<(usize, Option<Vector3<f64>>)> =
            waiting.iter().filter_map(|&unit| self.ready(unit).map(|way| (unit, way))).collect();
        // Low layers first; within a layer, near the last step; then the order of the file.
        let key = |unit: usize| ((-self.bottom(unit) / LAYER_LDU).round(), (self.distance(unit) / 20.0).round());
        let first = |a: usize, b: usize| {
            let (a_key, b_key) = (key(a), key(b));
            a_key.0.total_cmp(&b_key.0).then(a_key.1.total_cmp(&b_key.1)).then(a.cmp(&b))
        };
        let Some(&(seed, way)) = ready.iter().min_by(|a, b| first(a.0, b.0)) else {
            return vec![self.begin(&waiting)];
        };
        let mut step = vec![seed];
        self.put(seed);
        let near_seed = |unit: usize| {
            let (own, of_seed) = (&self.boxes[unit], &self.boxes[seed]);
            (0..3)
                .map(|i| (own.min[i] - of_seed.max[i]).max(of_seed.min[i] - own.max[i]).max(0.0).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        let same_way = |other: &Option<Vector3<f64>>| match (way, other) {
            (Some(a), Some(b)) => a.dot(b) > SAME_WAY,
            (a, b) => a.is_none() && b.is_none(),
        };
        let layer = |unit: usize| (self.bottom(unit) - self.bottom(seed)).abs() < LAYER_LDU;
        let same_kind = |unit: usize| self.units[unit].kind.is_some() && self.units[unit].kind == self.units[seed].kind;
        let mut others: Vec<(bool, f64, usize)> = ready
            .iter()
            .filter(|(unit, other)| *unit != seed && layer(*unit) && same_way(other))
            .map(|&(unit, _)| (!same_kind(unit), near_seed(unit), unit))
            // A submodel is shown on its own.
            .filter(|(other_kind, distance, unit)| {
                !other_kind
                    || (*distance < NEAR_LDU && self.units[*unit].kind.is_some() && self.units[seed].kind.is_some())
            })
            .collect();
        others.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        let mut kinds = vec![self.units[seed].kind];
        for (other_kind, _, unit) in others {
            let limit = if other_kind || kinds.len() > 1 { MAX_MIXED } else { MAX_PIECES };
            let kind = self.units[unit].kind;
            if step.len() >= limit || (!kinds.contains(&kind) && kinds.len() >= MAX_KINDS) {
                continue;
            }
            // What was added meanwhile may bar the way.
            if self.ready(unit).is_some_and(|way| same_way(&way)) {
                if !kinds.contains(&kind) {
                    kinds.push(kind);
                }
                self.put(unit);
                step.push(unit);
            }
        }
        self.last = Some(step.iter().fold(Aabb::empty(), |sum, &u| sum.union(&self.boxes[u])).center());
        step
    }

    /// The first brick of all, or of a group that holds to nothing that is there; or, where every brick is barred, one
    /// that at least touches.
    fn begin(&mut self, waiting: &[usize]) -> usize {
        let linked = |unit: &usize| self.links[*unit].iter().any(|link| self.there[link.other]);
        let touching =
            |unit: &usize| self.units[*unit].bricks.iter().any(|&a| self.bricks.iter().any(|&b| self.site.touch(a, b)));
        let lowest = |candidates: &mut dyn Iterator<Item = usize>| {
            candidates.min_by(|&a, &b| {
                // Of bricks at one height the largest: what follows has something to hold to.
                let area = |u: usize| self.boxes[u].extent().x * self.boxes[u].extent().z;
                let bottom = |u: usize| (-self.bottom(u) / LAYER_LDU).round();
                bottom(a).total_cmp(&bottom(b)).then(area(b).total_cmp(&area(a))).then(a.cmp(&b))
            })
        };
        let unit = lowest(&mut waiting.iter().copied().filter(linked))
            .or_else(|| lowest(&mut waiting.iter().copied().filter(touching)))
            .or_else(|| lowest(&mut waiting.iter().copied()))
            .expect("a step is asked for only while something waits");
        self.put(unit);
        self.last = Some(self.boxes[unit].center());
        unit
    }

    fn put(&mut self, unit: usize) {
        self.there[unit] = true;
        self.left -= 1;
        self.bricks.extend(&self.units[unit].bricks);
    }
}
