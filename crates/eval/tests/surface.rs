//! Surface scores against the published script's own numbers, and against closed forms.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::VisibilityVolume;
use mb_eval::{
    SurfaceOptions, SurfaceProtocol, SurfaceScores, SurfaceTruth, evaluate_surface, evaluate_surface_method,
    read_sequence_list, score_surface,
};
use mb_geometry::{Rigid3, World};
use mb_job::Silent;
use mb_mesh::{TriangleMesh, write_mesh};
use nalgebra::{Point3, Vector3, Vector6};

fn score(gt: &Path, pred: &Path, protocol: SurfaceProtocol) -> SurfaceScores {
    let options = SurfaceOptions { protocol, ..SurfaceOptions::default() };
    evaluate_surface(gt, pred, &options, &Silent).unwrap()
}

/// The published script on four predictions with known defects. Its sampling is unseeded, so each of its numbers is one
/// draw: on `half` the Chamfer distance scatters by 0.02 mm over seeds, in the script as here.
#[test]
fn the_published_script_is_reproduced() {
    let Some(folder) = mb_testdata::find("official_scorer") else { return };
    let text = std::fs::read_to_string(folder.join("expected_surface.json")).unwrap();
    let expected: serde_json::Value = serde_json::from_str(&text).unwrap();
    let predictions = expected["predictions"].as_object().unwrap();
    assert_eq!(predictions.len(), 4);
    for (name, expected) in predictions {
        let pred = folder.join("preds").join(name).with_extension("ply");
        let found = score(&folder.join("wedge"), &pred, SurfaceProtocol::MobileBrick2023);
        let close = |what: &str, found: f64, expected: &serde_json::Value, tolerance: f64| {
            let expected = expected.as_f64().unwrap();
            assert!((found - expected).abs() <= tolerance, "{name}: {what} is {found}, expected {expected}");
        };
        close("fitness", found.icp.fitness, &expected["fitness"], 1e-4);
        assert_eq!(found.icp.applied, found.icp.fitness > 0.99);
        close("Chamfer in m", found.chamfer.chamfer_mm / 1000.0, &expected["chamfer"], 2e-5);
        for (threshold, key) in found.thresholds.iter().zip(["2.5mm", "5mm"]) {
            close("accuracy", threshold.accuracy, &expected[format!("accuracy_{key}")], 0.003);
            close("recall", threshold.recall, &expected[format!("recall_{key}")], 0.003);
            close("F1", threshold.f1, &expected[format!("F1_{key}")], 0.003);
        }
    }
}

#[test]
fn the_truth_scores_perfectly_in_the_exact_protocol() {
    let Some(folder) = mb_testdata::find("official_scorer") else { return };
    let gt = folder.join("wedge");
    let found = score(&gt, &gt.join("mesh/gt_mesh.ply"), SurfaceProtocol::Exact1);
    assert_eq!((found.chamfer.chamfer_mm, found.chamfer.pred_to_gt_mm, found.chamfer.gt_to_pred_mm), (0.0, 0.0, 0.0));
    let aligned = &found.exact.as_ref().unwrap().aligned;
    assert_eq!(aligned.chamfer.chamfer_mm, 0.0);
    for threshold in found.thresholds.iter().chain(&aligned.thresholds) {
        assert_eq!((threshold.accuracy, threshold.recall, threshold.f1), (1.0, 1.0, 1.0));
    }
    assert_eq!(found.curve.f1_auc, 1.0);
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);
}

/// A sequence folder whose truth is a box of 10 x 6 x 8 cm, not at the origin, all of it visible.
fn box_sequence(dir: &Path) -> TriangleMesh {
    let mesh = box_mesh(Vector3::new(0.10, 0.06, 0.08), 8);
    write_mesh(dir.join("mesh/gt_mesh.ply"), &mesh).unwrap();
    let resolutions = [60, 50, 60];
    VisibilityVolume {
        mask: vec![true; resolutions.iter().product()],
        resolutions,
        voxel_size_m: 0.0025,
        min_pt_in_world: mesh.bounds().center() - Vector3::new(59., 49., 59.) * 0.00125,
    }
    .write(dir.join("visibility_mask.npy"))
    .unwrap();
    mesh
}

