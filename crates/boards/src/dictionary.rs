//! Sets of square markers.

use std::path::Path;

use calib_targets_aruco::builtins::{BUILTIN_DICTIONARY_NAMES, builtin_dictionary};
use mb_job::{InputError, Result};

use crate::settings;

/// A set of markers: squares of `side` x `side` black and white modules inside a black border, told apart by their
/// modules in any of four orientations.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dictionary {
    name: String,
    side: usize,
    /// One marker a number, white = 1, row by row from the top left, the first module in the highest of `side^2` bits.
    codes: Vec<u64>,
}

impl Dictionary {
    /// One of OpenCV's predefined dictionaries, with or without the leading `DICT_`, in any case.
    pub fn predefined(name: &str) -> Option<Self> {
        let wanted = name.to_ascii_uppercase();
        let wanted = wanted.strip_prefix("DICT_").unwrap_or(&wanted);
        let known = Self::predefined_names().find(|n| n.to_ascii_uppercase().strip_prefix("DICT_") == Some(wanted))?;
        let table = builtin_dictionary(known)?;
        let side = table.marker_size();
        let modules = side * side;
        // The table has black = 1 and the first module in the lowest bit.
        let codes = table.codes().iter().map(|code| (!code).reverse_bits() >> (64 - modules)).collect();
        Some(Self { name: known.to_owned(), side, codes })
    }

