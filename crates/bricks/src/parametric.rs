//! Bricks drawn by ourselves, so that common models need no parts library.
//!
//! Each goes by the number of the LDraw part that it stands for, with the same nominal dimensions, origin and axes.
//! The surfaces are closed and consistently oriented, which those of the library are not; names on studs and the finer
//! ribs inside are left out.

pub(crate) mod block;
pub(crate) mod catalog;
pub(crate) mod columns;
mod round;
mod slope;
mod special;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::{LazyLock, OnceLock};

use nalgebra::Point3;

use crate::ldraw::file::{FileKind, LdrawFile};
use crate::ldraw::parse::parse;
use crate::ldraw::warnings::Warnings;
use catalog::{DESIGNS, Design};
use columns::Surface;

/// An edge is sharp where its two triangles turn by more than this (a 16-sided circle turns by 22.5 degrees).
const SHARP_DEG: f64 = 30.0;

/// The LDraw numbers (such as `3001`) of the bricks that can be drawn without a parts library, with what they are.
pub fn drawable_parts() -> impl Iterator<Item = (&'static str, &'static str)> {
    DESIGNS.iter().map(|design| (design.number, design.title))
}

/// Whether the LDraw part of that number can be drawn.
pub(crate) fn can_draw(number: &str) -> bool {
    Design::find(number).is_some()
}

/// The file that stands for the LDraw part `name` (such as `3001.dat`), where we can draw it.
pub(crate) fn part_file(name: &str) -> Option<LdrawFile> {
    static DRAWN: LazyLock<Vec<OnceLock<LdrawFile>>> =
        LazyLock::new(|| DESIGNS.iter().map(|_| OnceLock::new()).collect());
    let design = Design::find(name.strip_suffix(".dat")?)?;
    let index = DESIGNS.iter().position(|other| other.number == design.number)?;
    let mut file = DRAWN.get(index)?.get_or_init(|| draw(design)).clone();
    name.clone_into(&mut file.name);
    Some(file)
}

fn draw(design: &Design) -> LdrawFile {
    let text = ldraw_text(design);
    let kind = Some(FileKind::Part);
    let document = parse(text.as_bytes(), "drawn by ourselves", design.number, kind, &mut Warnings::default());
    document.ok().and_then(|mut document| document.files.pop()).expect("our own text is valid")
}

/// The design as an LDraw part file. Text is the only form, so that copies of it are exact.
fn ldraw_text(design: &Design) -> String {
    let solid = design.solid();
    let surface = solid.surface();
    let mut text = format!("0 {}\n0 Name: {}.dat\n", design.title, design.number);
    text.push_str("0 // Closed surface with nominal dimensions, drawn by MobileBrick\n");
    text.push_str("0 !LDRAW_ORG Unofficial_Part\n0 BFC CERTIFY CCW\n");
    let point = |text: &mut String, p: &Point3<f64>| {
        for v in [p.x, p.y, p.z] {
            // Four decimals are 0.04 micrometres. Adding 0.0 turns -0 into 0.
            let v = (v * 1e4).round() / 1e4 + 0.0;
            let _ = write!(text, " {v}");
        }
    };
    for stud in &solid.studs {
        text.push_str("0 !MOBILEBRICK STUD");
        point(&mut text, &stud.foot);
        point(&mut text, &Point3::from(stud.axis));
        text.push('\n');
    }
    for [a, b] in sharp_edges(&surface) {
        text.push_str("2 24");
        point(&mut text, &a);
        point(&mut text, &b);
        text.push('\n');
    }
    for triangle in &surface.triangles {
        text.push_str("3 16");
        for &corner in triangle {
            point(&mut text, &surface.vertices[corner as usize]);
        }
        text.push('\n');
    }
    text
}

/// The edges at which the surface turns.
fn sharp_edges(surface: &Surface) -> Vec<[Point3<f64>; 2]> {
    let corner = |v: u32| surface.vertices[v as usize];
    let mut normal_of_edge = BTreeMap::new();
    for &[a, b, c] in &surface.triangles {
        let normal = (corner(b) - corner(a)).cross(&(corner(c) - corner(a)));
        for edge in [(a, b), (b, c), (c, a)] {
            normal_of_edge.insert(edge, normal);
        }
    }
    let is_sharp = |(&(a, b), normal): (&(u32, u32), _)| {
        let other = normal_of_edge.get(&(b, a))?;
        let turned: f64 = nalgebra::Vector3::angle(normal, other);
        (a < b && turned > SHARP_DEG.to_radians()).then(|| [corner(a), corner(b)])
    };
    normal_of_edge.iter().filter_map(is_sharp).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use columns::tests::{assert_closed, volume};

    #[test]
    fn every_design_is_closed_and_encloses_volume() {
        for design in DESIGNS {
            let surface = design.solid().surface();
            assert_closed(&surface, design.title);
            assert!(volume(&surface) > 0.0, "{}", design.title);
        }
    }

    #[test]
    fn every_part_can_be_read_back() {
        for (number, title) in drawable_parts() {
            let file = part_file(&format!("{number}.dat")).unwrap();
            assert_eq!(file.description, title);
            assert!(!file.faces.is_empty() && file.faces.iter().all(|face| !face.two_sided), "{number}");
        }
    }

    #[test]
    fn numbers_are_unique() {
        for (index, design) in DESIGNS.iter().enumerate() {
            assert!(DESIGNS[..index].iter().all(|other| other.number != design.number), "{}", design.number);
        }
    }
}
