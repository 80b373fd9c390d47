//! Scale-invariant features of photographs: Lowe's detector and descriptor.

use std::ops::{Range, RangeInclusive};

use mb_image::RgbImage;
use multiversion::multiversion;
use nalgebra::{Matrix3, Point2, Vector3};

use crate::scale_space::{Octave, Plane, base_plane, next_octave};

/// How [`detect_features`] works. The defaults are Lowe's.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureOptions {
    /// Whether to start from the photograph at twice its size, which finds features as small as two pixels.
    pub upsample: bool,
    /// Least difference of Gaussians at a feature, as a share of full brightness.
    pub contrast: f32,
    /// Largest ratio of the principal curvatures; beyond it a feature is an edge.
    pub edge_ratio: f32,
    /// Features kept, the most contrasted ones; 0 keeps all.
    pub most: usize,
}

impl Default for FeatureOptions {
    fn default() -> Self {
        Self { upsample: true, contrast: 0.04 / 3.0, edge_ratio: 10.0, most: 0 }
    }
}

/// One feature.
#[derive(Debug, Clone, PartialEq)]
pub struct Feature {
    /// Where: pixel (x, y), pixel centres at integers.
    pub pixel: Point2<f64>,
    /// Standard deviation of the Gaussian that the feature is brightest under, pixels.
    pub scale_px: f64,
    /// Direction of the strongest gradient, radians from x towards y, in [0, 2 pi).
    pub angle_rad: f64,
    /// Difference of Gaussians, as a share of full brightness.
    pub contrast: f64,
    /// 4 x 4 places of 8 directions, row by row, square-rooted (Arandjelovic and Zisserman 2012) so that Euclidean
    /// distance compares histograms; length about 255.
    pub descriptor: [u8; 128],
}

/// Finds features (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004), strongest first.
pub fn detect_features(photograph: &RgbImage, options: &FeatureOptions) -> Vec<Feature> {
    let grey = Plane::from_rgb(photograph);
    if grey.width < 8 || grey.height < 8 {
        return Vec::new();
    }
    let mut octave = Some(base_plane(&grey, options.upsample));
    // Pixels of the photograph per pixel of the octave.
    let mut pixel_size = if options.upsample { 0.5 } else { 1.0 };
    let mut features = Vec::new();
    let mut gradients = Gradients::default();
    while let Some(base) = octave {
        let scales = Octave::new(base);
        let mut found = extrema(&scales, options);
        if options.most > 0 {
            // Those that enough others of their own octave outdo are not kept anyway, and need no description.
            found.sort_by(|a, b| b.contrast.total_cmp(&a.contrast));
            found.truncate(options.most);
        }
        for extremum in found {
            for angle in orientations(&scales, &extremum, &mut gradients) {
                features.push(describe(&scales, &extremum, angle, pixel_size, &mut gradients));
            }
        }
        octave = next_octave(&scales);
        pixel_size *= 2.0;
    }
    features.sort_by(|a, b| {
        let place = |f: &Feature| (f.pixel.y, f.pixel.x, f.angle_rad);
        let (a_at, b_at) = (place(a), place(b));
        b.contrast
            .total_cmp(&a.contrast)
            .then(a_at.0.total_cmp(&b_at.0))
            .then(a_at.1.total_cmp(&b_at.1))
            .then(a_at.2.total_cmp(&b_at.2))
    });
    if options.most > 0 {
        features.truncate(options.most);
    }
    features
}

/// A place in scale space, in the octave's pixels.
struct Extremum {
    x: f32,
    y: f32,
    /// Index of the Gaussian plane, with its fraction.
    scale: f32,
    contrast: f32,
}

/// Pixels at the border where no neighbourhood is complete.
const BORDER: usize = 5;

