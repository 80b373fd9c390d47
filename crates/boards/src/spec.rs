//! What is printed on a board, and where.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use mb_job::{Error, InputError, Result};
use nalgebra::Point2;
use serde::Deserialize;

use crate::{Dictionary, settings};

/// How the markers of a board are arranged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BoardPattern {
    /// A chessboard with a marker in every white square. Its inner corners are the points to measure.
    Charuco {
        /// Side of a square, metres.
        square_m: f64,
        /// Side of a marker with its black border, metres.
        marker_m: f64,
        /// Whether a board of an even number of rows starts with a white square, as OpenCV before 4.6 drew it.
        legacy: bool,
    },
    /// Markers alone, in rows and columns. Their corners are the points to measure.
    Grid {
        /// Side of a marker with its black border, metres.
        marker_m: f64,
        /// White between two markers, metres.
        gap_m: f64,
    },
}

/// A board: its markers and the points on it that a camera can measure, in the board's frame.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardSpec {
    pattern: BoardPattern,
    columns: usize,
    rows: usize,
    dictionary: Dictionary,
    markers: Vec<Marker>,
}

/// One marker on a board.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Marker {
    /// Its id in the dictionary.
    pub id: usize,
    /// Its top left corner, metres, board frame.
    pub top_left_m: Point2<f64>,
    /// Side with the black border, metres.
    pub side_m: f64,
}

impl Marker {
    /// The corners clockwise from the top left, metres, board frame (z = 0).
    pub fn corners_m(&self) -> [Point2<f64>; 4] {
        let Point2 { coords } = self.top_left_m;
        [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
            .map(|(x, y)| Point2::new(coords.x + x * self.side_m, coords.y + y * self.side_m))
    }
}

/// Squares or markers along one side of a board.
const MOST_ALONG: usize = 200;
/// A larger square or marker is a mistaken unit.
const LARGEST_M: f64 = 2.0;

impl BoardSpec {
    /// A board of `columns` x `rows` squares or markers, whose markers count up from `first_id` row by row.
    ///
    /// # Errors
    /// A side of the board, of a square or of a marker is out of range, or the dictionary has too few markers.
    pub fn new(
        pattern: BoardPattern,
        columns: usize,
        rows: usize,
        dictionary: Dictionary,
        first_id: usize,
    ) -> Result<Self> {
        let count = place(&pattern, columns.min(MOST_ALONG), rows.min(MOST_ALONG)).count();
        Self::with_ids(pattern, columns, rows, dictionary, &(first_id..first_id + count).collect::<Vec<_>>())
    }

    /// A board whose markers have these ids, row by row.
    ///
    /// # Errors
    /// As [`BoardSpec::new`]; also where the number of ids is not that of the markers, or one occurs twice.
    pub fn with_ids(
        pattern: BoardPattern,
        columns: usize,
        rows: usize,
        dictionary: Dictionary,
        ids: &[usize],
    ) -> Result<Self> {
        let wrong = |found: String, help: &str| Err(InputError::new("board", found).help(help).into());
        let fewest = if matches!(pattern, BoardPattern::Charuco { .. }) { 2 } else { 1 };
        if !(fewest..=MOST_ALONG).contains(&columns) || !(fewest..=MOST_ALONG).contains(&rows) {
            let found = format!("{columns}x{rows} squares or markers");
            return wrong(found, &format!("A board has {fewest} to {MOST_ALONG} along each side"));
        }
        let lengths = match pattern {
            BoardPattern::Charuco { square_m, marker_m, .. } => [("square", square_m), ("marker", marker_m)],
            BoardPattern::Grid { marker_m, gap_m } => [("marker", marker_m), ("gap", gap_m)],
        };
        for (what, length_m) in lengths {
            if !(length_m > 1e-5 && length_m <= LARGEST_M) {
                let found = format!("a {what} of {length_m} m");
                return wrong(found, "Lengths are in metres, above 0 and at most 2: a square of 40 mm is 0.04");
            }
        }
        if let BoardPattern::Charuco { square_m, marker_m, .. } = pattern
            && marker_m >= square_m
        {
            return wrong(
                format!("a marker of {marker_m} m in a square of {square_m} m"),
                "A marker must be smaller than its square; the square's side comes first",
            );
        }
        let places: Vec<Point2<f64>> = place(&pattern, columns, rows).collect();
        if ids.len() != places.len() {
            let found = format!("{} ids for {} markers", ids.len(), places.len());
            return wrong(found, "Name one id for every marker, row by row");
        }
        if let Some(id) = ids.iter().find(|id| **id >= dictionary.len()) {
            let found = format!("marker {id} is needed, but {} has only {}", dictionary.name(), dictionary.len());
            return wrong(found, "Choose a larger dictionary, or a smaller board");
        }
        let mut sorted = ids.to_vec();
        sorted.sort_unstable();
        if let Some(pair) = sorted.windows(2).find(|pair| pair[0] == pair[1]) {
            return wrong(format!("marker {} is on the board twice", pair[0]), "Give every marker an id of its own");
        }
        let side_m = match pattern {
            BoardPattern::Charuco { marker_m, .. } | BoardPattern::Grid { marker_m, .. } => marker_m,
        };
        let markers = ids.iter().zip(places).map(|(&id, top_left_m)| Marker { id, top_left_m, side_m }).collect();
        Ok(Self { pattern, columns, rows, dictionary, markers })
    }

