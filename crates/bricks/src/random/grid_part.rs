//! Bricks on the grid of studs and plates.

use std::collections::BTreeMap;

use nalgebra::{Point3, Vector3};

use crate::connections::grips_stud;
use crate::ldraw::shape::PartShape;
use crate::model::Model;
use crate::sketch::{PITCH_LDU, PLATE_LDU};

/// A brick in one of its four orientations: what it fills and where it holds, in cells from its low corner.
#[derive(Debug, Clone)]
pub(crate) struct GridPart {
    pub number: String,
    pub quarter_turns: i32,
    /// Studs along x, plates upwards, studs along z.
    pub size: [i32; 3],
    /// Cells of the footprint with a stud on top, and the height of its foot in plates.
    pub studs: Vec<[i32; 3]>,
    /// Cells of the footprint that grip a stud from below.
    pub sockets: Vec<[i32; 2]>,
    /// Origin of the part from its low corner: studs along x and z; its top face in plates above its bottom.
    pub origin: [f64; 2],
    pub origin_height: i32,
    /// What it is good for.
    pub role: Role,
}

/// What a brick is good for in building.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Role {
    /// A full box with studs and grips on every square.
    Block,
    /// The same with a round outline.
    Round,
    /// Falls away from its studs, which stand in the row towards `x` or `z`.
    Slope([i32; 2]),
    /// Stands out over what carries it, towards `x` or `z`.
    Corbel([i32; 2]),
    /// Nothing goes on top.
    Cap,
    /// Anything else.
    Other,
}

/// The bricks of a profile in all orientations, with their weights.
#[derive(Debug, Clone, Default)]
pub(crate) struct PartSet {
    pub parts: Vec<(GridPart, f64)>,
    of_role: BTreeMap<Role, Vec<usize>>,
}

impl PartSet {
    /// Bricks with weights; those that grip nothing are left out.
    pub fn new(weights: &BTreeMap<String, f64>) -> Self {
        let mut set = Self::default();
        for (number, &weight) in weights.iter().filter(|(_, weight)| **weight > 0.0) {
            let orientations = GridPart::orientations(number);
            let each = weight / orientations.len().max(1) as f64;
            for part in orientations.into_iter().filter(|part| !part.sockets.is_empty()) {
                set.of_role.entry(part.role).or_default().push(set.parts.len());
                set.parts.push((part, each));
            }
        }
        set
    }

    /// Indices of the bricks that are good for something.
    pub fn with_role(&self, role: Role) -> &[usize] {
        self.of_role.get(&role).map_or(&[], Vec::as_slice)
    }
}

impl GridPart {
    /// The four orientations of a part that we can draw; none where it does not fit the grid.
    pub fn orientations(number: &str) -> Vec<Self> {
        let text = format!("1 16 0 0 0 1 0 0 0 1 0 0 0 1 {number}.dat\n");
        let Ok(model) = Model::from_text(&text, number, None) else { return vec![] };
        let Some(brick) = model.instances().first() else { return vec![] };
        let shape = model.part_shape(brick.part);
        let Some(upright) = Self::upright(number, &shape, &model.part_studs(brick.part)) else { return vec![] };
        // Blocks look the same after half a turn, square ones after a quarter.
        let different = match upright.role {
            Role::Block | Role::Round if upright.size[0] == upright.size[2] => 1,
            Role::Block | Role::Round => 2,
            _ => 4,
        };
        let mut orientations = vec![upright];
        while orientations.len() < different {
            let turned = orientations[orientations.len() - 1].turned();
            orientations.push(turned);
        }
        orientations
    }

    /// The squares under it when its low corner is at `corner`.
    pub fn squares(&self, [x, _, z]: [i32; 3]) -> impl Iterator<Item = [i32; 2]> + use<> {
        let [width, _, depth] = self.size;
        (0..width).flat_map(move |i| (0..depth).map(move |j| [x + i, z + j]))
    }

    /// How many squares it covers.
    pub fn area(&self) -> usize {
        (self.size[0] * self.size[2]) as usize
    }