fn extrema(octave: &Octave, options: &FeatureOptions) -> Vec<Extremum> {
    let mut found = Vec::new();
    let (width, height) = (octave.planes[0].width, octave.planes[0].height);
    if width <= 2 * BORDER || height <= 2 * BORDER {
        return found;
    }
    let threshold = 0.5 * options.contrast;
    // Of each difference of planes the last three rows, row y at y modulo 3.
    let mut layers: [[Vec<f32>; 3]; Octave::SCALES + 2] =
        std::array::from_fn(|_| std::array::from_fn(|_| vec![0.0; width]));
    let mut marks = vec![false; width];
    for below in BORDER - 1..=height - BORDER {
        for (s, rows) in layers.iter_mut().enumerate() {
            difference(&mut rows[below % 3], octave.planes[s + 1].row(below), octave.planes[s].row(below));
        }
        let y = below - 1;
        if y < BORDER {
            continue;
        }
        let rows = |layer: usize| [y - 1, y, y + 1].map(|y| layers[layer][y % 3].as_slice());
        for s in 1..=Octave::SCALES {
            let (here, others) = (rows(s), [rows(s - 1), rows(s + 1)]);
            mark_plane_extrema(&mut marks, here, threshold);
            for x in marked(&marks[BORDER..width - BORDER]).map(|x| BORDER + x) {
                let (value, sign) = (here[1][x], here[1][x].signum());
                let mut near = others.iter().flatten().flat_map(|row| &row[x - 1..=x + 1]);
                if near.all(|v| sign * v <= sign * value)
                    && let Some(extremum) = locate(octave, s, x, y, options)
                {
                    found.push(extremum);
                }
            }
        }
    }
    found
}

#[multiversion(targets("x86_64+avx2"))]
fn difference(out: &mut [f32], upper: &[f32], lower: &[f32]) {
    for (out, (upper, lower)) in out.iter_mut().zip(upper.iter().zip(lower)) {
        *out = upper - lower;
    }
}

/// Marks where the middle one of three rows is beyond the threshold and no neighbour in them outdoes it. The rows' ends
/// are left alone.
#[multiversion(targets("x86_64+avx2"))]
fn mark_plane_extrema(marks: &mut [bool], rows: [&[f32]; 3], threshold: f32) {
    let n = marks.len();
    let [above, here, below] = rows.map(|row| &row[..n]);
    // Without the care for what is no number that `f32::max` takes.
    let higher = |a: f32, b: f32| if a > b { a } else { b };
    let lower = |a: f32, b: f32| if a < b { a } else { b };
    for x in 1..n - 1 {
        let value = here[x];
        let mut highest = higher(here[x - 1], here[x + 1]);
        let mut lowest = lower(here[x - 1], here[x + 1]);
        for row in [above, below] {
            highest = higher(higher(highest, row[x - 1]), higher(row[x], row[x + 1]));
            lowest = lower(lower(lowest, row[x - 1]), lower(row[x], row[x + 1]));
        }
        marks[x] = ((value > threshold) & (value >= highest)) | ((value < -threshold) & (value <= lowest));
    }
}

/// Where the marks are; few are.
fn marked(marks: &[bool]) -> impl Iterator<Item = usize> {
    const BLOCK: usize = 32;
    let blocks = marks.chunks(BLOCK).enumerate().filter(|(_, block)| block.contains(&true));
    blocks.flat_map(|(i, block)| (0..block.len()).filter(|&j| block[j]).map(move |j| i * BLOCK + j))
}

