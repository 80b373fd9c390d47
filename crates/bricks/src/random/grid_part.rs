//! Bricks on the grid of studs and plates.

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
}

impl GridPart {
    /// The four orientations of a part that we can draw; none where it does not fit the grid.
    pub fn orientations(number: &str) -> Vec<Self> {
        let text = format!("1 16 0 0 0 1 0 0 0 1 0 0 0 1 {number}.dat\n");
        let Ok(model) = Model::from_text(&text, number, None) else { return vec![] };
        let Some(brick) = model.instances().first() else { return vec![] };
        let shape = model.part_shape(brick.part);
        let Some(upright) = Self::upright(number, &shape, &model.part_studs(brick.part)) else { return vec![] };
        let mut orientations = vec![upright];
        for _ in 0..3 {
            let turned = orientations[orientations.len() - 1].turned();
            orientations.push(turned);
        }
        orientations
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
        Some(Self {
            number: number.to_owned(),
            quarter_turns: 0,
            size,
            studs: cells_with_stud,
            sockets,
            origin: [-low[0] / PITCH_LDU, -low[1] / PITCH_LDU],
            origin_height: (bottom / PLATE_LDU).round() as i32,
        })
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
        }
    }
}