/// Each face a grid of `n` x `n` squares with vertices of its own.
fn box_mesh(size: Vector3<f64>, n: usize) -> TriangleMesh {
    let centre = Point3::new(0.5, 0.2, -0.4);
    let mut mesh = TriangleMesh::default();
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let first = mesh.vertices.len() as u32;
            for i in 0..=n {
                for j in 0..=n {
                    let mut corner = Vector3::zeros();
                    corner[axis] = side / 2.0;
                    corner[(axis + 1) % 3] = i as f64 / n as f64 - 0.5;
                    corner[(axis + 2) % 3] = j as f64 / n as f64 - 0.5;
                    mesh.vertices.push(centre + corner.component_mul(&size));
                }
            }
            for i in 0..n as u32 {
                for j in 0..n as u32 {
                    let at = |i: u32, j: u32| first + i * (n as u32 + 1) + j;
                    let quad = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                    mesh.triangles.extend([[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]);
                }
            }
        }
    }
    mesh
}

fn score_box(change: impl Fn(&mut TriangleMesh), options: &SurfaceOptions) -> Result<SurfaceScores, String> {
    let dir = tempfile::tempdir().unwrap();
    let mut mesh = box_sequence(dir.path());
    change(&mut mesh);
    let truth = SurfaceTruth::read(dir.path(), options.protocol).unwrap();
    score_surface(&truth, mesh, Path::new("pred.ply"), options, &Silent).map_err(|e| e.to_string())
}

fn exact(points: usize) -> SurfaceOptions {
    SurfaceOptions { protocol: SurfaceProtocol::Exact1, points, ..SurfaceOptions::default() }
}

#[test]
fn a_shift_has_its_closed_form_and_alignment_takes_it_back() {
    let found = score_box(|m| m.vertices.iter_mut().for_each(|v| v.x += 0.001), &exact(20_000)).unwrap();
    // The two faces across the shift are 1 mm off; the others slide in their planes, but for a strip of 1 mm.
    let across = 2.0 * 0.06 * 0.08;
    let along = 2.0 * 0.10 * (0.06 + 0.08);
    let expected = across / (across + along);
    assert!((found.chamfer.pred_to_gt_mm - expected).abs() < 0.01, "{} {expected}", found.chamfer.pred_to_gt_mm);
    assert!((found.chamfer.gt_to_pred_mm - expected).abs() < 0.01, "{} {expected}", found.chamfer.gt_to_pred_mm);
    let aligned = &found.exact.as_ref().unwrap().aligned;
    assert!((aligned.translation_mm - 1.0).abs() < 1e-3, "{}", aligned.translation_mm);
    assert!(aligned.chamfer.chamfer_mm < 1e-3, "{}", aligned.chamfer.chamfer_mm);
    assert!(!found.icp.applied);
}

#[test]
fn a_turned_prediction_is_named_in_the_aligned_column_only() {
    let turn = Rigid3::<World, World>::exp(&Vector6::new(0.0, 0.02, 0.0, 0.0, 0.0, 0.0));
    let change = |m: &mut TriangleMesh| {
        let centre = m.bounds().center();
        m.vertices.iter_mut().for_each(|v| *v = centre + turn.rotate(&(*v - centre)));
    };
    let found = score_box(change, &exact(20_000)).unwrap();
    let aligned = &found.exact.as_ref().unwrap().aligned;
    assert!((aligned.rotation_deg - 0.02f64.to_degrees()).abs() < 1e-3);
    assert!(aligned.chamfer.chamfer_mm < 1e-3 && found.chamfer.chamfer_mm > 0.3, "{found:?}");
    let bounds = found.exact.unwrap().confidence_95.chamfer_mm;
    assert!(bounds.0 < found.chamfer.chamfer_mm && found.chamfer.chamfer_mm < bounds.1);
}

/// Two triangles a metre wide, of which 15 x 15 cm lie in the volume: the published crop loses them whole.
#[test]
fn large_triangles_are_cut_and_not_dropped() {
    let dir = tempfile::tempdir().unwrap();
    let gt = box_sequence(dir.path()).bounds();
    let corner = |x: f64, z: f64| Point3::new(gt.center().x + x, gt.max.y, gt.center().z + z);
    let sheet = |half: f64| {
        let corners = [corner(-half, -half), corner(half, -half), corner(half, half), corner(-half, half)];
        TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]])
    };
    write_mesh(dir.path().join("mesh/gt_mesh.ply"), &sheet(0.05)).unwrap();
    let truth = SurfaceTruth::read(dir.path(), SurfaceProtocol::Exact1).unwrap();
    let score = |options: &SurfaceOptions| score_surface(&truth, sheet(0.5), Path::new("p.ply"), options, &Silent);
    let found = score(&exact(20_000)).unwrap();
    assert_eq!((found.chamfer.gt_to_pred_mm, found.thresholds[0].recall), (0.0, 1.0));
    // Of the visible 150 x 150 mm, 105 x 105 mm lie within 2.5 mm of the truth (but for the rounded corners).
    let expected = 105.0f64.powi(2) / 150.0f64.powi(2);
    assert!((found.thresholds[0].accuracy - expected).abs() < 0.005, "{}", found.thresholds[0].accuracy);
    let published = score(&SurfaceOptions::default()).unwrap_err().to_string();
    assert!(published.contains("no part of the prediction lies inside"), "{published}");
}

