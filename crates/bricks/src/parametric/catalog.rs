//! Which LDraw parts we can draw.

use super::block::{BRICK, Footprint, PLATE, studded, tile};
use super::columns::Columns;

/// A part that we can draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Design {
    /// LDraw's number, without `.dat`.
    pub number: &'static str,
    /// What it is, in our words.
    pub title: &'static str,
    /// Its form.
    pub form: Form,
}

/// The forms of our bricks. Lengths are counted in studs, along x and z; heights in plates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Form {
    /// A box with studs on top, hollow below.
    Studded { length: usize, width: usize, plates: usize },
    /// A plate without studs.
    Tile { length: usize, width: usize, groove: bool },
}

impl Design {
    /// The design with that number.
    pub fn find(number: &str) -> Option<&'static Self> {
        DESIGNS.iter().find(|design| design.number == number)
    }

    /// Its solid.
    pub fn solid(&self) -> Columns {
        match self.form {
            Form::Studded { length, width, plates } => {
                let height = if plates % 3 == 0 { plates as f64 / 3.0 * BRICK } else { plates as f64 * PLATE };
                studded(Footprint { length, width }, height)
            }
            Form::Tile { length, width, groove } => tile(Footprint { length, width }, groove),
        }
    }
}

const fn brick(number: &'static str, title: &'static str, width: usize, length: usize) -> Design {
    Design { number, title, form: Form::Studded { length, width, plates: 3 } }
}

const fn plate(number: &'static str, title: &'static str, width: usize, length: usize) -> Design {
    Design { number, title, form: Form::Studded { length, width, plates: 1 } }
}

const fn flat(number: &'static str, title: &'static str, width: usize, length: usize) -> Design {
    Design { number, title, form: Form::Tile { length, width, groove: true } }
}

/// All of them.
pub(crate) const DESIGNS: &[Design] = &[
    brick("3005", "Brick 1 x 1", 1, 1),
    brick("3004", "Brick 1 x 2", 1, 2),
    brick("3622", "Brick 1 x 3", 1, 3),
    brick("3010", "Brick 1 x 4", 1, 4),
    brick("3009", "Brick 1 x 6", 1, 6),
    brick("3008", "Brick 1 x 8", 1, 8),
    brick("6111", "Brick 1 x 10", 1, 10),
    brick("6112", "Brick 1 x 12", 1, 12),
    brick("3003", "Brick 2 x 2", 2, 2),
    brick("3002", "Brick 2 x 3", 2, 3),
    brick("3001", "Brick 2 x 4", 2, 4),
    brick("2456", "Brick 2 x 6", 2, 6),
    brick("3007", "Brick 2 x 8", 2, 8),
    brick("3006", "Brick 2 x 10", 2, 10),
    plate("3024", "Plate 1 x 1", 1, 1),
    plate("3023b", "Plate 1 x 2", 1, 2),
    plate("3023", "Plate 1 x 2", 1, 2),
    plate("3623", "Plate 1 x 3", 1, 3),
    plate("3710", "Plate 1 x 4", 1, 4),
    plate("3666", "Plate 1 x 6", 1, 6),
    plate("3460", "Plate 1 x 8", 1, 8),
    plate("4477", "Plate 1 x 10", 1, 10),
    plate("60479", "Plate 1 x 12", 1, 12),
    plate("3022", "Plate 2 x 2", 2, 2),
    plate("3021", "Plate 2 x 3", 2, 3),
    plate("3020", "Plate 2 x 4", 2, 4),
    plate("3795", "Plate 2 x 6", 2, 6),
    plate("3034", "Plate 2 x 8", 2, 8),
    plate("3832", "Plate 2 x 10", 2, 10),
    plate("2445", "Plate 2 x 12", 2, 12),
    plate("4282", "Plate 2 x 16", 2, 16),
    plate("3031", "Plate 4 x 4", 4, 4),
    plate("3032", "Plate 4 x 6", 4, 6),
    plate("3035", "Plate 4 x 8", 4, 8),
    plate("3030", "Plate 4 x 10", 4, 10),
    plate("3029", "Plate 4 x 12", 4, 12),
    plate("3958", "Plate 6 x 6", 6, 6),
    plate("3036", "Plate 6 x 8", 6, 8),
    plate("3033", "Plate 6 x 10", 6, 10),
    plate("41539", "Plate 8 x 8", 8, 8),
    Design {
        number: "3070a",
        title: "Tile 1 x 1 without groove",
        form: Form::Tile { length: 1, width: 1, groove: false },
    },
    flat("3070b", "Tile 1 x 1", 1, 1),
    flat("3069b", "Tile 1 x 2", 1, 2),
    flat("63864", "Tile 1 x 3", 1, 3),
    flat("2431", "Tile 1 x 4", 1, 4),
    flat("6636", "Tile 1 x 6", 1, 6),
    flat("4162", "Tile 1 x 8", 1, 8),
    flat("3068b", "Tile 2 x 2", 2, 2),
];
