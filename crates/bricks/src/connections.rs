//! Which brick holds which: studs and what grips them.
//!
//! A part's studs are the library's stud primitives among its pieces (or the studs that our own parts state). What
//! grips a stud is found from geometry, not from a table: another part grips it where its surfaces come within
//! [`GRIP_LDU`] of the stud's cylinder from at least two sides and do not enter it. That covers tubes, walls, pins,
//! half-stud positions and studs on the side alike, in library parts and in our own.

use std::collections::HashMap;

use nalgebra::{Matrix3, Point3, Vector3};

use crate::flat::Shapes;
use crate::ldraw::file::{Affine, FileId, LdrawFile, StudSite};
use crate::ldraw::shape::PartShape;
use crate::model::Model;
use crate::neighbors::Neighbors;

/// Height of a stud, LDraw units.
const STUD_HEIGHT_LDU: f64 = 4.0;
/// A surface grips a stud (radius 6) that comes this close to its axis. Tubes between four studs come within 6.14.
const GRIP_LDU: f64 = 6.4;
/// A surface nearer to the axis than this is in the way of the stud. Flat facets of round holes reach 5.88.
const BLOCKED_LDU: f64 = 5.2;
/// The part of a stud's height that must be gripped, from its foot.
const GRIPPED_HEIGHT_LDU: [f64; 2] = [0.5, 3.5];

/// Half the distance of two studs, LDraw units.
const HALF_STUD_LDU: f64 = 10.0;
/// So many studs of a part's length and width are looked at to see whether it could grip any.
const MOST_STUDS: i32 = 8;

/// A stud of one brick in the grip of another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Connection {
    /// The brick with the stud: index into [`Model::instances`].
    pub stud_brick: usize,
    /// The brick that grips it.
    pub grip_brick: usize,
    /// Middle of the stud's foot in the model, LDraw units.
    pub foot_in_ldraw: Point3<f64>,
    /// Unit vector towards the stud's tip.
    pub axis_in_ldraw: Vector3<f64>,
}

/// The connections of a model.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Connections {
    /// Every gripped stud, by brick with the stud.
    pub studs: Vec<Connection>,
    /// For each brick, whether it has studs, is held by one, or could be.
    pub covered: Vec<bool>,
}

/// Disjoint sets of numbered things.
pub(crate) struct Sets {
    /// Towards the smallest member of the set.
    parent: Vec<usize>,
}

impl Sets {
    pub fn new(count: usize) -> Self {
        Self { parent: (0..count).collect() }
    }

    fn find(&mut self, mut item: usize) -> usize {
        while self.parent[item] != item {
            self.parent[item] = self.parent[self.parent[item]];
            item = self.parent[item];
        }
        item
    }

    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.find(a), self.find(b));
        self.parent[a.max(b)] = a.min(b);
    }

    /// The sets, members ascending, largest set first.
    pub fn groups(mut self) -> Vec<Vec<usize>> {
        let mut groups: std::collections::BTreeMap<usize, Vec<usize>> = std::collections::BTreeMap::new();
        for item in 0..self.parent.len() {
            groups.entry(self.find(item)).or_default().push(item);
        }
        let mut groups: Vec<Vec<usize>> = groups.into_values().collect();
        groups.sort_by_key(|group| std::cmp::Reverse(group.len()));
        groups
    }
}

impl Model {
    /// The studs of a part, in its own frame.
    pub fn part_studs(&self, part: FileId) -> Vec<StudSite> {
        let mut studs = vec![];
        collect_studs(self.files(), part, &Affine::identity(), &mut studs);
        studs
    }

    /// Which brick holds which.
    pub fn connections(&self) -> Connections {
        let shapes = Shapes::of(self);
        let neighbors = Neighbors::of(self, &shapes);
        connections_with(self, &shapes, &neighbors)
    }
}

pub(crate) fn connections_with(model: &Model, shapes: &Shapes, neighbors: &Neighbors) -> Connections {
    Finder { model, shapes, neighbors, grips: HashMap::new() }.find()
}

