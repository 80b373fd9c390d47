//! The convex hull of points in a plane.

/// The corners of the convex hull, counter-clockwise (Andrew's monotone chain). Fewer than three points are returned
/// as they are; points on a line give its ends.
pub(crate) fn convex_hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup_by(|a, b| (a[0] - b[0]).abs() < 1e-6 && (a[1] - b[1]).abs() < 1e-6);
    if points.len() < 3 {
        return points;
    }
    let turn = |o: &[f64; 2], a: &[f64; 2], b: &[f64; 2]| (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]);
    let half = |points: &mut dyn Iterator<Item = &[f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = vec![];
        for p in points {
            while chain.len() > 1 && turn(&chain[chain.len() - 2], &chain[chain.len() - 1], p) <= 1e-9 {
                chain.pop();
            }
            chain.push(*p);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter());
    hull.extend(half(&mut points.iter().rev()));
    hull
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_lines_and_points() {
        let grid = (0..4).flat_map(|x| (0..4).map(move |y| [f64::from(x), f64::from(y)])).collect();
        assert_eq!(convex_hull(grid), [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]]);
        assert_eq!(convex_hull((0..5).map(|x| [f64::from(x), 2.0]).collect()), [[0.0, 2.0], [4.0, 2.0]]);
        assert_eq!(convex_hull(vec![[1.0, 1.0]; 3]), [[1.0, 1.0]]);
    }
}
