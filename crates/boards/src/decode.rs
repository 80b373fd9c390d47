//! Which marker a dark quadrilateral is.

use std::collections::BTreeMap;

use mb_image::Image;
use nalgebra::Point2;

use crate::Dictionary;
use crate::homography::Homography;
use crate::quads::Quad;
use crate::sample::bilinear;

/// A quadrilateral read as a marker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reading {
    /// Place in the list of ids that was looked for.
    pub index: usize,
    /// The corners clockwise from the marker's own top left.
    pub corners: [Point2<f64>; 4],
    /// Modules that differ from the dictionary.
    pub wrong_modules: u32,
}

/// Smallest difference between black and white, of 255.
const FAINTEST: f32 = 10.0;
/// Share of the border's modules that may look white (a glint, a fold).
const BORDER_SLACK: f32 = 0.15;

/// Looks markers up by what was seen of them.
pub(crate) struct Matcher {
    side: usize,
    codes: Vec<u64>,
    /// Wrong modules up to which a marker is told from every other, whichever way round.
    correctable: u32,
}

impl Matcher {
    /// For the markers `ids` of a dictionary.
    pub fn new(dictionary: &Dictionary, ids: impl Iterator<Item = usize>) -> Self {
        let codes: Vec<u64> = ids.map(|id| dictionary.code(id)).collect();
        let side = dictionary.side();
        let mut nearest = (side * side) as u32;
        for (i, &code) in codes.iter().enumerate() {
            let mut other = code;
            for quarter in 0..4 {
                if quarter > 0 {
                    nearest = nearest.min((code ^ other).count_ones());
                }
                nearest = codes[..i].iter().map(|c| (c ^ other).count_ones()).min().unwrap_or(nearest).min(nearest);
                other = turned(other, side);
            }
        }
        // Half the way to the nearest other, and of that as much as OpenCV corrects: the rest guards against clutter.
        let correctable = (0.6 * f64::from(nearest.saturating_sub(1) / 2)).round() as u32;
        Self { side, codes, correctable }
    }

    pub fn side(&self) -> usize {
        self.side
    }

    /// The marker whose modules were read as `code`, clockwise from the quadrilateral's first corner.
    pub fn find(&self, quad: &Quad, code: u64) -> Option<Reading> {
        let mut best: Option<Reading> = None;
        let mut upright = code;
        for quarter in 0..4 {
            for (index, known) in self.codes.iter().enumerate() {
                let wrong_modules = (known ^ upright).count_ones();
                if wrong_modules <= self.correctable && best.is_none_or(|b| wrong_modules < b.wrong_modules) {
                    // A quarter turn clockwise brings the last corner to the top left.
                    let corners = std::array::from_fn(|i| quad.corners[(4 - quarter + i) % 4]);
                    best = Some(Reading { index, corners, wrong_modules });
                }
            }
            upright = turned(upright, self.side);
        }
        best
    }
}

/// The ids of all markers of a dictionary by their codes in each of the four orientations.
pub(crate) fn any_way_round(dictionary: &Dictionary) -> BTreeMap<u64, usize> {
    let mut ids = BTreeMap::new();
    for id in 0..dictionary.len() {
        let mut code = dictionary.code(id);
        for _ in 0..4 {
            ids.insert(code, id);
            code = turned(code, dictionary.side());
        }
    }
    ids
}

/// The code of a marker turned clockwise by a quarter.
fn turned(code: u64, side: usize) -> u64 {
    let bit = |x: usize, y: usize| code >> (side * side - 1 - (y * side + x)) & 1;
    let mut out = 0;
    for y in 0..side {
        for x in 0..side {
            out = out << 1 | bit(y, side - 1 - x);
        }
    }
    out
}

