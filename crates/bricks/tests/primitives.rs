//! The 72 primitive bricks of Wang et al. (2022), drawn by ourselves, against the official geometry.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use mb_bricks::{MeshOptions, Model, PartLibrary};
use mb_geometry::Ray;
use mb_mesh::{Bvh, TriangleMesh, sample_uniform};
use nalgebra::{Point3, Vector3};

/// Directions from which a brick is looked at: from all around, above and below.
fn views() -> Vec<Vector3<f64>> {
    let mut views = vec![Vector3::y(), -Vector3::y()];
    for (rise, count) in [(0.03, 8), (0.5, 8), (1.3, 4), (-0.5, 8), (-1.3, 8), (-4.0, 4)] {
        for index in 0..count {
            let angle = 0.3 + std::f64::consts::TAU * f64::from(index) / f64::from(count);
            views.push(Vector3::new(angle.cos(), rise, angle.sin()).normalize());
        }
    }
    views
}

/// Points of the surface that some view sees.
fn visible_points(mesh: &TriangleMesh, bvh: &Bvh) -> Vec<Point3<f64>> {
    let views = views();
    let seen = |p: &Point3<f64>| {
        views.iter().any(|view| !bvh.occluded(&Ray { origin: p + view * 1e-6, direction: *view }, 1.0))
    };
    sample_uniform(mesh, 4000, 1).into_iter().map(|sample| sample.point).filter(seen).collect()
}

/// Seen from below, what we leave out: part, largest difference allowed in millimetres, what it is.
const LEFT_OUT: [(&str, f64, &str); 2] =
    [("3007", 1.7, "ribs between tubes and walls"), ("59900", 0.35, "teeth of the axle hole")];

struct Difference {
    number: String,
    mean_mm: f64,
    max_mm: f64,
    box_mm: f64,
}

fn compare(number: &str, library: &PartLibrary) -> Difference {
    let text = format!("1 4 0 0 0 1 0 0 0 1 0 0 0 1 {number}.dat\n");
    let mesh = |library| Model::from_text(&text, number, library).unwrap().mesh(&MeshOptions::default());
    let (ours, official) = (mesh(None), mesh(Some(library)));
    assert!(!ours.triangles.is_empty(), "{number} is not drawn");
    let (our_bvh, official_bvh) = (Bvh::new(&ours), Bvh::new(&official));
    let (mut mean_mm, mut max_mm) = (0.0_f64, 0.0_f64);
    for (mesh, own, other) in [(&ours, &our_bvh, &official_bvh), (&official, &official_bvh, &our_bvh)] {
        let points = visible_points(mesh, own);
        let distances: Vec<f64> = points.iter().map(|p| other.closest(p).unwrap().distance * 1e3).collect();
        mean_mm = mean_mm.max(distances.iter().sum::<f64>() / distances.len() as f64);
        max_mm = distances.into_iter().fold(max_mm, f64::max);
    }
    let (a, b) = (ours.bounds(), official.bounds());
    let box_mm = ((a.min - b.min).amax()).max((a.max - b.max).amax()) * 1e3;
    Difference { number: number.to_owned(), mean_mm, max_mm, box_mm }
}

#[test]
fn all_72_look_like_the_official_ones_from_outside() {
    let (Some(list), Some(library)) =
        (mb_testdata::find("ldraw/primitive-bricks-72.csv"), mb_testdata::find("ldraw/parts.zip"))
    else {
        return;
    };
    let library = PartLibrary::open(library).unwrap();
    let list = std::fs::read_to_string(list).unwrap();
    let numbers: Vec<&str> = list.lines().skip(1).filter_map(|line| line.split(',').next()).collect();
    assert_eq!(numbers.len(), 72);
    let mut differences: Vec<Difference> = numbers.iter().map(|number| compare(number, &library)).collect();
    differences.sort_by(|a, b| b.max_mm.total_cmp(&a.max_mm));
    println!("part, mean, maximum, box (mm), worst first:");
    for Difference { number, mean_mm, max_mm, box_mm } in &differences {
        println!("{number:>8} {mean_mm:.4} {max_mm:.4} {box_mm:.4}");
    }
    for Difference { number, mean_mm, max_mm, box_mm } in &differences {
        let left_out = LEFT_OUT.iter().find(|(part, _, _)| part == number);
        let max_allowed_mm = left_out.map_or(0.3, |(_, max_mm, _)| *max_mm);
        assert!(*mean_mm < 0.05 && *max_mm < max_allowed_mm && *box_mm < 0.02, "{number}: {mean_mm} {max_mm} {box_mm}");
    }
}
