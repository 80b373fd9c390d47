//! The paper's tables with rows of one's own, from the documents that `eval` writes.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::{Path, PathBuf};

use mb_eval::{MethodScores, PaperTable, TableFormat, compare};
use serde_json::json;

fn surface(sequence: &str, f1: f64) -> serde_json::Value {
    let threshold = |t: f64, f1: f64| json!({"threshold_mm": t, "accuracy": f1, "recall": f1, "f1": f1});
    json!({
        "protocol": "mobilebrick-2023", "sequence": sequence, "chamfer_mm": 5.0,
        "thresholds": [threshold(2.5, f1), threshold(5.0, f1)],
    })
}

fn write(folder: &Path, name: &str, document: &serde_json::Value) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, document.to_string()).unwrap();
    path
}

#[test]
fn rows_stand_beside_the_published_ones_and_missing_sequences_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let of = |method: &str, better: f64, missing: &[&str]| {
        let names = ["audi", "boat", "cabin", "jeep"];
        let scored: Vec<_> = names
            .iter()
            .enumerate()
            .filter(|(_, n)| !missing.contains(n))
            .map(|(i, n)| surface(n, 0.5 + 0.1 * i as f64 + better))
            .collect();
        let missing: Vec<_> = missing.iter().map(|n| json!({"sequence": n, "reason": "no prediction"})).collect();
        let document =
            json!({"method": method, "protocol": "mobilebrick-2023", "sequences": scored, "missing": missing});
        write(dir.path(), &format!("{method}.json"), &document)
    };
    let files = [of("a_one", 0.05, &[]), of("b", 0.0, &["jeep"])];
    let documents = files.iter().flat_map(|f| MethodScores::read(f, None).unwrap()).collect();
    let tables = compare(documents, &[PaperTable::Surfaces], 0).unwrap();
    assert_eq!(tables.len(), 1);
    let table = &tables[0];
    assert_eq!(table.rows.rows.len(), 12);
    let mine = &table.rows.rows[10];
    assert_eq!((mine.method.as_str(), mine.origin.as_str()), ("a_one", "4 sequences"));
    assert!((mine.values[2].unwrap() - 70.0).abs() < 1e-9, "percent, the mean over sequences");
    assert_eq!(table.rows.rows[11].origin, "3 of 4 sequences");
    assert_eq!(table.notes[0], "b: no score for jeep; the row is the mean of the other 3");
    assert!(table.notes[1].starts_with("a_one, b: not over the 18 test sequences"), "{:?}", table.notes);
    // Only the three common sequences: 0.05 apart on each, whatever the sequence.
    let difference = &table.differences[0].difference;
    assert_eq!((difference.sequences, difference.p_two_sided, difference.is_significant()), (3, 0.25, false));
    assert!((difference.mean - 5.0).abs() < 1e-9);
    assert_eq!(table.impossible[0].method, "BNV-Fusion");
    for format in TableFormat::ALL {
        let text = table.render(format);
        assert!(text.contains("BNV-Fusion"), "{text}");
        assert_eq!(text.contains("jeep"), format != TableFormat::Csv, "{text}");
    }
    assert!(table.render(TableFormat::Latex).contains("a\\_one"));
}

#[test]
fn other_protocols_have_a_table_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    let mut exact = surface("audi", 0.9);
    exact["protocol"] = "exact-1".into();
    let file = write(dir.path(), "exact.json", &exact);
    let documents = MethodScores::read(&file, Some("mine")).unwrap();
    let tables = compare(documents, &[PaperTable::Surfaces], 0).unwrap();
    assert_eq!(tables.iter().map(|t| t.protocol.as_str()).collect::<Vec<_>>(), ["mobilebrick-2023", "exact-1"]);
    assert_eq!((tables[0].rows.rows.len(), tables[1].rows.rows.len()), (10, 1));
    assert_eq!(tables[1].source, None);
}

#[test]
fn views_are_weighed_by_images_and_depth_and_poses_by_sequence() {
    let dir = tempfile::tempdir().unwrap();
    let views = json!({
        "method": "nerf", "protocol": "mobilebrick-nvs-2023", "missing_sequences": [],
        "per_sequence": [
            {"sequence": "a", "images": 3, "psnr": 20.0, "ssim": 0.5, "lpips": 0.4},
            {"sequence": "b", "images": 1, "psnr": 24.0, "ssim": 0.7, "lpips": null},
        ],
    });
    let depth = |abs_rel: f64| {
        json!({
            "protocol": "depth-1", "abs_rel": abs_rel, "sq_rel": 0.0, "rmse_m": 0.0, "rmse_log": 0.0, "delta1": 1.0,
            "delta2": 1.0, "delta3": 1.0, "silog": 0.0, "delta_105": 1.0, "delta_1025": 1.0, "valid_pixels": 9,
        })
    };
    let poses = json!({"protocol": "poses-1", "pairwise": {"translation_rmse_mm": 2.5, "rotation_mean_deg": 0.5}});
    let folder = dir.path().join("depth");
    std::fs::create_dir(&folder).unwrap();
    write(&folder, "a.json", &depth(0.1));
    write(&folder, "b.json", &depth(0.3));
    let mut documents = MethodScores::read(&write(dir.path(), "views.json", &views), None).unwrap();
    documents.extend(MethodScores::read(&folder, Some("up")).unwrap());
    documents.extend(MethodScores::read(&write(dir.path(), "seq.json", &poses), Some("ours")).unwrap());
    let tables = compare(documents, &PaperTable::ALL, 0).unwrap();
    let last = |i: usize| &tables[i].rows.rows.last().unwrap().values;
    assert_eq!(last(1)[..], [Some(21.0), Some(0.55), None], "a mean without one of its sequences is none");
    assert_eq!(last(2)[0], Some(0.2));
    assert_eq!(last(3)[..], [Some(2.5), Some(0.5), None, None]);
}

#[test]
fn what_is_no_score_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let message = |name: &str, text: &str, method: Option<&str>| {
        let path = dir.path().join(name);
        std::fs::write(&path, text).unwrap();
        MethodScores::read(&path, method).unwrap_err().to_string()
    };
    assert!(message("a.json", "{}", None).contains("missing field `protocol`"));
    assert!(message("a.json", &surface("audi", 1.0).to_string(), None).contains("Give it as NAME=FILE"));
    assert!(message("a.json", r#"{"protocol": "x-9"}"#, Some("m")).contains("\"x-9\" that no table has"));
    assert!(message("a.json", r#"{"protocol": "poses-1"}"#, Some("m")).contains("missing field `pairwise`"));
    let file = write(dir.path(), "twice.json", &surface("audi", 0.9));
    let twice = [&file, &file].map(|f| MethodScores::read(f, Some("m")).unwrap()).concat();
    let found = compare(twice, &PaperTable::ALL, 0).unwrap_err().to_string();
    assert!(found.contains("m has a score for \"audi\""), "{found}");
}
