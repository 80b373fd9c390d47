//! Colour codes and what they look like.

use std::collections::BTreeMap;

/// An LDraw colour: a code of the colour table, or (with 0x2 in the top nibble) a colour value itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ColorCode(pub u32);

impl ColorCode {
    /// Code 16: the colour of the file that refers to this one.
    pub const INHERIT: Self = Self(16);
    /// Code 24: the edge colour that goes with the current colour.
    pub const EDGE: Self = Self(24);

    /// Reads a decimal or `0x` hexadecimal code.
    pub fn parse(word: &str) -> Option<Self> {
        let hex = word.strip_prefix("0x").or_else(|| word.strip_prefix("0X")).or_else(|| word.strip_prefix('#'));
        match hex {
            Some(digits) => u32::from_str_radix(digits, 16).ok().map(Self),
            None => word.parse().ok().map(Self),
        }
    }

    /// This colour seen from a file that is itself drawn in `parent`.
    #[must_use]
    pub fn within(self, parent: Self) -> Self {
        if self == Self::INHERIT { parent } else { self }
    }

    /// The value of a direct colour (`0x2RRGGBB` opaque, `0x3RRGGBB` transparent).
    fn direct(self) -> Option<Color> {
        let alpha = match self.0 >> 24 {
            2 => 255,
            3 => 128,
            _ => return None,
        };
        let rgb = [(self.0 >> 16) as u8, (self.0 >> 8) as u8, self.0 as u8];
        let name = format!("#{:02X}{:02X}{:02X}", rgb[0], rgb[1], rgb[2]);
        Some(Color { code: self, name, rgb, edge_rgb: contrasting(rgb), alpha })
    }
}

impl std::fmt::Display for ColorCode {
    /// As it stands in a file: decimal, or `0x2RRGGBB`.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.direct().is_some() { write!(f, "0x{:07X}", self.0) } else { write!(f, "{}", self.0) }
    }
}

/// What a colour looks like.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Color {
    /// Its code.
    pub code: ColorCode,
    /// Its name, with blanks between words.
    pub name: String,
    /// Surface, 8-bit sRGB.
    pub rgb: [u8; 3],
    /// Edges in drawings, 8-bit sRGB.
    pub edge_rgb: [u8; 3],
    /// 255 is opaque.
    pub alpha: u8,
}

impl Color {
    /// Reads what follows `0 !COLOUR` (LDraw colour definition language).
    pub(crate) fn parse(definition: &str) -> Option<Self> {
        let mut words = definition.split_whitespace();
        let name = words.next()?.replace('_', " ");
        let (mut code, mut rgb, mut edge, mut alpha) = (None, None, None, 255);
        while let Some(key) = words.next() {
            match key {
                "CODE" => code = ColorCode::parse(words.next()?),
                "VALUE" => rgb = parse_rgb(words.next()?),
                "EDGE" => edge = words.next().map(str::to_owned),
                "ALPHA" => alpha = words.next()?.parse().ok()?,
                // Speckles and glitter have values of their own from here on.
                "MATERIAL" => break,
                _ => {}
            }
        }
        let rgb = rgb?;
        let edge_rgb = edge.as_deref().and_then(parse_rgb).unwrap_or_else(|| contrasting(rgb));
        Some(Self { code: code?, name, rgb, edge_rgb, alpha })
    }

    /// The `0 !COLOUR` line that defines it.
    pub(crate) fn definition(&self) -> String {
        let hex = |c: [u8; 3]| format!("#{:02X}{:02X}{:02X}", c[0], c[1], c[2]);
        let alpha = if self.alpha == 255 { String::new() } else { format!(" ALPHA {}", self.alpha) };
        let name = self.name.replace(' ', "_");
        format!("0 !COLOUR {name} CODE {} VALUE {} EDGE {}{alpha}", self.code, hex(self.rgb), hex(self.edge_rgb))
    }
}

fn parse_rgb(word: &str) -> Option<[u8; 3]> {
    let digits = word.strip_prefix('#').or_else(|| word.strip_prefix("0x"))?;
    let value = u32::from_str_radix(digits, 16).ok()?;
    (digits.len() == 6).then_some([(value >> 16) as u8, (value >> 8) as u8, value as u8])
}

