//! What random models are made of.

use std::collections::BTreeMap;
use std::path::Path;

use mb_job::{InputError, Result};
use serde::{Deserialize, Serialize};

/// The shapes that random models take.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Style {
    /// Narrow and high, with battlements, a roof or a spire.
    Tower,
    /// Long and thin, with windows and a skyline.
    Wall,
    /// A passage with something above it.
    Gate,
    /// Rows of arches, one above the other.
    Arcade,
    /// A deck on piers, with stairs or towers.
    Bridge,
    /// Four walls under a pitched roof.
    House,
    /// Towers with walls between them.
    Castle,
    /// Columns that carry a roof.
    Temple,
    /// Steps on some sides or on all.
    Pyramid,
    /// A round wall with openings.
    Rotunda,
    /// A trunk that spreads out above.
    Tree,
    /// Beams laid crosswise.
    Lattice,
    /// Legs, a body, arms, a head.
    Figure,
    /// Grown brick by brick, up, down and sideways.
    Sculpture,
}

impl Style {
    /// All of them.
    pub const ALL: [Self; 14] = [
        Self::Tower,
        Self::Wall,
        Self::Gate,
        Self::Arcade,
        Self::Bridge,
        Self::House,
        Self::Castle,
        Self::Temple,
        Self::Pyramid,
        Self::Rotunda,
        Self::Tree,
        Self::Lattice,
        Self::Figure,
        Self::Sculpture,
    ];
}

/// Distributions and limits of random models. As TOML:
///
/// ```toml
/// min_size_mm = 80.0
/// max_size_mm = 250.0
/// [bricks]
/// 3001 = 3.0
/// 3039 = 1.0
/// [colors]
/// 4 = 2.0
/// 15 = 1.0
/// [styles]
/// tower = 1.0
/// bridge = 1.0
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RandomProfile {
    /// The longest edge of a model's box is at least this, millimetres.
    pub min_size_mm: f64,
    /// No edge of a model's box is longer than this, millimetres.
    pub max_size_mm: f64,
    /// How many colours a model has at most.
    pub max_colors: usize,
    /// LDraw numbers of bricks that we can draw, with their weights.
    pub bricks: BTreeMap<String, f64>,
    /// LDraw colour codes, with their weights.
    pub colors: BTreeMap<String, f64>,
    /// Shapes, with their weights.
    pub styles: BTreeMap<Style, f64>,
}

impl Default for RandomProfile {
    fn default() -> Self {
        let weights = |list: &[(&str, f64)]| list.iter().map(|&(name, weight)| (name.to_owned(), weight)).collect();
        Self {
            min_size_mm: 80.0,
            max_size_mm: 250.0,
            max_colors: 5,
            bricks: weights(BRICKS),
            colors: weights(COLORS),
            styles: Style::ALL.map(|style| (style, 1.0)).into(),
        }
    }
}

const BRICKS: &[(&str, f64)] = &[
    ("3001", 8.0),
    ("3002", 5.0),
    ("3003", 6.0),
    ("3004", 4.0),
    ("3005", 2.0),
    ("3007", 2.0),
    ("3008", 1.0),
    ("3009", 2.0),
    ("3010", 3.0),
    ("3622", 2.0),
    ("2456", 3.0),
    ("2357", 2.0),
    ("3245a", 1.0),
    ("22886", 0.5),
    ("3020", 3.0),
    ("3021", 2.0),
    ("3022", 3.0),
    ("3023b", 1.0),
    ("3024", 0.5),
    ("3031", 2.0),
    ("3032", 1.0),
    ("3034", 1.0),
    ("3623", 1.0),
    ("3666", 1.0),
    ("3710", 1.0),
    ("3795", 2.0),
    ("2420", 1.0),
    ("3039", 2.0),
    ("3040b", 2.0),
    ("3298", 1.5),
    ("4286", 1.0),
    ("60481a", 1.0),
    ("4460b", 0.5),
    ("3660a", 2.0),
    ("3665a", 1.5),
    ("37352", 1.0),
    ("54200", 1.0),
    ("85984", 1.0),
    ("15571", 0.5),
    ("3062b", 1.5),
    ("3941", 2.0),
    ("4032a", 1.0),
    ("59900", 1.0),
    ("6141", 0.5),
    ("3068b", 1.0),
    ("3069b", 1.0),
    ("2431", 0.5),
    ("4150", 0.5),
    ("2877", 1.0),
];

const COLORS: &[(&str, f64)] = &[
    ("4", 3.0),
    ("1", 3.0),
    ("14", 3.0),
    ("15", 3.0),
    ("2", 2.0),
    ("71", 2.0),
    ("72", 1.5),
    ("0", 1.0),
    ("25", 1.5),
    ("19", 1.5),
    ("70", 1.0),
    ("10", 1.0),
    ("27", 1.0),
    ("320", 0.7),
    ("272", 0.7),
    ("288", 0.7),
    ("322", 0.7),
    ("5", 0.5),
    ("191", 0.7),
];

impl RandomProfile {
    /// Reads a profile; what it leaves out keeps its default.
    ///
    /// # Errors
    /// `Error::Input` for a file that is no such TOML, or for values without meaning.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path).map_err(|e| InputError::unreadable(path, &e))?;
        let profile: Self = toml::from_str(&text).map_err(|e| {
            let place = e.span().map_or(0, |span| text[..span.start.min(text.len())].matches('\n').count() + 1);
            InputError::new(path, e.message().to_owned()).at_line(place)
        })?;
        profile.validate().map_err(|found| InputError::new(path, found).help("See the profile's documentation"))?;
        Ok(profile)
    }

    /// Whether the values mean something; otherwise says what does not.
    ///
    /// # Errors
    /// What is wrong, as a clause.
    pub fn validate(&self) -> std::result::Result<(), String> {
        let positive = |what: &str, weights: &mut dyn Iterator<Item = f64>| {
            let mut sum = 0.0;
            for weight in weights {
                if !(weight.is_finite() && weight >= 0.0) {
                    return Err(format!("a weight of the {what} is negative or no number"));
                }
                sum += weight;
            }
            if sum > 0.0 { Ok(()) } else { Err(format!("the {what} have no weight")) }
        };
        positive("bricks", &mut self.bricks.values().copied())?;
        positive("colors", &mut self.colors.values().copied())?;
        positive("styles", &mut self.styles.values().copied())?;
        if let Some(unknown) = self.bricks.keys().find(|number| !crate::parametric::can_draw(number)) {
            return Err(format!("the brick {unknown} is none that can be drawn"));
        }
        if let Some(unknown) = self.colors.keys().find(|code| code.parse::<u32>().is_err()) {
            return Err(format!("the colour {unknown} is no LDraw code"));
        }
        let sane = self.min_size_mm > 0.0 && self.max_size_mm >= 1.5 * self.min_size_mm && self.max_size_mm <= 1e4;
        if !sane {
            return Err("the sizes must be positive, the largest at least 1.5 times the smallest".to_owned());
        }
        if self.max_colors == 0 { Err("a model needs a colour".to_owned()) } else { Ok(()) }
    }
}