    /// A board from its text, or from the file that the text names (`.json`, `.yml`, `.yaml`); docs/formats.md has
    /// both.
    ///
    /// # Errors
    /// The text or file is malformed; what was found and what was expected is said.
    pub fn parse(text: &str) -> Result<Self> {
        if ["json", "yml", "yaml"].iter().any(|e| text.to_ascii_lowercase().ends_with(&format!(".{e}")))
            && !text.starts_with("charuco:")
            && !text.starts_with("grid:")
        {
            return Self::read(Path::new(text));
        }
        named(text, Self::parse_text(text))
    }

    fn parse_text(text: &str) -> Result<Self> {
        const FORM: &str = "A board is charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY[:legacy] or \
                            grid:COLUMNSxROWS:MARKER_M:GAP_M:DICTIONARY[:FIRST_ID], such as \
                            charuco:5x7:0.04:0.02:DICT_6X6_250; or a .json or .yml file";
        let wrong = |found: String| Error::from(InputError::new("board", found).help(FORM));
        let fields: Vec<&str> = text.trim().split(':').collect();
        let &[kind, size, first, second, dictionary, ref rest @ ..] = fields.as_slice() else {
            return Err(wrong(format!("{} fields between colons, 5 are needed", fields.len())));
        };
        let count = |text: &str| {
            text.trim().parse::<usize>().map_err(|_| wrong(format!("'{text}' is not a whole number above 0")))
        };
        let length = |text: &str| text.trim().parse::<f64>().map_err(|_| wrong(format!("'{text}' is not a length")));
        let (columns, rows) = size
            .split_once(['x', 'X'])
            .ok_or_else(|| wrong(format!("'{size}' is not COLUMNSxROWS")))
            .and_then(|(columns, rows)| Ok((count(columns)?, count(rows)?)))?;
        let (first, second) = (length(first)?, length(second)?);
        let dictionary = Dictionary::find(dictionary.trim(), Path::new(""))?;
        let unknown = |field: &str| wrong(format!("'{field}' after the dictionary means nothing"));
        match kind.trim().to_ascii_lowercase().as_str() {
            "charuco" => {
                let legacy = match rest {
                    [] => false,
                    [field] if field.trim().eq_ignore_ascii_case("legacy") => true,
                    [field, ..] => return Err(unknown(field)),
                };
                let pattern = BoardPattern::Charuco { square_m: first, marker_m: second, legacy };
                Self::new(pattern, columns, rows, dictionary, 0)
            }
            "grid" => {
                let first_id = match rest {
                    [] => 0,
                    [field] => count(field)?,
                    [_, field, ..] => return Err(unknown(field)),
                };
                let pattern = BoardPattern::Grid { marker_m: first, gap_m: second };
                Self::new(pattern, columns, rows, dictionary, first_id.min(1 << 20))
            }
            _ => Err(wrong(format!("'{kind}' is no kind of board"))),
        }
    }

