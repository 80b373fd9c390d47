//! A board in a photograph.

use mb_image::Image;
use nalgebra::Point2;
use serde::Serialize;

use crate::decode::{Matcher, Reading, any_way_round, read_modules};
use crate::homography::Homography;
use crate::lattice::{Lattice, grow};
use crate::quads::{Quad, find_quads, refined};
use crate::{BoardPattern, BoardSpec, Dictionary};

/// A marker of the board in a photograph.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SeenMarker {
    /// Its id in the dictionary.
    pub id: usize,
    /// Its corners clockwise from its top left, pixels.
    pub corners_px: [Point2<f64>; 4],
}

/// A point of [`BoardSpec::corners`] in a photograph.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SeenCorner {
    /// Place in [`BoardSpec::corners`].
    pub id: usize,
    /// Where it is, pixel centres at integers.
    pub pixel: Point2<f64>,
}

/// What was found of a board in one photograph.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Detection {
    /// Markers, by ascending id.
    pub markers: Vec<SeenMarker>,
    /// Points to measure, by ascending id.
    pub corners: Vec<SeenCorner>,
    /// What deserves a look: a second board, markers in the wrong places.
    pub warnings: Vec<String>,
}

/// Looks for one board in any number of photographs.
///
/// Dark quadrilaterals are read as markers, and those that lie to each other as on the board vote for where it is. From
/// them the inner corners of a chessboard are followed outwards over the board, also where no marker can be read; each is
/// the crossing of two edges fitted to the photograph. What is found last must explain the markers' modules.
pub struct BoardDetector<'a> {
    board: &'a BoardSpec,
    matcher: Matcher,
}

/// Share of all modules in view that must be as the board has them. A board that is misplaced by a square agrees in half.
const FEWEST_RIGHT_MODULES: f64 = 0.8;

impl<'a> BoardDetector<'a> {
    /// For this board.
    pub fn new(board: &'a BoardSpec) -> Self {
        Self { board, matcher: Matcher::new(board.dictionary(), board.markers().iter().map(|m| m.id)) }
    }

    /// Finds the board in a photograph (brightness, see [`crate::luma`]). What is hidden, outside or too blurred is left
    /// out; without a board the lists are empty.
    pub fn detect(&self, image: &Image<u8>) -> Detection {
        let quads = find_quads(image);
        let readings: Vec<Reading> = quads
            .iter()
            .filter_map(|quad| self.matcher.find(quad, read_modules(image, quad, self.matcher.side())?))
            .collect();
        let mut warnings = Vec::new();
        let placed = self.consistent(&readings, &mut warnings);
        let mut found = match self.board.pattern() {
            BoardPattern::Charuco { .. } => self.chessboard(image, &placed, &mut warnings),
            BoardPattern::Grid { .. } => self.grid(&placed),
        };
        found.warnings = warnings;
        found
    }

    /// The largest set of readings that lie to each other as on the board, each marker once.
    fn consistent(&self, readings: &[Reading], warnings: &mut Vec<String>) -> Vec<Reading> {
        let maps: Vec<Option<Homography>> = readings.iter().map(|r| self.image_from_board(r)).collect();
        let agree = |i: usize, j: usize| {
            let (a, b) = (&readings[i], &readings[j]);
            a.index != b.index
                && self.is_near(a, b)
                && self.predicts(maps[i].as_ref(), b)
                && self.predicts(maps[j].as_ref(), a)
        };
        let mut group: Vec<usize> = (0..readings.len()).collect();
        for i in 0..readings.len() {
            for j in 0..i {
                if group[i] != group[j] && agree(i, j) {
                    let (from, to) = (group[i], group[j]);
                    group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
                }
            }
        }
        let members = |g: usize| (0..readings.len()).filter(|&i| group[i] == g).collect::<Vec<_>>();
        let mut groups: Vec<Vec<usize>> = (0..readings.len()).map(members).filter(|m| !m.is_empty()).collect();
        groups.sort_by_key(|m| std::cmp::Reverse(m.len()));
        let Some(main) = groups.first() else { return Vec::new() };
        // One marker alone may be a speck of clutter, unless every module is right.
        let is_firm = main.len() > 1 || readings[main[0]].wrong_modules == 0;
        if !is_firm {
            return Vec::new();
        }
        let mut placed: Vec<Reading> = main.iter().map(|&i| readings[i]).collect();
        // Parts of the same board that something hides the way to.
        let pairs: Vec<_> = placed.iter().flat_map(|r| self.pairs(r)).collect();
        let whole = Homography::fit(&pairs);
        let mut second: Vec<usize> = Vec::new();
        for group in &groups[1..] {
            let fits = main.len() > 2 && group.iter().all(|&i| self.predicts(whole.as_ref(), &readings[i]));
            if fits {
                placed.extend(group.iter().map(|&i| readings[i]));
            } else if group.len() > 1 {
                second.extend(group);
            }
        }
        if second.len() > 1 {
            warnings.push(format!(
                "{} more markers of this board lie elsewhere, as on a second print of it; the {} that agree are used",
                second.len(),
                placed.len()
            ));
        }
        placed.sort_by_key(|r| (r.index, r.wrong_modules));
        placed.dedup_by_key(|r| r.index);
        placed
    }

    fn pairs(&self, reading: &Reading) -> [(Point2<f64>, Point2<f64>); 4] {
        let on_board = self.board.markers()[reading.index].corners_m();
        std::array::from_fn(|i| (on_board[i], reading.corners[i]))
    }

    fn image_from_board(&self, reading: &Reading) -> Option<Homography> {
        Homography::fit(&self.pairs(reading))
    }