/// The extremum of the quadratic through the neighbourhood (Brown and Lowe 2002), moved to a neighbour while it lies
/// beyond half a pixel.
fn locate(octave: &Octave, s: usize, x: usize, y: usize, options: &FeatureOptions) -> Option<Extremum> {
    let (width, height) = (octave.planes[0].width, octave.planes[0].height);
    let (mut s, mut x, mut y) = (s, x, y);
    for _ in 0..5 {
        let d = |ds: isize, dx: isize, dy: isize| {
            octave.dog(s.wrapping_add_signed(ds), x.wrapping_add_signed(dx), y.wrapping_add_signed(dy))
        };
        let gradient = Vector3::new(
            0.5 * (d(0, 1, 0) - d(0, -1, 0)),
            0.5 * (d(0, 0, 1) - d(0, 0, -1)),
            0.5 * (d(1, 0, 0) - d(-1, 0, 0)),
        );
        let here = d(0, 0, 0);
        let xx = d(0, 1, 0) + d(0, -1, 0) - 2.0 * here;
        let yy = d(0, 0, 1) + d(0, 0, -1) - 2.0 * here;
        let ss = d(1, 0, 0) + d(-1, 0, 0) - 2.0 * here;
        let xy = 0.25 * (d(0, 1, 1) - d(0, -1, 1) - d(0, 1, -1) + d(0, -1, -1));
        let xs = 0.25 * (d(1, 1, 0) - d(1, -1, 0) - d(-1, 1, 0) + d(-1, -1, 0));
        let ys = 0.25 * (d(1, 0, 1) - d(1, 0, -1) - d(-1, 0, 1) + d(-1, 0, -1));
        let hessian = Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss);
        let offset = -(hessian.try_inverse()? * gradient);
        if !offset.iter().all(|v| v.abs() < 1e3) {
            return None;
        }
        if offset.amax() < 0.5 {
            let contrast = here + 0.5 * gradient.dot(&offset);
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let r = options.edge_ratio;
            if contrast.abs() < options.contrast
                || determinant <= 0.0
                || trace * trace * r >= (r + 1.0).powi(2) * determinant
            {
                return None;
            }
            return Some(Extremum {
                x: x as f32 + offset.x,
                y: y as f32 + offset.y,
                scale: s as f32 + offset.z,
                contrast: contrast.abs(),
            });
        }
        let moved = |v: usize, by: f32| v.saturating_add_signed(by.round() as isize);
        (x, y, s) = (moved(x, offset.x), moved(y, offset.y), moved(s, offset.z));
        let inside = |v: usize, count: usize| v >= BORDER && v < count - BORDER;
        if !inside(x, width) || !inside(y, height) || !(1..=Octave::SCALES).contains(&s) {
            return None;
        }
    }
    None
}

/// The gradients of a patch: as differences of brightness in x and y, then as lengths and directions.
#[derive(Default)]
struct Gradients {
    dx: Vec<f32>,
    dy: Vec<f32>,
    /// What each counts for; [`Gradients::measure`] multiplies it by the length.
    weights: Vec<f32>,
    /// Radians from x towards y, in [0, 2 pi].
    angles: Vec<f32>,
}

impl Gradients {
    fn clear(&mut self) {
        for values in [&mut self.dx, &mut self.dy, &mut self.weights, &mut self.angles] {
            values.clear();
        }
    }

    /// Adds those of columns `from..to` of a row, which must have neighbours on all sides.
    fn add_row(&mut self, plane: &Plane, y: usize, columns: Range<usize>, weights: &[f32], by: f32) {
        let Range { start, end } = columns;
        let (above, here, below) = (&plane.row(y - 1)[start..end], plane.row(y), &plane.row(y + 1)[start..end]);
        self.dx
            .extend(here[start + 1..end + 1].iter().zip(&here[start - 1..end - 1]).map(|(right, left)| right - left));
        self.dy.extend(below.iter().zip(above).map(|(below, above)| below - above));
        self.weights.extend(weights.iter().map(|weight| weight * by));
    }