#[test]
fn each_mistake_is_named_with_its_fix() {
    type Mistake = fn(&mut TriangleMesh);
    let cases: [(&str, &str, Mistake); 7] = [
        ("in millimetres", "by 0.001", |m| m.vertices.iter_mut().for_each(|v| v.coords *= 1000.0)),
        ("other axes", "(x, -y, -z)", |m| {
            m.vertices.iter_mut().for_each(|v| *v = Point3::new(v.x, -v.y, -v.z));
        }),
        ("millimetres, and in another frame", "0.001", |m| {
            let c = m.bounds().center();
            m.vertices.iter_mut().for_each(|v| *v = Point3::from((*v - c) * 1000.0));
        }),
        ("another frame", "Its size fits", |m| {
            let c = m.bounds().center();
            m.vertices.iter_mut().for_each(|v| *v = Point3::from(*v - c));
        }),
        ("empty", "", |m| *m = TriangleMesh::default()),
        ("not a finite point", "Remove", |m| m.vertices[7].y = f64::NAN),
        ("refers to vertices", "", |m| m.triangles[3][1] = 1_000_000),
    ];
    for protocol in SurfaceProtocol::ALL {
        for (found, help, change) in &cases {
            let options = SurfaceOptions { protocol, points: 1000, ..SurfaceOptions::default() };
            let message = score_box(change, &options).unwrap_err();
            assert!(message.contains(found) && message.contains(help), "{protocol}: {message}");
        }
    }
}

#[test]
fn a_point_cloud_is_scored_and_a_miss_is_zero_with_a_warning() {
    for protocol in SurfaceProtocol::ALL {
        let options = SurfaceOptions { protocol, points: 5000, ..SurfaceOptions::default() };
        let cloud = score_box(|m| m.triangles.clear(), &options).unwrap();
        assert!(cloud.warnings.iter().any(|w| w.contains("point cloud")), "{:?}", cloud.warnings);
        if protocol != SurfaceProtocol::TntStyle1 {
            assert_eq!(cloud.points[1], 6 * 81);
        }
        // A small box in the middle of the true one: 15 mm and more away from all of its faces.
        let miss = score_box(
            |m| {
                let c = m.bounds().center();
                m.vertices.iter_mut().for_each(|v| *v = c + (*v - c) * 0.01);
            },
            &options,
        )
        .unwrap();
        assert_eq!((miss.thresholds[0].f1, miss.thresholds[1].f1), (0.0, 0.0));
        assert!(miss.warnings.iter().any(|w| w.contains("0/0, counted as 0")), "{:?}", miss.warnings);
    }
}

#[test]
fn threads_do_not_move_a_score_and_the_seed_does() {
    for protocol in SurfaceProtocol::ALL {
        let run = |threads: usize, seed: u64| {
            let options = SurfaceOptions { protocol, points: 5000, seed, ..SurfaceOptions::default() };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let shrink = |m: &mut TriangleMesh| m.vertices.iter_mut().for_each(|v| v.y *= 0.99);
            let mut scores = pool.install(|| score_box(shrink, &options)).unwrap();
            scores.seconds = 0.0;
            // The name of a temporary folder.
            scores.sequence.clear();
            scores
        };
        assert_eq!(run(1, 0), run(3, 0));
        assert_ne!(run(1, 0).chamfer, run(1, 1).chamfer);
    }
}