    /// A board from a `.json` or `.yml` file with the names of OpenCV's parameters.
    ///
    /// # Errors
    /// The file is missing or malformed, or an unknown key is in it.
    pub fn read(path: &Path) -> Result<Self> {
        let value = serde_json::Value::Object(settings::read(path)?);
        let record: Record = serde_json::from_value(value)
            .map_err(|e| InputError::new(path, e.to_string()).help("docs/formats.md has the keys of a board's file"))?;
        let dictionary = Dictionary::find(&record.dictionary, path.parent().unwrap_or(Path::new("")))?;
        let missing = |key: &str| InputError::new(path, format!("no '{key}', which this kind of board needs"));
        let pattern = match record.kind {
            Kind::Charuco => BoardPattern::Charuco {
                square_m: record.square_length_m.ok_or_else(|| missing("square_length_m"))?,
                marker_m: record.marker_length_m,
                legacy: record.legacy_pattern,
            },
            Kind::Grid => BoardPattern::Grid {
                marker_m: record.marker_length_m,
                gap_m: record.marker_separation_m.ok_or_else(|| missing("marker_separation_m"))?,
            },
        };
        let [columns, rows] = record.size;
        let board = match record.ids {
            Some(ids) => Self::with_ids(pattern, columns, rows, dictionary, &ids),
            None => Self::new(pattern, columns, rows, dictionary, 0),
        };
        named(&path.display().to_string(), board)
    }

    /// How the markers are arranged.
    pub fn pattern(&self) -> BoardPattern {
        self.pattern
    }

    /// Squares or markers along x.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Squares or markers along y.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Where the markers are from.
    pub fn dictionary(&self) -> &Dictionary {
        &self.dictionary
    }

    /// The markers, row by row.
    pub fn markers(&self) -> &[Marker] {
        &self.markers
    }

    /// Width and height of the print, metres.
    pub fn size_m(&self) -> [f64; 2] {
        let (columns, rows) = (self.columns as f64, self.rows as f64);
        match self.pattern {
            BoardPattern::Charuco { square_m, .. } => [columns * square_m, rows * square_m],
            BoardPattern::Grid { marker_m, gap_m } => {
                [columns, rows].map(|along| along * marker_m + (along - 1.0) * gap_m)
            }
        }
    }

    /// The points that a camera measures, metres, board frame (z = 0): the inner corners of a chessboard row by row,
    /// whose places in the list are OpenCV's corner ids; or the corners of each marker of a grid, four a marker,
    /// clockwise from the top left.
    pub fn corners(&self) -> Vec<Point2<f64>> {
        match self.pattern {
            BoardPattern::Charuco { square_m, .. } => (1..self.rows)
                .flat_map(|y| (1..self.columns).map(move |x| Point2::new(x as f64 * square_m, y as f64 * square_m)))
                .collect(),
            BoardPattern::Grid { .. } => self.markers.iter().flat_map(Marker::corners_m).collect(),
        }
    }

    /// Whether the square in this column and row of a chessboard is black; a grid has none.
    pub fn is_black_square(&self, column: usize, row: usize) -> bool {
        match self.pattern {
            BoardPattern::Charuco { legacy, .. } => (column + row + self.legacy_shift(legacy)).is_multiple_of(2),
            BoardPattern::Grid { .. } => false,
        }
    }