    fn with_role(mut self, fills_its_corners: bool) -> Self {
        let on_top = self.studs.iter().all(|s| s[1] == self.size[1]);
        // From the middle of one set of squares to the middle of another.
        let towards = |from: &[[i32; 2]], to: &[[i32; 2]]| -> [i32; 2] {
            let middle = |squares: &[[i32; 2]], i: usize| {
                squares.iter().map(|s| f64::from(s[i])).sum::<f64>() / squares.len().max(1) as f64
            };
            std::array::from_fn(|i| {
                let step = middle(to, i) - middle(from, i);
                if step.abs() > 1e-6 { step.signum() as i32 } else { 0 }
            })
        };
        let squares: Vec<[i32; 2]> = self.squares([0; 3]).collect();
        let studs: Vec<[i32; 2]> = self.studs.iter().map(|s| [s[0], s[2]]).collect();
        let one_way = |way: [i32; 2]| way[0].abs() + way[1].abs() == 1;
        let (full_top, full_bottom) = (studs.len() == self.area() && on_top, self.sockets.len() == self.area());
        self.role = if studs.is_empty() {
            Role::Cap
        } else if full_top && full_bottom {
            if fills_its_corners { Role::Block } else { Role::Round }
        } else if full_top && one_way(towards(&self.sockets, &squares)) {
            Role::Corbel(towards(&self.sockets, &squares))
        } else if on_top && one_way(towards(&squares, &studs)) {
            Role::Slope(towards(&squares, &studs))
        } else {
            Role::Other
        };
        self
    }

    fn upright(number: &str, shape: &PartShape, studs: &[crate::StudSite]) -> Option<Self> {
        let bounds = mb_geometry::Aabb::of(&shape.vertices);
        let bottom = bounds.max.y;
        let top = studs.iter().map(|stud| stud.foot.y).fold(f64::INFINITY, f64::min).min(bounds.min.y + 4.0);
        let top = if studs.is_empty() { bounds.min.y } else { top };
        let cells = |length: f64| (length / PITCH_LDU).round() as i32;
        let plates = ((bottom - top) / PLATE_LDU - 1e-6).ceil() as i32;
        let size = [cells(bounds.extent().x), plates, cells(bounds.extent().z)];
        let low = [bounds.min.x, bounds.min.z];
        let fits = (bounds.extent().x - f64::from(size[0]) * PITCH_LDU).abs() < 0.5
            && (bounds.extent().z - f64::from(size[2]) * PITCH_LDU).abs() < 0.5
            && (bottom / PLATE_LDU).fract().abs() < 1e-6;
        if !fits {
            return None;
        }
        let mut cells_with_stud = vec![];
        for stud in studs {
            let at = [(stud.foot.x - low[0]) / PITCH_LDU - 0.5, (stud.foot.z - low[1]) / PITCH_LDU - 0.5];
            let height = (bottom - stud.foot.y) / PLATE_LDU;
            let on_grid = at.iter().chain([&height]).all(|v| (v - v.round()).abs() < 1e-3);
            if stud.axis.y > -0.99 || !on_grid {
                return None;
            }
            cells_with_stud.push([at[0].round() as i32, height.round() as i32, at[1].round() as i32]);
        }
        let mut sockets = vec![];
        for i in 0..size[0] {
            for j in 0..size[2] {
                let x = low[0] + (f64::from(i) + 0.5) * PITCH_LDU;
                let z = low[1] + (f64::from(j) + 0.5) * PITCH_LDU;
                if grips_stud(shape, &Point3::new(x, bottom, z), &-Vector3::y()) {
                    sockets.push([i, j]);
                }
            }
        }
        let corner = |x: f64, y: f64, z: f64| {
            let at = Point3::new(x, y, z);
            shape.vertices.iter().any(|p| (p - at).amax() < 0.1)
        };
        let fills_its_corners = [bounds.min.x, bounds.max.x]
            .iter()
            .all(|&x| [bounds.min.z, bounds.max.z].iter().all(|&z| [top, bottom].iter().all(|&y| corner(x, y, z))));
        let part = Self {
            number: number.to_owned(),
            quarter_turns: 0,
            size,
            studs: cells_with_stud,
            sockets,
            origin: [-low[0] / PITCH_LDU, -low[1] / PITCH_LDU],
            origin_height: (bottom / PLATE_LDU).round() as i32,
            role: Role::Other,
        };
        Some(part.with_role(fills_its_corners))
    }

    /// A quarter turn more: x takes the place of z, and -z that of x.
    fn turned(&self) -> Self {
        let length = self.size[0];
        let cell = |i: i32, j: i32| [j, length - 1 - i];
        Self {
            number: self.number.clone(),
            quarter_turns: self.quarter_turns + 1,
            size: [self.size[2], self.size[1], self.size[0]],
            studs: self.studs.iter().map(|&[i, h, j]| [cell(i, j)[0], h, cell(i, j)[1]]).collect(),
            sockets: self.sockets.iter().map(|&[i, j]| cell(i, j)).collect(),
            origin: [self.origin[1], f64::from(length) - self.origin[0]],
            origin_height: self.origin_height,
            // x takes the place of z, and -z that of x.
            role: match self.role {
                Role::Slope([x, z]) => Role::Slope([z, -x]),
                Role::Corbel([x, z]) => Role::Corbel([z, -x]),
                role => role,
            },
        }
    }
}
