//! What outsiders rely on: exit status, one JSON document on stdout, documented keys, nothing half-written.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

fn mobilebrick(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_mobilebrick"))
        .args(arguments)
        .env_remove("LDRAWDIR")
        .env("XDG_DATA_HOME", "/nonexistent")
        .output()
        .unwrap()
}

/// The one JSON document that a successful run prints.
fn document(arguments: &[&str]) -> Value {
    let output = mobilebrick(&[arguments, &["--json", "-q"]].concat());
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {stderr}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The message of a run that must end with `status`.
fn failure(arguments: &[&str], status: i32) -> String {
    let output = mobilebrick(arguments);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {stderr}");
    stderr
}

fn has_keys(document: &Value, keys: &[&str]) {
    for key in keys {
        assert!(document.get(key).is_some(), "no key {key} in {document:#}");
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn wrong_usage_is_status_2_and_bad_input_status_3() {
    failure(&["eval", "surface"], 2);
    failure(&["model", "info"], 2);
    failure(&["demo", "--threads", "0"], 2);
    let dir = tempfile::tempdir().unwrap();
    let missing = dir.path().join("no.ldr");
    assert!(failure(&["model", "info", text(&missing)], 3).contains("no.ldr"));
    assert!(failure(&["truth", text(dir.path())], 3).contains("no frames found"));
    assert!(failure(&["align", "keypoints", text(&missing)], 3).contains("no such folder"));
}

#[test]
fn a_failure_with_json_is_one_document_too() {
    let output = mobilebrick(&["model", "info", "/nonexistent/model.ldr", "--json"]);
    assert_eq!(output.status.code(), Some(3));
    let document: Value = serde_json::from_slice(&output.stdout).unwrap();
    has_keys(&document, &["error", "exit_status", "file", "found"]);
}

#[test]
fn a_failed_mesh_leaves_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("broken.ldr");
    std::fs::write(&model, "1 4 0 0 0 1 0 0 0 nan 0 0 0 1 3001.dat\n").unwrap();
    let out = dir.path().join("mesh.ply");
    failure(&["model", "mesh", text(&model), "-o", text(&out)], 3);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "only the model is there");
}

#[test]
fn instructions_of_a_small_model_come_with_their_lists() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("tower.ldr");
    std::fs::write(&model, "1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 4 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n").unwrap();
    let [page, csv, xml] = ["booklet.html", "parts.csv", "parts.xml"].map(|name| dir.path().join(name));
    let lists = ["--shopping-list", text(&csv), "--wanted-list", text(&xml)];
    let done = document(&[&["model", "instructions", text(&model), "-o", text(&page)], &lists[..]].concat());
    has_keys(&done, &["file", "pages", "steps", "submodels", "parts", "automatic_sections", "view_changes"]);
    has_keys(&done, &["shopping_list", "wanted_list", "unmapped_colors", "uncertain_parts", "warnings"]);
    assert_eq!((done["parts"].as_u64(), done["steps"].as_u64()), (Some(2), Some(2)));
    assert!(std::fs::read_to_string(&page).unwrap().contains("<svg class=\"page\""));
    assert!(std::fs::read_to_string(&csv).unwrap().contains("2,3001.dat"));
    assert!(std::fs::read_to_string(&xml).unwrap().contains("<MINQTY>2</MINQTY>"));
    failure(&["model", "instructions", text(&model), "-o", text(&dir.path().join("booklet.docx"))], 3);
    failure(&["model", "instructions", text(&model), "-o", text(&page), "--shopping-list", text(&page)], 3);
}

#[test]
fn the_stages_run_by_hand_on_the_built_in_model() {
    let dir = tempfile::tempdir().unwrap();
    let sequence = dir.path().join("seq");
    let seq = text(&sequence);

    let list = document(&["model", "parts", "list"]);
    assert!(list["built_in"].as_array().unwrap().iter().any(|brick| brick["part"] == "3001"));
    let brick = dir.path().join("brick.ldr");
    std::fs::write(&brick, "0 A brick\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n").unwrap();
    let built_in = document(&["model", "info", text(&brick), "--parts", "built-in"]);
    assert_eq!((built_in["parts"].as_u64(), built_in["missing"].as_array().unwrap().len()), (Some(1), 0));

    let info = document(&["model", "info", "demo"]);
    has_keys(&info, &["parts", "distinct_parts", "triangles", "steps", "mirrored_parts", "bbox_ldu", "bbox_mm"]);
    has_keys(&info, &["missing", "bom", "warnings"]);
    let check = document(&["model", "check", "demo"]);
    has_keys(&check, &["parts", "covered_parts", "connected", "stable", "collisions", "weakest", "build_order"]);
    assert_eq!(check["stable"], true);

    let simulated =
        ["capture", "simulate", "demo", "-o", seq, "--frames", "10", "--size", "480x360", "--quality", "draft"];
    document(&simulated);
    let keypoints = document(&["align", "keypoints", seq]);
    has_keys(&keypoints, &["world_from_object", "rms_px", "residuals", "covariance", "warnings"]);
    let truth = document(&["truth", seq]);
    assert_eq!(truth["frames"], 10);
    let mesh = dir.path().join("tsdf.ply");
    document(&["reconstruct", "tsdf", seq, "-o", text(&mesh)]);

    for protocol in ["mobilebrick-2023", "exact-1"] {
        let arguments =
            ["eval", "surface", "--gt", seq, "--pred", text(&mesh), "--protocol", protocol, "--points", "5000"];
        let scores = document(&arguments);
        has_keys(&scores, &["protocol", "sequence", "icp", "chamfer_mm", "pred_to_gt_mm", "gt_to_pred_mm"]);
        has_keys(&scores, &["thresholds", "seed", "seconds"]);
        has_keys(&scores["icp"], &["fitness", "applied"]);
        let thresholds = scores["thresholds"].as_array().unwrap();
        assert_eq!([&thresholds[0]["threshold_mm"], &thresholds[1]["threshold_mm"]], [2.5, 5.0]);
        has_keys(&thresholds[0], &["accuracy", "recall", "f1"]);
    }
    // The truth as a submission is perfect.
    let exact = sequence.join("mesh/visible_surface.ply");
    let perfect = document(&["eval", "surface", "--gt", seq, "--pred", text(&exact), "--protocol", "exact-1"]);
    assert_eq!(perfect["chamfer_mm"], 0.0);
    assert_eq!(perfect["thresholds"][0]["f1"], 1.0);

    let simulation = sequence.join("simulation");
    let poses = document(&["eval", "poses", "--gt", text(&simulation), "--pred", seq]);
    has_keys(&poses, &["frames", "pairwise", "object", "ate_rmse_mm"]);
    has_keys(&poses["pairwise"], &["translation_rmse_mm", "rotation_mean_deg"]);
    has_keys(&poses["object"], &["translation_rmse_mm", "rotation_mean_deg"]);
    let gt_depth = sequence.join("gt_depth");
    let depth = document(&["eval", "depth", "--gt", text(&gt_depth), "--pred", text(&gt_depth)]);
    has_keys(&depth, &["abs_rel", "sq_rel", "rmse_m", "rmse_log", "delta1", "delta2", "delta3", "valid_pixels"]);
    has_keys(&depth, &["per_image"]);
    assert_eq!(depth["rmse_m"], 0.0);
    let images = sequence.join("image");
    let views = document(&["eval", "views", "--gt", text(&images), "--pred", text(&images)]);
    has_keys(&views, &["images", "psnr", "ssim", "lpips", "per_image"]);
    assert_eq!(views["lpips"], Value::Null);
}