/// Dark lines on light surfaces and the other way round.
fn contrasting(rgb: [u8; 3]) -> [u8; 3] {
    let luma = 0.2126 * f64::from(rgb[0]) + 0.7152 * f64::from(rgb[1]) + 0.0722 * f64::from(rgb[2]);
    if luma > 60.0 { [51; 3] } else { [128; 3] }
}

/// What every colour code looks like.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ColorTable(BTreeMap<ColorCode, Color>);

impl ColorTable {
    /// A small table of common colours, for models without a parts library.
    pub fn builtin() -> Self {
        let colors = BUILTIN.iter().map(|&(code, name, rgb, alpha)| {
            let code = ColorCode(code);
            (code, Color { code, name: name.to_owned(), rgb, edge_rgb: contrasting(rgb), alpha })
        });
        Self(colors.collect())
    }

    pub(crate) fn define(&mut self, color: Color) {
        self.0.insert(color.code, color);
    }

    /// What `code` looks like; `None` where neither the table nor the code itself says.
    pub fn get(&self, code: ColorCode) -> Option<Color> {
        self.0.get(&code).cloned().or_else(|| code.direct())
    }

    /// What `code` looks like. Colour 16 that nothing resolves is light grey, an unknown code a loud magenta.
    pub fn look(&self, code: ColorCode) -> Color {
        let stand_in =
            |name: &str, rgb| Color { code, name: name.to_owned(), rgb, edge_rgb: contrasting(rgb), alpha: 255 };
        match code {
            ColorCode::INHERIT | ColorCode::EDGE => stand_in("Uncoloured", UNCOLORED),
            _ => self.get(code).unwrap_or_else(|| stand_in(&format!("Unknown {code}"), [255, 0, 255])),
        }
    }

    /// All colours, by code.
    pub fn iter(&self) -> impl Iterator<Item = &Color> {
        self.0.values()
    }
}

/// The colour of parts to which a model gives none.
const UNCOLORED: [u8; 3] = [163, 165, 168];

/// Codes are LDraw's; the values are our own reading of the moulded plastics.
const BUILTIN: &[(u32, &str, [u8; 3], u8)] = &[
    (0, "Black", [30, 32, 36], 255),
    (1, "Blue", [24, 88, 172], 255),
    (2, "Green", [12, 130, 58], 255),
    (4, "Red", [186, 20, 22], 255),
    (5, "Dark Pink", [206, 92, 138], 255),
    (6, "Brown", [92, 62, 44], 255),
    (7, "Light Grey", [152, 156, 154], 255),
    (8, "Dark Grey", [98, 104, 106], 255),
    (10, "Bright Green", [82, 176, 74], 255),
    (14, "Yellow", [248, 202, 22], 255),
    (15, "White", [242, 243, 242], 255),
    (19, "Tan", [218, 200, 152], 255),
    (22, "Purple", [108, 38, 118], 255),
    (25, "Orange", [238, 122, 24], 255),
    (27, "Lime", [166, 200, 26], 255),
    (28, "Dark Tan", [150, 128, 92], 255),
    (33, "Trans Dark Blue", [20, 60, 160], 128),
    (36, "Trans Red", [198, 24, 20], 128),
    (40, "Trans Black", [96, 92, 84], 128),
    (43, "Trans Light Blue", [174, 228, 240], 128),
    (46, "Trans Yellow", [244, 206, 60], 128),
    (47, "Trans Clear", [250, 250, 250], 128),
    (70, "Reddish Brown", [98, 52, 26], 255),
    (71, "Light Bluish Grey", [160, 164, 166], 255),
    (72, "Dark Bluish Grey", [102, 108, 110], 255),
    (73, "Medium Blue", [116, 150, 200], 255),
    (84, "Medium Nougat", [172, 122, 80], 255),
    (191, "Bright Light Orange", [250, 172, 40], 255),
    (212, "Bright Light Blue", [158, 196, 230], 255),
    (226, "Bright Light Yellow", [252, 232, 126], 255),
    (272, "Dark Blue", [28, 50, 84], 255),
    (288, "Dark Green", [32, 72, 44], 255),
    (308, "Dark Brown", [56, 34, 20], 255),
    (320, "Dark Red", [116, 14, 20], 255),
    (322, "Medium Azure", [92, 190, 214], 255),
    (326, "Yellowish Green", [222, 236, 150], 255),
    (378, "Sand Green", [116, 144, 124], 255),
    (379, "Sand Blue", [112, 130, 148], 255),
    (484, "Dark Orange", [146, 58, 20], 255),
];
