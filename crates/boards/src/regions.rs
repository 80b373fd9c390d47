//! Connected regions of pixels that are darker than their surroundings.

use mb_image::Image;
use nalgebra::Point2;

/// A connected dark region: where it starts and ends in each of its rows.
pub(crate) struct Region {
    pub outline: Vec<Point2<f64>>,
}

/// How much darker than the mean around it a dark pixel is.
const DARKER: u32 = 5;
/// Regions narrower or lower than this are no markers, pixels.
const SMALLEST: usize = 8;

/// A run of dark pixels in one row, from `start` up to but not including `end`.
struct Run {
    y: u32,
    start: u32,
    end: u32,
    parent: u32,
}

/// Regions of pixels that are darker than the mean of the (2 `window` + 1)^2 pixels around them, joined through their
/// sides. Those that touch the image's border, or are too small for a marker, are left out.
pub(crate) fn dark_regions(image: &Image<u8>, window: usize) -> Vec<Region> {
    let mut runs = dark_runs(image, window);
    join(&mut runs);
    let roots: Vec<u32> = (0..runs.len() as u32).map(|i| root(&mut runs, i)).collect();
    let mut order: Vec<u32> = (0..runs.len() as u32).collect();
    // Runs are in row order, and a stable sort keeps them so.
    order.sort_by_key(|&i| roots[i as usize]);
    let (width, height) = (image.width() as u32, image.height() as u32);
    let mut regions = Vec::new();
    for group in order.chunk_by(|&a, &b| roots[a as usize] == roots[b as usize]) {
        let runs = || group.iter().map(|&i| &runs[i as usize]);
        let (first, last) = (runs().map(|r| r.start).min().unwrap_or(0), runs().map(|r| r.end).max().unwrap_or(0));
        let (top, bottom) = (runs().map(|r| r.y).min().unwrap_or(0), runs().map(|r| r.y).max().unwrap_or(0));
        let small = ((last - first) as usize) < SMALLEST || ((bottom + 1 - top) as usize) < SMALLEST;
        if small || first == 0 || top == 0 || last == width || bottom + 1 == height {
            continue;
        }
        let mut outline: Vec<Point2<f64>> = Vec::with_capacity(2 * (bottom + 1 - top) as usize);
        let mut row: Option<(u32, u32, u32)> = None;
        let mut close = |row: &Option<(u32, u32, u32)>| {
            if let Some((y, start, end)) = *row {
                outline.push(Point2::new(f64::from(start), f64::from(y)));
                outline.push(Point2::new(f64::from(end - 1), f64::from(y)));
            }
        };
        for run in runs() {
            match &mut row {
                Some((y, start, end)) if *y == run.y => (*start, *end) = ((*start).min(run.start), (*end).max(run.end)),
                _ => {
                    close(&row);
                    row = Some((run.y, run.start, run.end));
                }
            }
        }
        close(&row);
        regions.push(Region { outline });
    }
    regions
}

fn dark_runs(image: &Image<u8>, window: usize) -> Vec<Run> {
    let (width, height) = (image.width(), image.height());
    let mut runs = Vec::new();
    // Sums of the columns over the rows around the current one.
    let mut columns = vec![0u32; width];
    let mut prefix = vec![0u32; width + 1];
    for y in 0..height.min(window) {
        columns.iter_mut().zip(image.row(y)).for_each(|(sum, v)| *sum += u32::from(*v));
    }
    for y in 0..height {
        if y + window < height {
            columns.iter_mut().zip(image.row(y + window)).for_each(|(sum, v)| *sum += u32::from(*v));
        }
        if y > window {
            columns.iter_mut().zip(image.row(y - window - 1)).for_each(|(sum, v)| *sum -= u32::from(*v));
        }
        for x in 0..width {
            prefix[x + 1] = prefix[x].wrapping_add(columns[x]);
        }
        let rows = ((y + window + 1).min(height) - y.saturating_sub(window)) as u32;
        let row = image.row(y);
        let mut start: Option<usize> = None;
        for x in 0..width {
            let (left, right) = (x.saturating_sub(window), (x + window + 1).min(width));
            let sum = prefix[right].wrapping_sub(prefix[left]);
            let count = rows * (right - left) as u32;
            let is_dark = (u32::from(row[x]) + DARKER) * count < sum;
            match (is_dark, start) {
                (true, None) => start = Some(x),
                (false, Some(from)) => {
                    runs.push(Run { y: y as u32, start: from as u32, end: x as u32, parent: runs.len() as u32 });
                    start = None;
                }
                _ => {}
            }
        }
        if let Some(from) = start {
            runs.push(Run { y: y as u32, start: from as u32, end: width as u32, parent: runs.len() as u32 });
        }
    }
    runs
}

/// Joins runs of neighbouring rows that share a column.
fn join(runs: &mut [Run]) {
    let (mut above, mut here) = (0, 0);
    while here < runs.len() {
        // The first run above that may reach this one.
        while above < here
            && (runs[above].y + 1 < runs[here].y
                || (runs[above].y + 1 == runs[here].y && runs[above].end <= runs[here].start))
        {
            above += 1;
        }
        let mut candidate = above;
        while candidate < here && runs[candidate].y + 1 == runs[here].y && runs[candidate].start < runs[here].end {
            let (a, b) = (root(runs, candidate as u32), root(runs, here as u32));
            let (low, high) = (a.min(b), a.max(b));
            runs[high as usize].parent = low;
            candidate += 1;
        }
        here += 1;
    }
}

fn root(runs: &mut [Run], mut i: u32) -> u32 {
    while runs[i as usize].parent != i {
        let grandparent = runs[runs[i as usize].parent as usize].parent;
        runs[i as usize].parent = grandparent;
        i = grandparent;
    }
    i
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::ImageSize;

    #[test]
    fn a_ring_is_one_region_with_its_outer_outline() {
        let image = Image::from_fn(ImageSize::new(60, 50), |x, y| {
            let (dx, dy) = (x.abs_diff(30), y.abs_diff(25));
            if dx.max(dy) <= 14 && dx.max(dy) > 9 { 20 } else { 200 }
        });
        let regions = dark_regions(&image, 12);
        assert_eq!(regions.len(), 1);
        let outline = &regions[0].outline;
        assert_eq!(outline.len(), 2 * 29);
        assert!(outline.iter().all(|p| p.x == 16.0 || p.x == 44.0));
    }

    #[test]
    fn squares_that_touch_at_a_corner_are_two() {
        let image = Image::from_fn(ImageSize::new(60, 60), |x, y| {
            let dark = (10..30).contains(&x) && (10..30).contains(&y) || (30..50).contains(&x) && (30..50).contains(&y);
            if dark { 10 } else { 240 }
        });
        assert_eq!(dark_regions(&image, 36 / 2).len(), 2);
    }
}