/// The depth of references was bounded when the model was loaded.
fn collect_studs(files: &[LdrawFile], id: FileId, part_from_file: &Affine, studs: &mut Vec<StudSite>) {
    let file = &files[id.index()];
    let mut add = |foot: Point3<f64>, axis: Vector3<f64>| {
        if let Some(axis) = axis.try_normalize(1e-9) {
            studs.push(StudSite { foot, axis });
        }
    };
    for stud in &file.studs {
        add(part_from_file.apply(&stud.foot), part_from_file.linear * stud.axis);
    }
    if is_stud(file) {
        // Stretched studs begin inside the part: count back from the tip.
        let tip = part_from_file.apply(&Point3::new(0.0, -STUD_HEIGHT_LDU, 0.0));
        let axis = part_from_file.linear * -Vector3::y();
        add(tip - axis.normalize() * STUD_HEIGHT_LDU, axis);
        return;
    }
    for reference in &file.references {
        if let Some(target) = reference.target {
            collect_studs(files, target, &part_from_file.then_inner(&reference.parent_from_child), studs);
        }
    }
}

/// Whether the file is the library's primitive of a stud that sticks out, of the common size.
fn is_stud(file: &LdrawFile) -> bool {
    const OTHER: [&str; 9] =
        ["Tube", "Underside", "Duplo", "Scala", "Quatro", "Group", "Cross", "Extension", "Placeholder"];
    file.name.starts_with("stud")
        && file.description.starts_with("Stud")
        && !OTHER.iter().any(|word| file.description.contains(word))
}

struct Finder<'a> {
    model: &'a Model,
    shapes: &'a Shapes,
    neighbors: &'a Neighbors,
    /// Whether a part grips a stud at a place in its own frame (foot and axis, in hundredths of a unit).
    grips: HashMap<(FileId, [i64; 6]), bool>,
}

impl Finder<'_> {
    fn find(mut self) -> Connections {
        let bricks = self.model.instances();
        let mut studs_of_part: HashMap<FileId, Vec<StudSite>> = HashMap::new();
        let mut studs = vec![];
        let mut covered = vec![false; bricks.len()];
        for (index, brick) in bricks.iter().enumerate() {
            let sites = studs_of_part.entry(brick.part).or_insert_with(|| self.model.part_studs(brick.part));
            covered[index] |= !sites.is_empty();
            for site in sites.clone() {
                let foot = brick.ldraw_from_part.apply(&site.foot);
                let Some(axis) = (brick.ldraw_from_part.linear * site.axis).try_normalize(1e-9) else { continue };
                let middle = foot + axis * (0.5 * STUD_HEIGHT_LDU);
                for other in self.neighbors.around(&middle, 0.5) {
                    if other != index && self.grips(other, &foot, &axis) {
                        covered[other] = true;
                        let (foot_in_ldraw, axis_in_ldraw) = (foot, axis);
                        studs.push(Connection { stud_brick: index, grip_brick: other, foot_in_ldraw, axis_in_ldraw });
                    }
                }
            }
        }
        // A part that could grip a stud from below, as a tile, and has none there is held by nothing: that is known too.
        let mut could_grip: HashMap<FileId, bool> = HashMap::new();
        for (covered, brick) in covered.iter_mut().zip(bricks).filter(|(covered, _)| !**covered) {
            *covered = *could_grip.entry(brick.part).or_insert_with(|| grips_somewhere(self.shapes.get(brick.part)));
        }
        Connections { studs, covered }
    }

    fn grips(&mut self, brick: usize, foot: &Point3<f64>, axis: &Vector3<f64>) -> bool {
        let brick = &self.model.instances()[brick];
        let Some(part_from_ldraw) = brick.ldraw_from_part.inverse() else { return false };
        let foot = part_from_ldraw.apply(foot);
        let Some(axis) = (part_from_ldraw.linear * axis).try_normalize(1e-9) else { return false };
        let key = [foot.x, foot.y, foot.z, axis.x, axis.y, axis.z].map(|v| (v * 100.0).round() as i64);
        let shape = self.shapes.get(brick.part);
        *self.grips.entry((brick.part, key)).or_insert_with(|| grips_stud(shape, &foot, &axis))
    }
}