/// Golden scores: if these move, the protocol needs a new name.
#[test]
fn golden_scores_pin_the_protocols() {
    for protocol in SurfaceProtocol::ALL {
        let options = SurfaceOptions { protocol, points: 10_000, ..SurfaceOptions::default() };
        let dent = |m: &mut TriangleMesh| {
            m.vertices.iter_mut().for_each(|v| v.y += 0.004 * (40.0 * v.x).sin());
            m.triangles.truncate(700);
        };
        let found = score_box(dent, &options).unwrap();
        let rounded = |v: f64| format!("{v:.9}");
        let mut numbers =
            vec![rounded(found.icp.fitness), rounded(found.chamfer.chamfer_mm), rounded(found.curve.f1_auc)];
        numbers.extend(found.thresholds.iter().flat_map(|t| [rounded(t.accuracy), rounded(t.recall), rounded(t.f1)]));
        if let Some(dtu) = &found.dtu {
            numbers.extend([dtu.accuracy_mm, dtu.completeness_median_mm, dtu.accuracy_outliers].map(rounded));
        }
        if let Some(exact) = &found.exact {
            let interval = exact.confidence_95.chamfer_mm;
            numbers.extend([rounded(exact.aligned.chamfer.chamfer_mm), rounded(interval.0), rounded(interval.1)]);
        }
        insta::assert_snapshot!(format!("golden_{protocol}"), numbers.join("\n"));
    }
}

/// A sequence with all that a breakdown needs: the box as two bricks, cameras above and beside it, an alignment.
fn filmed_box(dir: &Path) -> TriangleMesh {
    let mut mesh = box_sequence(dir);
    // The half with the smaller x is brick 3, the other brick 7.
    let middle = mesh.bounds().center();
    let part = |t: usize| if mesh.triangle(t).iter().map(|p| p.x).sum::<f64>() < 3.0 * middle.x { 3 } else { 7 };
    mesh.triangle_parts = Some((0..mesh.triangles.len()).map(part).collect());
    // Faces of the grid at the negative sides are wound inwards: turn them round.
    for t in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.triangle(t);
        if mesh.scaled_normal(t).dot(&((a.coords + b.coords + c.coords) / 3.0 - middle.coords)) < 0.0 {
            mesh.triangles[t].swap(1, 2);
        }
    }
    write_mesh(dir.join("mesh/visible_surface.ply"), &mesh).unwrap();
    for (i, back) in
        [Vector3::new(0.0, 0.5, 0.0), Vector3::new(0.0, 0.0, 0.5), Vector3::new(0.0, 0.35, 0.35)].iter().enumerate()
    {
        let forward = -back.normalize();
        let right = Vector3::x();
        let down = forward.cross(&right);
        let centre = middle + back;
        let rows: Vec<String> = (0..3)
            .map(|r| format!("{} {} {} {}", right[r], down[r], forward[r], centre[r]))
            .chain(["0 0 0 1".to_owned()])
            .collect();
        for (folder, text) in [("pose", rows.join("\n")), ("intrinsic", "800 0 319.5\n0 800 239.5\n0 0 1".to_owned())] {
            std::fs::create_dir_all(dir.join(folder)).unwrap();
            std::fs::write(dir.join(folder).join(format!("{i:06}.txt")), text).unwrap();
        }
    }
    std::fs::write(dir.join("sequence.json"), r#"{"version": 1, "image_size": {"width": 640, "height": 480}}"#)
        .unwrap();
    std::fs::create_dir_all(dir.join("alignment")).unwrap();
    let pose = r#"{"rotation_wxyz": [1, 0, 0, 0], "translation_m": [0, 0, 0]}"#;
    let document = format!(r#"{{"version": 1, "stage": "truth", "world_from_object": {pose}, "frames": []}}"#);
    std::fs::write(dir.join("alignment/alignment.json"), document).unwrap();
    mesh
}

#[test]
fn a_breakdown_says_which_brick_and_which_side_is_wrong() {
    use mb_eval::{OfAngle, OfViews, Region};
    let dir = tempfile::tempdir().unwrap();
    let mut prediction = filmed_box(dir.path());
    let middle = prediction.bounds().center();
    // The underside hangs 4 mm too low, and far above floats a lone triangle.
    let bottom = prediction.bounds().min.y;
    prediction.vertices.iter_mut().filter(|v| v.y == bottom).for_each(|v| v.y -= 0.004);
    let first = prediction.vertices.len() as u32;
    let floater = [[0.0, 0.06, 0.0], [0.0, 0.06, 0.01], [0.01, 0.06, 0.0]].map(|v| middle + Vector3::from(v));
    prediction.vertices.extend(floater);
    prediction.triangles.push([first, first + 1, first + 2]);
    let truth = SurfaceTruth::read(dir.path(), SurfaceProtocol::Exact1).unwrap();
    let found = score_surface(&truth, prediction, Path::new("p.ply"), &exact(20_000), &Silent).unwrap();
    let breakdown = &found.exact.as_ref().unwrap().breakdown;
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);

    let parts = breakdown.by_part.as_ref().unwrap();
    assert_eq!(parts.iter().map(|g| g.of.part).collect::<Vec<_>>(), [3, 7]);
    assert_eq!(parts.iter().map(|g| g.gt_points).sum::<usize>(), 20_000);
    let regions = breakdown.by_region.as_ref().unwrap();
    let region = |region: Region| regions.iter().find(|g| g.of.region == region).unwrap();
    // Near its rim the underside is closer to the walls, which reach as far down.
    let underside = region(Region::Undersides);
    assert!((3.0..4.0).contains(&underside.gt_to_pred_mm.unwrap()), "{underside:?}");
    assert!(underside.thresholds[0].recall.unwrap() < 0.2, "{underside:?}");
    assert_eq!(region(Region::Tops).thresholds[0].recall, Some(1.0));
    assert!(regions.iter().all(|g| g.of.region != Region::Studs && g.of.region != Region::Holes));
    // The underside has no view, the top two: from straight above, and from 45 degrees.
    let views = breakdown.by_views.as_ref().unwrap();
    let unseen = views.iter().find(|g| g.of == OfViews { from_views: 0, to_views: Some(0) }).unwrap();
    assert!(unseen.gt_points > 1000);
    let angles = breakdown.by_viewing_angle.as_ref().unwrap();
    let straight = angles.iter().find(|g| g.of == OfAngle { from_deg: 0, to_deg: 15 }).unwrap();
    assert_eq!(straight.thresholds[0].recall, Some(1.0));
    assert_eq!(breakdown.floaters.pieces, Some(1));
    assert!(breakdown.floaters.share > 0.0 && breakdown.floaters.share < 0.01);
    assert_eq!(breakdown.coverage.share, 1.0);
    assert_eq!(breakdown.coverage.missed_parts.as_deref(), Some(&[][..]));
    let normals = breakdown.normals.unwrap();
    assert!(normals.consistency > 0.9 && normals.opposed_share < 0.05, "{normals:?}");
}