    fn legacy_shift(&self, legacy: bool) -> usize {
        usize::from(legacy && self.rows.is_multiple_of(2))
    }
}

/// The top left corners of a board's markers, row by row.
fn place(pattern: &BoardPattern, columns: usize, rows: usize) -> impl Iterator<Item = Point2<f64>> + use<> {
    let pattern = *pattern;
    (0..rows).flat_map(move |y| (0..columns).map(move |x| (x, y))).filter_map(move |(x, y)| match pattern {
        BoardPattern::Charuco { square_m, marker_m, legacy } => {
            let shift = usize::from(legacy && rows.is_multiple_of(2));
            let inset = 0.5 * (square_m - marker_m);
            let corner = Point2::new(x as f64 * square_m + inset, y as f64 * square_m + inset);
            (!(x + y + shift).is_multiple_of(2)).then_some(corner)
        }
        BoardPattern::Grid { marker_m, gap_m } => {
            let pitch = marker_m + gap_m;
            Some(Point2::new(x as f64 * pitch, y as f64 * pitch))
        }
    })
}

/// An error about a board with the board's text or file in the place of its name.
fn named(name: &str, board: Result<BoardSpec>) -> Result<BoardSpec> {
    board.map_err(|error| match error {
        Error::Input(mut input) if input.path == Path::new("board") => {
            input.path = name.into();
            input.into()
        }
        other => other,
    })
}

impl FromStr for BoardSpec {
    type Err = Error;
    fn from_str(text: &str) -> Result<Self> {
        Self::parse(text)
    }
}

/// The text that [`BoardSpec::parse`] reads; of a board with ids of its own only the first is told.
impl fmt::Display for BoardSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (columns, rows, dictionary) = (self.columns, self.rows, self.dictionary.name());
        match self.pattern {
            BoardPattern::Charuco { square_m, marker_m, legacy } => {
                let legacy = if legacy { ":legacy" } else { "" };
                write!(f, "charuco:{columns}x{rows}:{square_m}:{marker_m}:{dictionary}{legacy}")
            }
            BoardPattern::Grid { marker_m, gap_m } => {
                write!(f, "grid:{columns}x{rows}:{marker_m}:{gap_m}:{dictionary}")?;
                match self.markers[0].id {
                    0 => Ok(()),
                    first => write!(f, ":{first}"),
                }
            }
        }
    }
}

/// A board's file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Record {
    #[serde(rename = "board")]
    kind: Kind,
    size: [usize; 2],
    #[serde(alias = "squareLength")]
    square_length_m: Option<f64>,
    #[serde(alias = "markerLength")]
    marker_length_m: f64,
    #[serde(alias = "markerSeparation")]
    marker_separation_m: Option<f64>,
    dictionary: String,
    #[serde(default, alias = "legacyPattern", deserialize_with = "flag")]
    legacy_pattern: bool,
    ids: Option<Vec<usize>>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Charuco,
    Grid,
}