/// Whether a part would grip a stud from below somewhere on the grid of half studs.
fn grips_somewhere(shape: &PartShape) -> bool {
    let Some(first) = shape.vertices.first() else { return false };
    let (low, high) =
        shape.vertices.iter().fold((first.coords, first.coords), |(l, h), p| (l.inf(&p.coords), h.sup(&p.coords)));
    let places = |axis: usize| {
        (1..2 * MOST_STUDS)
            .map(move |half| low[axis] + HALF_STUD_LDU * f64::from(half))
            .take_while(move |v| *v < high[axis])
    };
    places(0).any(|x| places(2).any(|z| grips_stud(shape, &Point3::new(x, high.y, z), &-Vector3::y())))
}

/// Whether a part's surfaces hold a stud at `foot` that points along `axis`, all in the part's frame.
pub(crate) fn grips_stud(shape: &PartShape, foot: &Point3<f64>, axis: &Vector3<f64>) -> bool {
    // In the stud's frame x and y lie across, z along it.
    let across = axis.cross(&if axis.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() }).normalize();
    let rotation = Matrix3::from_rows(&[across.transpose(), axis.cross(&across).transpose(), axis.transpose()]);
    let mut holds: Vec<[f64; 2]> = vec![];
    for triangle in &shape.triangles {
        let corners = triangle.map(|v| rotation * (shape.vertices[v as usize] - foot));
        let reach =
            |axis: usize| corners.iter().map(|c| c[axis]).fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        let ((x0, x1), (y0, y1), (z0, z1)) = (reach(0), reach(1), reach(2));
        let [low, high] = GRIPPED_HEIGHT_LDU;
        if x0 > GRIP_LDU || x1 < -GRIP_LDU || y0 > GRIP_LDU || y1 < -GRIP_LDU || z0 > high || z1 < low {
            continue;
        }
        let slice = clipped_to_slab(&corners, low, high);
        let Some(nearest) = nearest_to_axis(&slice) else { continue };
        let distance = nearest[0].hypot(nearest[1]);
        if distance < BLOCKED_LDU {
            return false;
        }
        if distance < GRIP_LDU {
            holds.push(nearest);
        }
    }
    // From two sides: one wall alone would let the stud slip away.
    holds.iter().any(|a| holds.iter().any(|b| a[0] * b[0] + a[1] * b[1] < 0.3 * GRIP_LDU * GRIP_LDU))
}

/// The part of a triangle between two heights z.
fn clipped_to_slab(corners: &[Vector3<f64>; 3], low: f64, high: f64) -> Vec<Vector3<f64>> {
    let mut polygon = corners.to_vec();
    for (limit, side) in [(low, 1.0), (high, -1.0)] {
        let mut kept = vec![];
        for (index, p) in polygon.iter().enumerate() {
            let q = &polygon[(index + 1) % polygon.len()];
            let (a, b) = ((p.z - limit) * side, (q.z - limit) * side);
            if a >= 0.0 {
                kept.push(*p);
            }
            if (a > 0.0 && b < 0.0) || (a < 0.0 && b > 0.0) {
                kept.push(p + (q - p) * (a / (a - b)));
            }
        }
        polygon = kept;
    }
    polygon
}

/// The point of a flat polygon, seen along z, that is nearest to the axis.
fn nearest_to_axis(polygon: &[Vector3<f64>]) -> Option<[f64; 2]> {
    let mut nearest: Option<[f64; 2]> = None;
    let mut turns = (false, false);
    for (index, p) in polygon.iter().enumerate() {
        let q = &polygon[(index + 1) % polygon.len()];
        let (d, length) = ([q.x - p.x, q.y - p.y], (q.x - p.x).powi(2) + (q.y - p.y).powi(2));
        let t = if length > 0.0 { (-(p.x * d[0] + p.y * d[1]) / length).clamp(0.0, 1.0) } else { 0.0 };
        let point = [p.x + t * d[0], p.y + t * d[1]];
        if nearest.is_none_or(|n| point[0].hypot(point[1]) < n[0].hypot(n[1])) {
            nearest = Some(point);
        }
        let turn = p.x * q.y - p.y * q.x;
        turns = (turns.0 || turn > 0.0, turns.1 || turn < 0.0);
    }
    // All edges turn the same way about the axis: it pierces the polygon.
    if polygon.len() > 2 && turns.0 != turns.1 { Some([0.0, 0.0]) } else { nearest }
}
