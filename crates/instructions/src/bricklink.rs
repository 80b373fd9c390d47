//! What LDraw's colours and parts are called in the catalogue of BrickLink.
//!
//! Colours: LDraw codes of LDConfig.ldr (2024-04-05) whose name, or a name that LDraw itself or BrickLink used before,
//! stands in BrickLink's colour guide. A code that is not in the table has no counterpart that we know of, and is reported.

use mb_bricks::ColorCode;

/// BrickLink's number for an LDraw colour.
pub(crate) fn color_id(color: ColorCode) -> Option<u32> {
    // BrickLink lists rubber parts under the plain colour.
    let code = RUBBER.iter().find(|(rubber, _)| *rubber == color.0).map_or(color.0, |(_, plain)| *plain);
    let at = COLORS.binary_search_by_key(&code, |(ldraw, _)| *ldraw).ok()?;
    Some(COLORS[at].1)
}

/// BrickLink's number for an LDraw part file, and whether that is sure. Plain numbers with at most one letter of a mould
/// variant are the same in both; patterns, assemblies and unknown numbers (`p`, `d`, `c`, `u`, `s` after the
/// number) are numbered differently.
pub(crate) fn item_id(file: &str) -> (String, bool) {
    let name = file.rsplit('/').next().unwrap_or(file);
    let stem = name.strip_suffix(".dat").unwrap_or(name);
    let digits = stem.len() - stem.trim_start_matches(|c: char| c.is_ascii_digit()).len();
    let rest = &stem[digits..];
    let sure = digits >= 2 && (rest.is_empty() || matches!(rest, "a" | "b" | "c" | "d" | "e"));
    (stem.to_owned(), sure)
}

/// LDraw codes of rubber and of the plain colour.
const RUBBER: &[(u32, u32)] = &[
    (65, 14),
    (66, 46),
    (67, 47),
    (256, 0),
    (273, 1),
    (324, 4),
    (350, 25),
    (375, 7),
    (406, 272),
    (449, 22),
    (490, 27),
    (496, 71),
    (504, 179),
    (511, 15),
    (10002, 2),
    (10010, 10),
    (10026, 26),
    (10030, 30),
    (10031, 31),
    (10035, 35),
    (10036, 36),
    (10043, 43),
    (10070, 70),
    (10073, 73),
    (10078, 78),
    (10226, 226),
    (10308, 308),
    (10320, 320),
    (10321, 321),
    (10322, 322),
    (10323, 323),
    (10378, 378),
    (10484, 484),
];