    /// Whether two markers are close enough on the board for one to tell where the other is.
    fn is_near(&self, a: &Reading, b: &Reading) -> bool {
        let [a, b] = [a, b].map(|r| self.board.markers()[r.index]);
        let pitch = match self.board.pattern() {
            BoardPattern::Charuco { square_m, .. } => square_m,
            BoardPattern::Grid { marker_m, gap_m } => marker_m + gap_m,
        };
        (a.top_left_m - b.top_left_m).norm() < 2.3 * pitch
    }

    /// Whether a map puts a marker where it was read, as far as a map from a neighbour can tell.
    fn predicts(&self, map: Option<&Homography>, reading: &Reading) -> bool {
        let side =
            (reading.corners[2] - reading.corners[0]).norm().min((reading.corners[3] - reading.corners[1]).norm());
        map.is_some_and(|map| self.pairs(reading).iter().all(|(m, px)| (map.apply(m) - px).norm() < 0.35 * side))
    }

    fn grid(&self, placed: &[Reading]) -> Detection {
        let id_of = |r: &Reading| self.board.markers()[r.index].id;
        let markers = placed.iter().map(|r| SeenMarker { id: id_of(r), corners_px: r.corners });
        let corners =
            placed.iter().flat_map(|r| (0..4).map(|i| SeenCorner { id: 4 * r.index + i, pixel: r.corners[i] }));
        let mut found = Detection { markers: markers.collect(), corners: corners.collect(), warnings: Vec::new() };
        found.markers.sort_by_key(|m| m.id);
        found
    }

    fn chessboard(&self, image: &Image<u8>, placed: &[Reading], warnings: &mut Vec<String>) -> Detection {
        let seeds: Vec<_> = placed.iter().flat_map(|r| self.pairs(r)).collect();
        let lattice = grow(image, self.board, &seeds);
        let mut markers: Vec<SeenMarker> = Vec::new();
        let (mut right, mut all) = (0u32, 0u32);
        let side = self.matcher.side();
        for (index, marker) in self.board.markers().iter().enumerate() {
            let placed = placed.iter().find(|r| r.index == index).map(|r| Quad { corners: r.corners });
            let Some(quad) = placed.or_else(|| predicted_quad(image, &lattice, &marker.corners_m())) else { continue };
            let Some(code) = read_modules(image, &quad, side) else { continue };
            let modules = (side * side) as u32;
            let wrong = (code ^ self.board.dictionary().code(marker.id)).count_ones();
            (right, all) = (right + modules - wrong, all + modules);
            // Here the id is known, and chance would leave half of the modules wrong.
            if wrong * 6 <= modules {
                markers.push(SeenMarker { id: marker.id, corners_px: quad.corners });
            }
        }
        let agrees = f64::from(right) >= FEWEST_RIGHT_MODULES * f64::from(all) && !markers.is_empty();
        if !agrees || lattice.count() < 4 {
            if !placed.is_empty() {
                warnings.push(format!(
                    "{} markers of the board's dictionary were read, but not where the board has them",
                    placed.len()
                ));
            }
            return Detection::default();
        }
        markers.sort_by_key(|m| m.id);
        let corners = lattice.corners().map(|(id, pixel)| SeenCorner { id, pixel }).collect();
        Detection { markers, corners, warnings: Vec::new() }
    }
}

/// Where the corners around it say that a marker must be, moved onto its edges.
fn predicted_quad(image: &Image<u8>, lattice: &Lattice, corners_m: &[Point2<f64>; 4]) -> Option<Quad> {
    let middle = nalgebra::center(&corners_m[0], &corners_m[2]);
    let map = lattice.around(&middle, 1.8)?;
    let quad = Quad { corners: corners_m.map(|c| map.apply(&c)) };
    refined(image, &quad).or(Some(quad)).filter(|q| q.shortest_side() >= 4.0)
}

/// How well a dictionary explains the markers in a photograph.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DictionaryFit {
    /// The dictionary's name.
    pub dictionary: String,
    /// Different markers read without a wrong module.
    pub markers: usize,
    /// Their ids, ascending.
    pub ids: Vec<usize>,
}

/// Which predefined dictionaries the markers in some photographs are from, the best first; for a board that was not
/// found. Of dictionaries that contain each other the smallest that has every id is named.
pub fn fitting_dictionaries(images: &[Image<u8>]) -> Vec<DictionaryFit> {
    let known: Vec<Dictionary> = Dictionary::predefined_names().filter_map(Dictionary::predefined).collect();
    let mut read: Vec<Vec<u64>> = vec![Vec::new(); 9];
    let quads: Vec<(usize, Quad)> =
        images.iter().enumerate().flat_map(|(i, image)| find_quads(image).into_iter().map(move |q| (i, q))).collect();
    for (i, quad) in &quads {
        for side in 3..9 {
            read[side].extend(read_modules(&images[*i], quad, side));
        }
    }
    let mut fits: Vec<DictionaryFit> = known
        .iter()
        .map(|dictionary| {
            let codes = any_way_round(dictionary);
            let mut ids: Vec<usize> =
                read[dictionary.side()].iter().filter_map(|code| codes.get(code).copied()).collect();
            ids.sort_unstable();
            ids.dedup();
            DictionaryFit { dictionary: dictionary.name().to_owned(), markers: ids.len(), ids }
        })
        .filter(|fit| fit.markers > 0)
        .collect();
    let size = |name: &str| known.iter().find(|d| d.name() == name).map_or(0, Dictionary::len);
    fits.sort_by_key(|fit| (std::cmp::Reverse(fit.markers), size(&fit.dictionary)));
    fits
}