/// The modules inside the black border of a marker of `side` x `side`, clockwise from the first corner; `None` where the
/// border is not black or nothing is white.
pub(crate) fn read_modules(image: &Image<u8>, quad: &Quad, side: usize) -> Option<u64> {
    let n = side + 2;
    let far = n as f64;
    let square = [(0.0, 0.0), (far, 0.0), (far, far), (0.0, far)].map(|(x, y)| Point2::new(x, y));
    let pairs: Vec<(Point2<f64>, Point2<f64>)> = square.into_iter().zip(quad.corners).collect();
    let image_from_square = Homography::fit(&pairs)?;
    let mut levels = vec![0.0f32; n * n];
    for (i, level) in levels.iter_mut().enumerate() {
        let middle = Point2::new((i % n) as f64 + 0.5, (i / n) as f64 + 0.5);
        let mut sum = 0.0;
        for dy in [-0.2, 0.0, 0.2] {
            for dx in [-0.2, 0.0, 0.2] {
                let p = image_from_square.apply(&Point2::new(middle.x + dx, middle.y + dy));
                sum += bilinear(image, &p)?;
            }
        }
        *level = sum / 9.0;
    }
    let is_border = |i: usize| [i % n, i / n].iter().any(|&place| place == 0 || place == n - 1);
    let mut border: Vec<f32> = (0..n * n).filter(|&i| is_border(i)).map(|i| levels[i]).collect();
    let mut inside: Vec<f32> = (0..n * n).filter(|&i| !is_border(i)).map(|i| levels[i]).collect();
    border.sort_by(f32::total_cmp);
    let black = border[border.len() / 2];
    inside.sort_by(f32::total_cmp);
    let white = inside[inside.len() - 1 - inside.len() / 10];
    if white - black < FAINTEST {
        return None;
    }
    let middle = 0.5 * (black + white);
    let bright = border.iter().filter(|level| **level > middle).count();
    if bright as f32 > BORDER_SLACK * border.len() as f32 {
        return None;
    }
    Some((0..n * n).filter(|&i| !is_border(i)).fold(0, |code, i| code << 1 | u64::from(levels[i] > middle)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::ImageSize;

    #[test]
    fn a_quarter_turn_moves_the_left_column_to_the_top() {
        // 1 0 0      0 1 1
        // 1 1 0  ->  0 1 0
        // 0 0 1      1 0 0
        assert_eq!(turned(0b100_110_001, 3), 0b011_010_100);
        let code = 0b1011_0101_0011_0010;
        assert_eq!((0..4).fold(code, |c, _| turned(c, 4)), code);
    }

    #[test]
    fn every_marker_is_read_whichever_way_round() {
        let dictionary = Dictionary::predefined("DICT_5X5_50").expect("a dictionary");
        let matcher = Matcher::new(&dictionary, 0..50);
        for id in [0, 7, 49] {
            let board: crate::BoardSpec = format!("grid:1x1:0.07:0.01:DICT_5X5_50:{id}").parse().expect("a board");
            for quarter in 0..4 {
                let image = board.image(ImageSize::new(90, 90), 10).rotated_clockwise(quarter);
                let corners = [(9.5, 9.5), (79.5, 9.5), (79.5, 79.5), (9.5, 79.5)].map(|(x, y)| Point2::new(x, y));
                let quad = Quad { corners };
                let code = read_modules(&image, &quad, 5).expect("a marker");
                let reading = matcher.find(&quad, code).expect("a known marker");
                assert_eq!((reading.index, reading.wrong_modules), (id, 0));
                // Its own top left has gone clockwise with the image.
                assert_eq!(reading.corners[0], corners[quarter]);
            }
        }
    }

    #[test]
    fn correction_follows_from_the_distance_between_markers() {
        let limit =
            |name: &str, count: usize| Matcher::new(&Dictionary::predefined(name).expect(name), 0..count).correctable;
        // OpenCV's tables say 1, 6 and 0 wrong modules at most, of which it corrects 60 %.
        assert_eq!(limit("DICT_4X4_50", 50), 1);
        assert_eq!(limit("DICT_6X6_50", 50), 4);
        assert_eq!(limit("DICT_4X4_1000", 1000), 0);
    }

    #[test]
    fn even_grey_and_a_black_square_are_no_markers() {
        let quad =
            Quad { corners: [(9.5, 9.5), (79.5, 9.5), (79.5, 79.5), (9.5, 79.5)].map(|(x, y)| Point2::new(x, y)) };
        for level in [0, 90] {
            assert_eq!(read_modules(&Image::filled(ImageSize::new(90, 90), level), &quad, 5), None);
        }
    }
}