#[test]
fn a_shift_is_what_alignment_takes_back() {
    let found = score_box(|m| m.vertices.iter_mut().for_each(|v| v.x += 0.003), &exact(20_000)).unwrap();
    let aligned = &found.exact.as_ref().unwrap().aligned;
    assert!((aligned.effect.chamfer_mm + found.chamfer.chamfer_mm).abs() < 1e-2, "{:?}", aligned.effect);
    let f1 = aligned.effect.f1[0];
    assert_eq!(f1.threshold_mm, 2.5);
    assert!((f1.change - (1.0 - found.thresholds[0].f1)).abs() < 1e-9 && f1.change > 0.05, "{f1:?}");
}

#[test]
fn dtu_style_means_leave_outliers_out_and_tanks_style_scores_register_first() {
    let options = |protocol| SurfaceOptions { protocol, points: 20_000, ..SurfaceOptions::default() };
    // Half of the prediction is gone: what lies far from the rest is an outlier, not a distance of 50 mm.
    let half = |m: &mut TriangleMesh| {
        let middle = m.bounds().center();
        let keep: Vec<bool> = m.vertices.iter().map(|v| v.x <= middle.x).collect();
        m.retain_vertices(&keep);
    };
    let found = score_box(half, &options(SurfaceProtocol::DtuStyle1)).unwrap();
    let dtu = found.dtu.unwrap();
    assert!(dtu.accuracy_mm < 1e-6 && dtu.completeness_median_mm < 1e-6, "{dtu:?}");
    assert!((0.2..0.5).contains(&dtu.completeness_outliers) && dtu.completeness_mm < 20.0, "{dtu:?}");
    assert!((dtu.overall_mm - 0.5 * found.chamfer.chamfer_mm).abs() < 1e-12);
    // 3 mm beside its place every face across is beyond 2.5 mm; registered, nothing is.
    let shifted = |m: &mut TriangleMesh| m.vertices.iter_mut().for_each(|v| v.x += 0.003);
    let found = score_box(shifted, &options(SurfaceProtocol::TntStyle1)).unwrap();
    assert!(found.icp.applied && (found.icp.translation_mm - 3.0).abs() < 1e-2, "{:?}", found.icp);
    assert_eq!((found.thresholds[0].f1, found.thresholds[1].f1), (1.0, 1.0));
    // Thinned clouds: one point per voxel of 1.25 mm and fewer, not the samples of a quarter of a square metre.
    assert!(found.points[0] < 40_000 && found.points[0] > 10_000, "{:?}", found.points);
}