    fn measure(&mut self) {
        self.angles.resize(self.dx.len(), 0.0);
        lengths_and_angles(&mut self.weights, &mut self.angles, &self.dx, &self.dy);
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn lengths_and_angles(weights: &mut [f32], angles: &mut [f32], dx: &[f32], dy: &[f32]) {
    let n = weights.len();
    let (angles, dx, dy) = (&mut angles[..n], &dx[..n], &dy[..n]);
    for i in 0..n {
        weights[i] *= (dx[i] * dx[i] + dy[i] * dy[i]).sqrt();
        angles[i] = direction(dx[i], dy[i]);
    }
}

/// What part of `-radius..=radius` about `at` has neighbours on both sides among `count` values.
fn inside(at: isize, radius: isize, count: usize) -> RangeInclusive<isize> {
    (-radius).max(1 - at)..=radius.min(count as isize - 2 - at)
}

/// Peaks of the histogram of gradient directions round the extremum that reach 80 % of the highest.
fn orientations(octave: &Octave, e: &Extremum, gradients: &mut Gradients) -> Vec<f32> {
    const BINS: usize = 36;
    let sigma = 1.5 * octave.sigma(e.scale);
    let radius = (3.0 * sigma).round() as isize;
    let plane = octave.nearest_plane(e.scale);
    let (column, row) = (e.x.round() as isize, e.y.round() as isize);
    let window = window(radius, 0.0, sigma);
    gradients.clear();
    let across = inside(column, radius, plane.width);
    let weights = &window[(across.start() + radius) as usize..=(across.end() + radius) as usize];
    let columns = (column + across.start()) as usize..(column + across.end() + 1) as usize;
    for dy in inside(row, radius, plane.height) {
        gradients.add_row(plane, (row + dy) as usize, columns.clone(), weights, window[(dy + radius) as usize]);
    }
    gradients.measure();
    let mut histogram = [0.0f32; BINS];
    for (weight, angle) in gradients.weights.iter().zip(&gradients.angles) {
        let bin = (angle * (BINS as f32 / std::f32::consts::TAU) + 0.5) as i32;
        histogram[bin as usize % BINS] += weight;
    }
    let at = |i: isize| histogram[i.rem_euclid(BINS as isize) as usize];
    let smooth: [f32; BINS] = std::array::from_fn(|i| {
        let i = i as isize;
        (at(i - 2) + at(i + 2)) / 16.0 + (at(i - 1) + at(i + 1)) * 4.0 / 16.0 + at(i) * 6.0 / 16.0
    });
    let highest = smooth.iter().copied().fold(0.0, f32::max);
    let mut angles = Vec::new();
    for i in 0..BINS {
        let (before, here, after) = (smooth[(i + BINS - 1) % BINS], smooth[i], smooth[(i + 1) % BINS]);
        if here > before && here > after && here >= 0.8 * highest {
            let shift = 0.5 * (before - after) / (before - 2.0 * here + after);
            let turn = (i as f32 + shift) / BINS as f32 * std::f32::consts::TAU;
            angles.push(turn.rem_euclid(std::f32::consts::TAU));
        }
    }
    angles
}

/// A Gaussian about `-offset` at the integers from `-radius` to `radius`: two of them make one of the plane.
fn window(radius: isize, offset: f32, sigma: f32) -> Vec<f32> {
    (-radius..=radius).map(|d| (-((d as f32 + offset) / sigma).powi(2) / 2.0).exp()).collect()
}

/// The direction of a gradient, radians from x towards y, in [0, 2 pi]; within 1e-5 of `atan2` (a minimax
/// polynomial of the arc tangent up to 45 degrees, and reflections).
fn direction(x: f32, y: f32) -> f32 {
    use std::f32::consts::{FRAC_PI_2, PI, TAU};
    const ODD: [f32; 6] = [0.999_977_26, -0.332_623_47, 0.193_543_46, -0.116_432_87, 0.052_653_32, -0.011_721_2];
    let (ax, ay) = (x.abs(), y.abs());
    let t = ax.min(ay) / ax.max(ay).max(f32::MIN_POSITIVE);
    let angle = t * ODD.iter().rev().fold(0.0, |sum, c| sum * t * t + c);
    let angle = if ay > ax { FRAC_PI_2 - angle } else { angle };
    let angle = if x < 0.0 { PI - angle } else { angle };
    if y < 0.0 { TAU - angle } else { angle }
}

/// Cells of a descriptor in a row, and in a column.
const CELLS: usize = 4;
/// Directions told apart in each cell.
const DIRECTIONS: usize = 8;

fn describe(octave: &Octave, e: &Extremum, angle: f32, pixel_size: f64, gradients: &mut Gradients) -> Feature {
    let plane = octave.nearest_plane(e.scale);
    let cell_px = 3.0 * octave.sigma(e.scale);
    let radius = (cell_px * std::f32::consts::SQRT_2 * (CELLS as f32 + 1.0) * 0.5).round() as isize;
    let (sin, cos) = angle.sin_cos();
    let (cos, sin) = (cos / cell_px, sin / cell_px);
    let (column, row) = (e.x.round() as isize, e.y.round() as isize);
    // A Gaussian as wide as half of all cells (turning does not change it).
    let sigma = 0.5 * CELLS as f32 * cell_px;
    let (left, above) = (column as f32 - e.x, row as f32 - e.y);
    let (window_x, window_y) = (window(radius, left, sigma), window(radius, above, sigma));
    gradients.clear();
    // Cells across and down, with one of margin on every side that takes what falls outside.
    let reach = 0.5 * (CELLS as f32 + 1.0);
    let (mut across, mut down) = (Vec::new(), Vec::new());
    for dy in inside(row, radius, plane.height) {
        let y = dy as f32 + above;
        let within = inside(column, radius, plane.width);
        let (first, last) = [(cos, sin * y), (-sin, cos * y)].into_iter().fold(
            (*within.start(), *within.end()),
            |(first, last), (slope, offset)| {
                let (middle, half) = (-offset / slope, reach / slope.abs());
                (first.max(-floor(half - middle + left)), last.min(floor(middle + half - left)))
            },
        );
        if first > last {
            continue;
        }
        let columns = (column + first) as usize..(column + last + 1) as usize;
        let weights = &window_x[(first + radius) as usize..=(last + radius) as usize];
        gradients.add_row(plane, (row + dy) as usize, columns, weights, window_y[(dy + radius) as usize]);
        let x = (first..=last).map(|dx| dx as i32 as f32 + left);
        across.extend(x.clone().map(|x| cos * x + (sin * y + reach)));
        down.extend(x.map(|x| cos * y + reach - sin * x));
    }
    gradients.measure();
    let mut cells = [[0.0f32; DIRECTIONS]; (CELLS + 2) * (CELLS + 2)];
    share_among_cells(&mut cells, &mut across, &mut down, gradients, angle);
    let mut values = [0.0f32; 128];
    for (i, value) in values.iter_mut().enumerate() {
        *value = cells[(i / 32 + 1) * (CELLS + 2) + i / 8 % CELLS + 1][i % 8];
    }
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    // No gradient counts for more than a fifth, so that changes of light do not dominate.
    values.iter_mut().for_each(|v| *v = (*v / norm).min(0.2));
    let sum = values.iter().sum::<f32>().max(f32::MIN_POSITIVE);
    let to_photograph = |v: f32| {
        // Halving keeps every second pixel, so pixel centres stay aligned; doubling puts them half a pixel apart.
        f64::from(v) * pixel_size
    };
    Feature {
        pixel: Point2::new(to_photograph(e.x), to_photograph(e.y)),
        scale_px: f64::from(octave.sigma(e.scale)) * pixel_size,
        angle_rad: f64::from(angle),
        contrast: f64::from(e.contrast),
        descriptor: values.map(|v| (255.0 * (v / sum).sqrt()).round().min(255.0) as u8),
    }
}

/// The largest integer that is not above, without the call that `f32::floor` is on processors that lack the instruction.
fn floor(value: f32) -> isize {
    let toward_zero = value as i32;
    toward_zero as isize - isize::from(toward_zero as f32 > value)
}

/// Adds each gradient to the four cells around it and the two directions beside its own, by nearness. `across` and `down`
/// are places in cells; `angle` is the direction that counts as the first.
#[multiversion(targets("x86_64+avx2"))]
fn share_among_cells(
    cells: &mut [[f32; DIRECTIONS]; (CELLS + 2) * (CELLS + 2)],
    across: &mut [f32],
    down: &mut [f32],
    gradients: &mut Gradients,
    angle: f32,
) {
    const STEP: f32 = std::f32::consts::TAU / DIRECTIONS as f32;
    let n = across.len();
    let down = &mut down[..n];
    let (weights, turns) = (&gradients.weights[..n], &mut gradients.angles[..n]);
    let mut firsts = vec![(0i32, 0i32); n];
    for i in 0..n {
        let turn = turns[i] - angle;
        let turn = if turn < 0.0 { turn + std::f32::consts::TAU } else { turn } / STEP;
        // Rounding may put a place outside by a hair.
        let last = CELLS as i32;
        let (column, row) = ((across[i] as i32).clamp(0, last), (down[i] as i32).clamp(0, last));
        let direction = (turn as i32).clamp(0, DIRECTIONS as i32 - 1);
        across[i] -= column as f32;
        down[i] -= row as f32;
        turns[i] = turn - direction as f32;
        firsts[i] = (row * (last + 2) + column, direction);
    }
    for i in 0..n {
        let (first, direction) = (firsts[i].0 as usize, firsts[i].1 as usize % DIRECTIONS);
        let block: &mut [[f32; DIRECTIONS]; CELLS + 4] =
            (&mut cells[first..first + CELLS + 4]).try_into().expect("8 cells");
        let next = (direction + 1) % DIRECTIONS;
        let (right, below) = (across[i], down[i]);
        let lower = weights[i] * below;
        let upper = weights[i] - lower;
        let (upper_right, lower_right) = (upper * right, lower * right);
        let shares = [upper - upper_right, upper_right, lower - lower_right, lower_right];
        for (cell, share) in [0, 1, CELLS + 2, CELLS + 3].into_iter().zip(shares) {
            let later = share * turns[i];
            block[cell][direction] += share - later;
            block[cell][next] += later;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_those_of_the_arc_tangent() {
        for i in 0..3600 {
            let angle = (i as f32 / 3600.0) * std::f32::consts::TAU;
            let length = 10f32.powi(i % 9 - 6);
            let (x, y) = (length * angle.cos(), length * angle.sin());
            let expected = y.atan2(x).rem_euclid(std::f32::consts::TAU);
            let off = (direction(x, y) - expected).abs();
            assert!(off.min(std::f32::consts::TAU - off) < 1e-5, "{i}: {} is not {expected}", direction(x, y));
        }
        assert_eq!(direction(0.0, 0.0), 0.0);
    }

    #[test]
    fn marks_are_what_a_look_at_every_neighbour_says() {
        let rows: [Vec<f32>; 3] =
            std::array::from_fn(|r| (0..83).map(|x| ((x * 31 + r * 17) * 7919 % 23) as f32 / 11.0 - 1.0).collect());
        let mut marks = vec![false; 83];
        mark_plane_extrema(&mut marks, rows.each_ref().map(Vec::as_slice), 0.3);
        for x in 1..82 {
            let value = rows[1][x];
            let near = || rows.iter().flat_map(|row| &row[x - 1..=x + 1]);
            let outstanding = near().all(|v| *v <= value) || near().all(|v| *v >= value);
            assert_eq!(marks[x], value.abs() > 0.3 && outstanding, "{x}");
        }
        let places: Vec<usize> = (0..83).filter(|&x| marks[x]).collect();
        assert!(places.len() > 5, "{places:?}");
        assert_eq!(marked(&marks).collect::<Vec<_>>(), places);
    }

    #[test]
    fn floors_of_both_signs() {
        for (value, expected) in [(2.0, 2), (2.9, 2), (0.0, 0), (-0.1, -1), (-2.0, -2), (-2.1, -3)] {
            assert_eq!(floor(value), expected, "{value}");
        }
    }
}