#[test]
fn the_published_scorers_list_of_two_predictions_is_scored_with_the_missing_one_named() {
    let Some(official) = mb_testdata::find("official_scorer") else { return };
    let dir = tempfile::tempdir().unwrap();
    let meshes = dir.path().join("meshes/mine");
    std::fs::create_dir_all(&meshes).unwrap();
    std::fs::copy(official.join("preds/half.ply"), meshes.join("wedge.ply")).unwrap();
    let list = dir.path().join("test_seqs.txt");
    std::fs::write(&list, "wedge,absent").unwrap();
    let out = dir.path().join("scores");
    let meshes = dir.path().join("meshes");
    let table = document(&[
        "eval",
        "surface",
        "--method",
        "mine",
        "--root",
        text(&official),
        "--list",
        text(&list),
        "--meshes",
        text(&meshes),
        "-o",
        text(&out),
        "--points",
        "20000",
    ]);
    assert_eq!(table["missing"][0]["sequence"], "absent");
    assert!(out.join("data.csv").exists() && out.join("scores.csv").exists());
}

/// The published scripts' folders and options, their rows, and what is made from the scores.
#[test]
fn a_folder_of_the_published_scripts_becomes_rows_tables_and_a_site() {
    let Some(official) = mb_testdata::find("official_scorer") else { return };
    let dir = tempfile::tempdir().unwrap();
    let meshes = dir.path().join("meshes/mine");
    std::fs::create_dir_all(&meshes).unwrap();
    std::fs::copy(official.join("preds/noise1mm.ply"), meshes.join("wedge.ply")).unwrap();
    std::fs::create_dir_all(dir.path().join("evaluations")).unwrap();
    std::fs::write(dir.path().join("evaluations/test_seqs.txt"), "wedge,absent,skipped").unwrap();
    let run = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_mobilebrick"));
        let output = command.current_dir(dir.path()).args(arguments).args(["--json", "-q"]).output().unwrap();
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let root = std::path::absolute(&official).unwrap();
    let scores =
        ["eval", "surface", "--method", "mine", "--gt_root", text(&root), "--skip", "skipped", "--n_pts", "5000"];
    assert_eq!(run(&scores)["missing"][0]["sequence"], "absent");
    let csv = std::fs::read_to_string(meshes.join("data.csv")).unwrap();
    assert!(csv.starts_with("wedge,absent\r\n"), "beside the meshes, as the script writes it: {csv}");
    assert_eq!(csv.lines().count(), 9);

    let views = dir.path().join("nvs/mine/wedge");
    std::fs::create_dir_all(&views).unwrap();
    for name in ["gt_000000.png", "render_000000.png"] {
        std::fs::copy(official.join("nvs").join(name), views.join(name)).unwrap();
    }
    assert_eq!(run(&["eval", "views", "--method", "mine"])["missing_sequences"][0], "absent");

    let tables = run(&["bench", "table", "meshes/mine", "nvs/mine", "-o", "tables"]);
    let rows = tables["tables"][0]["rows"].as_array().unwrap();
    assert_eq!(rows.last().unwrap()["method"], "mine");
    assert_eq!(tables["tables"][0]["impossible"][0]["method"], "BNV-Fusion");
    for file in ["surfaces.txt", "surfaces.csv", "surfaces.md", "surfaces.tex", "surfaces.html", "views.tex"] {
        assert!(dir.path().join("tables").join(file).exists(), "{file}");
    }
    let site = run(&["bench", "leaderboard", "meshes/mine", "nvs/mine", "-o", "site", "--no-pictures"]);
    assert_eq!(site["sequences"].as_array().unwrap().len(), 2);
    assert!(dir.path().join("site/sequences/wedge.html").exists());
    failure(&["bench", "table", text(&dir.path().join("nothing.json"))], 3);
}