#[test]
fn a_score_names_the_files_that_it_was_computed_from() {
    let dir = tempfile::tempdir().unwrap();
    let mesh = box_sequence(dir.path());
    let pred = dir.path().join("pred.stl");
    write_mesh(&pred, &mesh).unwrap();
    let found = evaluate_surface(dir.path(), &pred, &exact(1000), &Silent).unwrap();
    let provenance = found.provenance.unwrap();
    assert_eq!(provenance.prediction.path, pred);
    assert_eq!(provenance.prediction.bytes, std::fs::metadata(&pred).unwrap().len());
    assert_eq!(provenance.ground_truth.sha256.len(), 64);
}

#[test]
fn a_table_names_what_is_missing_and_leaves_it_out_of_the_means() {
    let dir = tempfile::tempdir().unwrap();
    let (root, meshes) = (dir.path().join("data"), dir.path().join("meshes/ours"));
    for name in ["a", "b", "c", "d"] {
        let mesh = box_sequence(&root.join(name));
        if name == "a" || name == "c" {
            write_mesh(meshes.join(name).with_extension("ply"), &mesh).unwrap();
        }
    }
    std::fs::write(meshes.join("d.ply"), "ply\nnonsense").unwrap();
    let list = dir.path().join("test_seqs.txt");
    std::fs::write(&list, "a,b,c,d").unwrap();
    let list = read_sequence_list(&list).unwrap();
    let table = evaluate_surface_method("ours", &meshes, &root, &list, &exact(2000), &Silent).unwrap();
    let mean = table.mean.as_ref().unwrap();
    assert_eq!((mean.sequences, mean.thresholds[0].f1, mean.chamfer.chamfer_mm), (2, 1.0, 0.0));
    let missing: Vec<_> = table.missing.iter().map(|m| m.sequence.as_str()).collect();
    assert_eq!(missing, ["b", "d"]);
    assert!(table.missing[0].reason.contains("no prediction"), "{}", table.missing[0].reason);

    let out = dir.path().join("out");
    table.write(&out).unwrap();
    let read = mb_eval::SurfaceTable::read(&out.join("scores.json")).unwrap();
    assert_eq!((&read.list, &read.missing, &read.options), (&table.list, &table.missing, &table.options));
    assert_eq!(
        read.sequences[1].exact.as_ref().unwrap().breakdown,
        table.sequences[1].exact.as_ref().unwrap().breakdown
    );
    let csv = std::fs::read_to_string(out.join("data.csv")).unwrap();
    let rows: Vec<_> = csv.split("\r\n").collect();
    assert_eq!((rows[0], rows[1], rows[2], rows[3]), ("a,b,c,d", "1,,1,", "0,,0,", "1,,1,"));
    assert_eq!(rows.len(), 10, "nine rows and the last line end");
    let named = std::fs::read_to_string(out.join("scores.csv")).unwrap();
    let lines: Vec<_> = named.lines().collect();
    assert_eq!(lines.len(), 6);
    assert!(lines[0].starts_with("method,protocol,sequence,icp_fitness,icp_applied,chamfer_mm"));
    assert!(lines[0].contains("accuracy_2.5mm") && lines[0].contains("aligned_f1_5mm"));
    assert!(lines[2].starts_with("ours,exact-1,b,,,,") && lines[2].contains("no prediction"), "{}", lines[2]);
    assert!(lines[5].starts_with("ours,exact-1,mean of 2,,,0,0,0,1,1,1"), "{}", lines[5]);
    let columns = lines[0].split(',').count();
    assert!([1, 5].iter().all(|&l| lines[l].split(',').count() == columns));
}

#[test]
fn lists_of_sequences_are_read_liberally() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("list.txt");
    let read = |text: &str| {
        std::fs::write(&path, text).unwrap();
        read_sequence_list(&path).map_err(|e| e.to_string())
    };
    for text in ["a,b", "a, b\n", "a\r\nb\r\n", "\u{feff}# names\na,\n\nb,"] {
        assert_eq!(read(text).unwrap(), ["a", "b"], "{text:?}");
    }
    assert!(read(" \n").unwrap_err().contains("names no sequence"));
    assert!(read("a,b\na").unwrap_err().contains("line 2: \"a\" is listed twice"));
    assert!(read("../a").unwrap_err().contains("no name of a sequence"));
}
