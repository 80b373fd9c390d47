//! Which LDraw parts we can draw.

use super::block::{Footprint, PLATE, studded, tile};
use super::columns::Columns;
use super::{round, slope, special};

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
    Studded {
        length: usize,
        width: usize,
        plates: usize,
    },
    /// A plate without studs.
    Tile {
        length: usize,
        width: usize,
        groove: bool,
    },
    /// A plate or tile with one stud in its middle.
    Jumper {
        length: usize,
        width: usize,
        groove: bool,
    },
    /// Two arms at a right angle.
    Corner {
        plates: usize,
    },
    Slope45 {
        length: usize,
    },
    Slope33 {
        length: usize,
    },
    Slope65,
    Slope75,
    InvertedSlope45 {
        length: usize,
    },
    /// 31 degrees, two plates high.
    CheeseSlope {
        length: usize,
    },
    CurvedTop,
    TripleSlope,
    RoundPlate,
    RoundBrick,
    Cone,
    RoundPlate2x2,
    RoundBrick2x2,
    RoundTile2x2,
    TallBrick,
    LongBrick,
    Grille,
    CornerPanel,
    SideStud,
}

impl Design {
    /// The design with that number, or with the number that it had earlier.
    pub fn find(number: &str) -> Option<&'static Self> {
        let current = EARLIER_NUMBERS.iter().find(|(earlier, _)| *earlier == number).map_or(number, |(_, now)| now);
        DESIGNS.iter().find(|design| design.number == current)
    }

    /// Its solid.
    pub fn solid(&self) -> Columns {
        let half = |length: usize| 10.0 * length as f64;
        match self.form {
            Form::Studded { length, width, plates } => studded(Footprint { length, width }, plates as f64 * PLATE),
            Form::Tile { length, width, groove } => tile(Footprint { length, width }, groove),
            Form::Jumper { length, width, groove } => special::jumper(Footprint { length, width }, groove),
            Form::Corner { plates } => special::corner(plates as f64 * PLATE),
            Form::Slope45 { length } => slope::slope_45(half(length)),
            Form::Slope33 { length } => slope::slope_33(half(length)),
            Form::Slope65 => slope::slope_65(),
            Form::Slope75 => slope::slope_75(),
            Form::InvertedSlope45 { length } => slope::inverted_slope_45(half(length)),
            Form::CheeseSlope { length } => slope::cheese_slope(half(length)),
            Form::CurvedTop => slope::curved_top(),
            Form::TripleSlope => slope::triple_slope(),
            Form::RoundPlate => round::round_plate(),
            Form::RoundBrick => round::round_brick(),
            Form::Cone => round::cone(),
            Form::RoundPlate2x2 => round::round_plate_2x2(),
            Form::RoundBrick2x2 => round::round_brick_2x2(),
            Form::RoundTile2x2 => round::round_tile_2x2(),
            Form::TallBrick => special::tall_brick(),
            Form::LongBrick => special::long_brick(),
            Form::Grille => special::grille(),
            Form::CornerPanel => special::corner_panel(),
            Form::SideStud => special::side_stud(),
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

const fn one(number: &'static str, title: &'static str, form: Form) -> Design {
    Design { number, title, form }
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
    one("3007", "Brick 2 x 8", Form::LongBrick),
    brick("3006", "Brick 2 x 10", 2, 10),
    plate("3024", "Plate 1 x 1", 1, 1),
    plate("3023b", "Plate 1 x 2", 1, 2),
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
    one("3245a", "Brick 1 x 2 x 2", Form::Studded { length: 2, width: 1, plates: 6 }),
    one("22886", "Brick 1 x 2 x 3", Form::TallBrick),
    one("3794a", "Plate 1 x 2 with 1 stud", Form::Jumper { length: 2, width: 1, groove: false }),
    one("87580", "Plate 2 x 2 with 1 stud", Form::Jumper { length: 2, width: 2, groove: true }),
    one("2420", "Plate 2 x 2 corner", Form::Corner { plates: 1 }),
    one("2357", "Brick 2 x 2 corner", Form::Corner { plates: 3 }),
    one("3040b", "Slope 45 2 x 1", Form::Slope45 { length: 1 }),
    one("3039", "Slope 45 2 x 2", Form::Slope45 { length: 2 }),
    one("3038", "Slope 45 2 x 3", Form::Slope45 { length: 3 }),
    one("3037", "Slope 45 2 x 4", Form::Slope45 { length: 4 }),
    one("4286", "Slope 33 3 x 1", Form::Slope33 { length: 1 }),
    one("3298", "Slope 33 3 x 2", Form::Slope33 { length: 2 }),
    one("60481a", "Slope 65 2 x 1 x 2", Form::Slope65),
    one("4460b", "Slope 75 2 x 1 x 3", Form::Slope75),
    one("3665a", "Slope 45 2 x 1 inverted", Form::InvertedSlope45 { length: 1 }),
    one("3660a", "Slope 45 2 x 2 inverted", Form::InvertedSlope45 { length: 2 }),
    one("54200", "Slope 31 1 x 1 x 2/3", Form::CheeseSlope { length: 1 }),
    one("85984", "Slope 31 1 x 2 x 2/3", Form::CheeseSlope { length: 2 }),
    one("37352", "Brick 1 x 2 with curved top", Form::CurvedTop),
    one("15571", "Slope 45 1 x 2 triple", Form::TripleSlope),
    one("6141", "Plate 1 x 1 round", Form::RoundPlate),
    one("3062b", "Brick 1 x 1 round", Form::RoundBrick),
    one("59900", "Cone 1 x 1", Form::Cone),
    one("4032a", "Plate 2 x 2 round", Form::RoundPlate2x2),
    one("3941", "Brick 2 x 2 round", Form::RoundBrick2x2),
    one("4150", "Tile 2 x 2 round", Form::RoundTile2x2),
    one("2877", "Brick 1 x 2 with grille", Form::Grille),
    one("6231", "Panel 1 x 1 x 1 corner", Form::CornerPanel),
    one("87087", "Brick 1 x 1 with stud on one side", Form::SideStud),
];

/// Numbers that older models use, and what they are called now.
const EARLIER_NUMBERS: &[(&str, &str)] = &[
    ("3023", "3023b"),
    ("3040", "3040b"),
    ("3062", "3062b"),
    ("3068", "3068b"),
    ("3069", "3069b"),
    ("3070", "3070a"),
    ("3245", "3245a"),
    ("3660", "3660a"),
    ("3665", "3665a"),
    ("3794", "3794a"),
    ("4032", "4032a"),
    ("4073", "6141"),
    ("4460", "4460b"),
    ("60481", "60481a"),
];