/// LDraw code and BrickLink number, sorted.
const COLORS: &[(u32, u32)] = &[
    (0, 11),      // Black
    (1, 7),       // Blue
    (2, 6),       // Green
    (3, 39),      // Dark Turquoise
    (4, 5),       // Red
    (5, 47),      // Dark Pink
    (6, 8),       // Brown
    (7, 9),       // Light Gray
    (8, 10),      // Dark Gray
    (9, 62),      // Light Blue
    (10, 36),     // Bright Green
    (11, 40),     // Light Turquoise
    (12, 25),     // Salmon
    (13, 23),     // Pink
    (14, 3),      // Yellow
    (15, 1),      // White
    (17, 38),     // Light Green
    (18, 33),     // Light Yellow
    (19, 2),      // Tan
    (20, 44),     // Light Violet
    (21, 46),     // Glow In Dark Opaque
    (22, 24),     // Purple
    (23, 109),    // Dark Blue-Violet: Dark Royal Blue
    (25, 4),      // Orange
    (26, 71),     // Magenta
    (27, 34),     // Lime
    (28, 69),     // Dark Tan
    (29, 104),    // Bright Pink
    (30, 157),    // Medium Lavender
    (31, 154),    // Lavender
    (33, 14),     // Trans-Dark Blue
    (34, 20),     // Trans-Green
    (35, 108),    // Trans-Bright Green
    (36, 17),     // Trans-Red
    (37, 50),     // Trans-Dark Pink
    (38, 18),     // Trans-Neon Orange
    (39, 113),    // Trans-Very Light Blue: Trans-Aqua
    (40, 13),     // Trans-Brown (once Trans-Black)
    (41, 74),     // Trans-Medium Blue
    (42, 16),     // Trans-Neon Green
    (43, 15),     // Trans-Light Blue
    (44, 114),    // Trans-Light Purple (now Trans-Bright Reddish Lilac)
    (45, 107),    // Trans-Pink
    (46, 19),     // Trans-Yellow
    (47, 12),     // Trans-Clear
    (52, 51),     // Trans-Purple
    (54, 121),    // Trans-Neon Yellow
    (57, 98),     // Trans-Orange
    (60, 57),     // Chrome Antique Brass
    (61, 52),     // Chrome Blue
    (62, 64),     // Chrome Green
    (63, 82),     // Chrome Pink
    (64, 122),    // Chrome Black
    (68, 96),     // Very Light Orange
    (69, 93),     // Light Purple (now Bright Reddish Lilac)
    (70, 88),     // Reddish Brown
    (71, 86),     // Light Bluish Gray
    (72, 85),     // Dark Bluish Gray
    (73, 42),     // Medium Blue
    (74, 37),     // Medium Green
    (75, 116),    // Speckle Black-Copper
    (76, 117),    // Speckle Dark Bluish Gray-Silver
    (77, 56),     // Light Pink: Rose Pink
    (78, 90),     // Light Nougat
    (79, 60),     // Milky White
    (80, 67),     // Metallic Silver
    (81, 70),     // Metallic Green
    (82, 65),     // Metallic Gold
    (83, 244),    // Pearl Black
    (84, 150),    // Medium Nougat
    (85, 89),     // Dark Purple (now Medium Lilac)
    (86, 91),     // Light Brown
    (89, 97),     // Royal Blue (now Blue Violet)
    (92, 28),     // Nougat
    (100, 26),    // Light Salmon
    (110, 43),    // Violet
    (112, 73),    // Medium Violet
    (114, 100),   // Glitter Trans-Dark Pink
    (115, 76),    // Medium Lime
    (117, 101),   // Glitter Trans-Clear
    (118, 41),    // Aqua
    (120, 35),    // Light Lime
    (125, 32),    // Light Orange
    (128, 225),   // Dark Nougat
    (129, 102),   // Glitter Trans-Purple
    (132, 111),   // Speckle Black-Silver
    (133, 151),   // Speckle Black-Gold
    (134, 84),    // Copper
    (135, 66),    // Pearl Light Gray
    (142, 61),    // Pearl Light Gold
    (148, 77),    // Pearl Dark Gray
    (150, 119),   // Pearl Very Light Gray
    (151, 99),    // Very Light Bluish Gray
    (179, 95),    // Flat Silver (now Pearl Silver)
    (183, 83),    // Pearl White
    (189, 235),   // Reddish Gold
    (191, 110),   // Bright Light Orange
    (212, 105),   // Bright Light Blue
    (216, 27),    // Rust
    (219, 245),   // Lilac
    (226, 103),   // Bright Light Yellow
    (227, 226),   // Trans-Light Bright Green
    (231, 164),   // Trans-Light Orange
    (232, 87),    // Sky Blue
    (272, 63),    // Dark Blue
    (285, 221),   // Trans-Light Green
    (288, 80),    // Dark Green
    (294, 118),   // Glow In Dark Trans
    (297, 115),   // Pearl Gold
    (300, 250),   // Metallic Copper
    (302, 162),   // Glitter Trans-Light Blue
    (308, 120),   // Dark Brown
    (313, 72),    // Maersk Blue
    (320, 59),    // Dark Red
    (321, 153),   // Dark Azure
    (322, 156),   // Medium Azure
    (323, 152),   // Light Aqua
    (326, 158),   // Yellowish Green
    (329, 159),   // Glow In Dark White
    (330, 155),   // Olive Green
    (334, 21),    // Chrome Gold
    (335, 58),    // Sand Red
    (339, 163),   // Glitter Trans-Neon Green
    (341, 222),   // Glitter Trans-Orange
    (351, 94),    // Medium Dark Pink
    (353, 220),   // Coral
    (360, 228),   // Satin Trans-Clear
    (362, 223),   // Satin Trans-Light Blue
    (364, 224),   // Satin Trans-Dark Pink
    (365, 230),   // Satin Trans-Purple
    (366, 29),    // Earth Orange
    (368, 236),   // Neon Yellow
    (370, 240),   // Medium Brown
    (371, 241),   // Medium Tan
    (373, 54),    // Sand Purple
    (378, 48),    // Sand Green
    (379, 55),    // Sand Blue
    (383, 22),    // Chrome Silver
    (402, 167),   // Reddish Orange
    (422, 169),   // Sienna
    (423, 168),   // Umber
    (450, 106),   // Fabuland Brown
    (462, 31),    // Medium Orange
    (484, 68),    // Dark Orange
    (503, 49),    // Very Light Gray
    (509, 160),   // Fabuland Orange
    (510, 248),   // Fabuland Lime
    (10366, 232), // Satin Trans-Dark Blue
    (10375, 251), // Trans-Black
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_sorted_and_unambiguous() {
        assert!(COLORS.is_sorted_by(|a, b| a.0 < b.0));
        let mut numbers: Vec<u32> = COLORS.iter().map(|(_, id)| *id).collect();
        numbers.sort_unstable();
        numbers.dedup();
        assert_eq!(numbers.len(), COLORS.len(), "two LDraw colours with one number");
        assert!(RUBBER.iter().all(|(rubber, _)| color_id(ColorCode(*rubber)).is_some()));
    }

    #[test]
    fn known_colours_and_parts() {
        for (ldraw, id) in [(0, 11), (4, 5), (15, 1), (47, 12), (71, 86), (256, 11), (10308, 120)] {
            assert_eq!(color_id(ColorCode(ldraw)), Some(id));
        }
        assert_eq!(color_id(ColorCode(0x02FF_8800)), None);
        assert_eq!(item_id("3001.dat"), ("3001".to_owned(), true));
        assert_eq!(item_id("3062b.dat"), ("3062b".to_owned(), true));
        assert_eq!(item_id("973p5b.dat"), ("973p5b".to_owned(), false));
        assert_eq!(item_id("4592c02.dat"), ("4592c02".to_owned(), false));
        assert_eq!(item_id("u9056.dat"), ("u9056".to_owned(), false));
    }
}