/// OpenCV writes truth values as 0 and 1.
fn flag<'de, D: serde::Deserializer<'de>>(value: D) -> Result<bool, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Flag {
        Bool(bool),
        Number(u8),
    }
    Ok(match Flag::deserialize(value)? {
        Flag::Bool(flag) => flag,
        Flag::Number(number) => number != 0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_and_its_board_are_the_same() {
        for text in [
            "charuco:5x7:0.04:0.02:DICT_6X6_250",
            "charuco:6x8:0.03:0.0225:DICT_4X4_50:legacy",
            "grid:3x4:0.05:0.01:DICT_APRILTAG_36h11",
            "grid:1x2:0.05:0.01:DICT_ARUCO_ORIGINAL:17",
        ] {
            assert_eq!(BoardSpec::parse(text).expect(text).to_string(), text);
        }
        let short: BoardSpec = " charuco:5X7:40e-3:.02:6x6_250 ".parse().expect("a board");
        assert_eq!(short.to_string(), "charuco:5x7:0.04:0.02:DICT_6X6_250");
    }

    #[test]
    fn a_board_of_five_by_seven_in_numbers() {
        let board = BoardSpec::parse("charuco:5x7:0.04:0.02:DICT_6X6_250").expect("a board");
        assert_eq!(board.markers().len(), 17);
        let first = board.markers()[0];
        assert!((first.corners_m()[0] - Point2::new(0.05, 0.01)).norm() < 1e-12);
        assert!((first.corners_m()[2] - Point2::new(0.07, 0.03)).norm() < 1e-12);
        let corners = board.corners();
        assert!((corners[5] - Point2::new(0.08, 0.08)).norm() < 1e-12);
        assert!(board.is_black_square(0, 0));
    }

    #[test]
    fn the_legacy_pattern_starts_white_on_an_even_number_of_rows_only() {
        let board = |rows, legacy: &str| {
            BoardSpec::parse(&format!("charuco:5x{rows}:0.04:0.02:6X6_250{legacy}")).expect("a board")
        };
        assert_eq!(board(7, ":legacy").markers(), board(7, "").markers());
        assert!(!board(8, ":legacy").is_black_square(0, 0) && board(8, "").is_black_square(0, 0));
        assert!((board(8, ":legacy").markers()[0].top_left_m - Point2::new(0.01, 0.01)).norm() < 1e-12);
    }

    #[test]
    fn a_grid_in_numbers() {
        let board = BoardSpec::parse("grid:3x2:0.05:0.01:DICT_4X4_50:7").expect("a board");
        assert_eq!(board.markers().iter().map(|m| m.id).collect::<Vec<_>>(), [7, 8, 9, 10, 11, 12]);
        assert_eq!(board.corners().len(), 24);
        assert!((board.corners()[4 * 4 + 2] - Point2::new(0.11, 0.11)).norm() < 1e-12);
        assert!((board.size_m()[0] - 0.17).abs() < 1e-12 && (board.size_m()[1] - 0.11).abs() < 1e-12);
    }

    #[test]
    fn mistakes_are_named() {
        for (text, part) in [
            ("", "1 fields"),
            ("charuco:5x7:0.04:0.02", "4 fields"),
            ("checker:5x7:0.04:0.02:4X4_50", "'checker' is no kind of board"),
            ("charuco:5:0.04:0.02:4X4_50", "'5' is not COLUMNSxROWS"),
            ("charuco:5x-7:0.04:0.02:4X4_50", "'-7' is not a whole number"),
            ("charuco:5x7:40:20:4X4_50", "a square of 40 m"),
            ("charuco:5x7:0.02:0.04:4X4_50", "a marker of 0.04 m in a square of 0.02 m"),
            ("charuco:5x7:nan:0.04:4X4_50", "a square of NaN m"),
            ("charuco:15x17:0.04:0.02:4X4_50", "has only 50"),
            ("charuco:1x7:0.04:0.02:4X4_50", "1x7"),
            ("charuco:999999999x7:0.04:0.02:4X4_50", "999999999x7"),
            ("charuco:5x7:0.04:0.02:4X4_51", "no dictionary"),
            ("charuco:5x7:0.04:0.02:4X4_50:old", "'old' after the dictionary"),
            ("grid:5x7:0.04:0.02:4X4_50:99999999999", "only 50"),
            ("nowhere.yml", "no such file"),
        ] {
            let error = BoardSpec::parse(text).expect_err(text).to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn a_file_has_the_names_of_opencv() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("board.yml");
        let write = |text: &str| std::fs::write(&path, text).expect("written");
        write(
            "%YAML:1.0\n---\nboard: charuco\nsize: [ 5, 8 ]\nsquareLength: 0.04\nmarkerLength: 0.02\n\
             dictionary: DICT_6X6_250\nlegacyPattern: 1\n",
        );
        let text = "charuco:5x8:0.04:0.02:DICT_6X6_250:legacy";
        assert_eq!(BoardSpec::parse(&path.display().to_string()).expect("a board").to_string(), text);
        write("board: charuco\nsize: [5, 8]\nsquareLength: 0.04\nmarkerLength: 0.02\ncolour: red\n");
        assert!(BoardSpec::read(&path).expect_err("an unknown key").to_string().contains("colour"));
        let path = folder.path().join("board.json");
        let json = r#"{"board": "grid", "size": [2, 1], "marker_length_m": 0.05, "marker_separation_m": 0.01,
                       "dictionary": "own.yml", "ids": [1, 0]}"#;
        std::fs::write(&path, json).expect("written");
        let own = "nmarkers: 2\nmarkersize: 3\nmarker_0: \"100110001\"\nmarker_1: \"011010100\"\n";
        std::fs::write(folder.path().join("own.yml"), own).expect("written");
        let board = BoardSpec::read(&path).expect("a board");
        assert_eq!(board.markers().iter().map(|m| m.id).collect::<Vec<_>>(), [1, 0]);
        std::fs::write(&path, json.replace("[1, 0]", "[1, 1]")).expect("written");
        assert!(BoardSpec::read(&path).expect_err("twice").to_string().contains("marker 1 is on the board twice"));
    }
}