    /// Names of OpenCV's predefined dictionaries.
    pub fn predefined_names() -> impl Iterator<Item = &'static str> {
        BUILTIN_DICTIONARY_NAMES.iter().copied()
    }

    /// A predefined dictionary by its name, or one in a file as OpenCV writes it (YAML or JSON with `nmarkers`,
    /// `markersize` and `marker_0: "0110.."`, white = 1, row by row). A relative path starts at `folder`.
    ///
    /// # Errors
    /// No such name or file; a marker of the wrong length or missing.
    pub fn find(name: &str, folder: &Path) -> Result<Self> {
        if let Some(dictionary) = Self::predefined(name) {
            return Ok(dictionary);
        }
        let path = folder.join(name);
        if path.extension().is_some_and(|e| ["yml", "yaml", "json"].iter().any(|known| e.eq_ignore_ascii_case(known))) {
            return Self::read(&path);
        }
        let names: Vec<&str> = Self::predefined_names().collect();
        Err(InputError::new(name, "no dictionary of markers has this name")
            .help(format!("Known are {}; or name a .yml or .json file in OpenCV's form", names.join(", ")))
            .into())
    }

    fn read(path: &Path) -> Result<Self> {
        let settings = settings::read(path)?;
        let number = |key: &str| {
            settings
                .get(key)
                .and_then(serde_json::Value::as_u64)
                .ok_or_else(|| InputError::new(path, format!("no whole number '{key}'")))
        };
        let (count, side) = (number("nmarkers")? as usize, number("markersize")? as usize);
        if !(3..=8).contains(&side) || !(1..=100_000).contains(&count) {
            let found = format!("{count} markers of {side}x{side} modules");
            return Err(InputError::new(path, found).help("Markers have 3x3 to 8x8 modules").into());
        }
        let mut codes = Vec::with_capacity(count);
        for id in 0..count {
            let key = format!("marker_{id}");
            let modules = settings.get(&key).and_then(serde_json::Value::as_str).unwrap_or_default();
            let digits = modules.bytes().filter(|b| matches!(b, b'0' | b'1')).count();
            if modules.len() != side * side || digits != modules.len() {
                let found = format!("'{modules}' is not {} digits 0 and 1", side * side);
                return Err(InputError::new(path, found).at(key).into());
            }
            codes.push(modules.bytes().fold(0, |code, b| code << 1 | u64::from(b == b'1')));
        }
        Ok(Self { name: path.display().to_string(), side, codes })
    }

    /// What it is called: a predefined name, or its file.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Modules along one side, without the border.
    pub fn side(&self) -> usize {
        self.side
    }

    /// Number of markers; their ids are 0 and up.
    pub fn len(&self) -> usize {
        self.codes.len()
    }

    /// Whether there is no marker.
    pub fn is_empty(&self) -> bool {
        self.codes.is_empty()
    }

    /// Whether the module in column `x`, row `y` of marker `id` is white.
    pub fn is_white(&self, id: usize, x: usize, y: usize) -> bool {
        self.codes[id] >> (self.side * self.side - 1 - (y * self.side + x)) & 1 == 1
    }

    /// The modules of a marker, white = 1, row by row from the top left, the first in the highest of `side^2` bits.
    pub fn code(&self, id: usize) -> u64 {
        self.codes[id]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_marker_of_the_smallest_dictionary_in_modules() {
        let dictionary = Dictionary::predefined("4x4_50").expect("a predefined dictionary");
        assert_eq!((dictionary.name(), dictionary.side(), dictionary.len()), ("DICT_4X4_50", 4, 50));
        assert_eq!(dictionary.code(0), 0b1011_0101_0011_0010);
        assert!(dictionary.is_white(0, 0, 0) && !dictionary.is_white(0, 1, 0) && dictionary.is_white(0, 2, 3));
    }

    /// Markers and modules in order are those of OpenCV 5.0.0, by their FNV-1a hash; the smaller dictionaries are the
    /// beginnings of the larger ones.
    #[test]
    fn predefined_dictionaries_are_those_of_opencv() {
        let known: [(&str, usize, usize, u64); 10] = [
            ("DICT_4X4_1000", 4, 1000, 0x7c5d_b9e1_a5d4_3f3b),
            ("DICT_5X5_1000", 5, 1000, 0xe940_0f75_a4d2_2a2f),
            ("DICT_6X6_1000", 6, 1000, 0xf5b9_db35_ce45_e078),
            ("DICT_7X7_1000", 7, 1000, 0xe1f3_933e_fbc9_3ff7),
            ("DICT_ARUCO_ORIGINAL", 5, 1024, 0x8cef_deae_efda_ff25),
            ("DICT_APRILTAG_16h5", 4, 30, 0xcae9_40ba_c39c_3325),
            ("DICT_APRILTAG_25h9", 5, 35, 0xce20_9548_33c9_5bc5),
            ("DICT_APRILTAG_36h10", 6, 2320, 0x1e6c_64f9_6402_70c7),
            ("DICT_APRILTAG_36h11", 6, 587, 0x4143_9cfa_91d9_b1be),
            ("DICT_ARUCO_MIP_36h12", 6, 250, 0x6c9a_49bf_3686_9c95),
        ];
        for (name, side, count, hash) in known {
            let dictionary = Dictionary::predefined(name).expect(name);
            assert_eq!((dictionary.side(), dictionary.len()), (side, count), "{name}");
            let modules = (0..count).flat_map(|id| (0..side * side).map(move |i| (id, i % side, i / side)));
            let found = modules.fold(0xcbf2_9ce4_8422_2325u64, |hash, (id, x, y)| {
                (hash ^ u64::from(dictionary.is_white(id, x, y))).wrapping_mul(0x0000_0100_0000_01b3)
            });
            assert_eq!(found, hash, "{name}");
        }
        for side in 4..8 {
            let large = Dictionary::predefined(&format!("{side}X{side}_1000")).expect("a dictionary");
            for count in [50, 100, 250] {
                let small = Dictionary::predefined(&format!("{side}X{side}_{count}")).expect("a dictionary");
                assert!(small.len() == count && (0..count).all(|id| small.code(id) == large.code(id)));
            }
        }
        assert_eq!(Dictionary::predefined_names().count(), 22);
        assert!(Dictionary::predefined("DICT_9X9_50").is_none());
    }

    #[test]
    fn a_dictionary_in_a_file_says_what_is_wrong_with_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let write = |text: &str| std::fs::write(folder.path().join("own.yml"), text).expect("written");
        write("%YAML:1.0\n---\nnmarkers: 2\nmarkersize: 3\nmarker_0: \"100110001\"\nmarker_1: \"011010100\"\n");
        let own = Dictionary::find("own.yml", folder.path()).expect("a dictionary");
        assert_eq!((own.len(), own.code(1)), (2, 0b011_010_100));
        write("%YAML:1.0\nnmarkers: 2\nmarkersize: 3\nmarker_0: \"100110001\"\nmarker_1: \"01101010\"\n");
        let error = Dictionary::find("own.yml", folder.path()).expect_err("too short").to_string();
        assert!(error.contains("marker_1") && error.contains("9 digits"), "{error}");
        assert!(
            Dictionary::find("DICT_4X4_51", folder.path()).expect_err("unknown").to_string().contains("DICT_4X4_50")
        );
    }
}
