//! Published models against reference numbers that an independent flattener made.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::collections::BTreeMap;

use mb_bricks::{MeshOptions, Model, ModelInfo, PartLibrary};
use serde_json::Value;

fn read_json(name: &str) -> Option<Value> {
    let path = mb_testdata::find(&format!("ldraw/models/{name}"))?;
    Some(serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap())
}

fn library() -> Option<PartLibrary> {
    Some(PartLibrary::open(mb_testdata::find("ldraw/parts.zip")?).unwrap())
}

fn check_figures(name: &str, info: &ModelInfo, expected: &Value) {
    assert_eq!(info.parts as u64, expected["part_instances"], "{name}: parts");
    assert_eq!(info.distinct_parts as u64, expected["distinct_parts"], "{name}: distinct parts");
    assert_eq!(info.triangles as u64, expected["triangles_flat"], "{name}: triangles");
    assert_eq!(info.steps as u64, expected["step_lines"], "{name}: steps");
    assert_eq!(info.mirrored_parts as u64, expected["mirrored_instances"], "{name}: mirrored parts");
    let bounds = info.bbox_ldu.unwrap();
    for axis in 0..3 {
        for (found, key) in [(bounds.min, "bbox_min_ldu"), (bounds.max, "bbox_max_ldu")] {
            let wanted = expected[key][axis].as_f64().unwrap();
            assert!((found[axis] - wanted).abs() < 5.01e-4, "{name}: {key}[{axis}]: {} for {wanted}", found[axis]);
        }
    }
}

#[test]
fn nineteen_official_models_have_the_reference_figures() {
    let (Some(golden), Some(boms), Some(library)) = (read_json("golden.json"), read_json("golden-bom.json"), library())
    else {
        return;
    };
    let models = golden["models"].as_object().unwrap();
    assert_eq!(models.len(), 19);
    for (name, expected) in models {
        let path = mb_testdata::find(&format!("ldraw/models/{name}")).unwrap();
        let model = Model::read(path, Some(&library)).unwrap();
        let info = model.info();
        check_figures(name, &info, expected);
        assert_eq!(info.missing, [], "{name}");
        let bom: Vec<Value> =
            info.bom.iter().map(|line| serde_json::json!([line.part, line.color, line.count])).collect();
        let mut wanted = boms[name].as_array().unwrap().clone();
        wanted.sort_by_key(|line| {
            let color = line[1].as_str().unwrap();
            (line[0].as_str().unwrap().to_owned(), mb_bricks::ColorCode::parse(color))
        });
        assert_eq!(bom, wanted, "{name}");
        // A part that moved is told by what it is, not by where it went.
        let moved = info.bom.iter().find(|line| line.description.contains("Moved"));
        assert_eq!(moved, None, "{name}");
        let textured = expected["has_texmap"].as_bool().unwrap();
        assert_eq!(info.warnings.iter().any(|w| w.contains("texture 6342851a.png")), textured, "{name}");
    }
}

#[test]
fn damaged_models_show_what_is_left_and_name_what_is_not() {
    let (Some(golden), Some(library)) = (read_json("golden.json"), library()) else { return };
    for (name, expected) in golden["broken"].as_object().unwrap() {
        let path = mb_testdata::find(&format!("ldraw/models-broken/{name}")).unwrap();
        let model = Model::read(&path, Some(&library)).unwrap();
        let info = model.info();
        check_figures(name, &info, expected);
        let mut missing: BTreeMap<&str, u64> = BTreeMap::new();
        for m in &info.missing {
            assert_eq!(m.file, path.display().to_string());
            *missing.entry(&m.name).or_default() += 1;
        }
        assert_eq!(serde_json::json!(missing), expected["missing"], "{name}");
        let refusal = model.require_complete().unwrap_err().to_string();
        let first = &info.missing[0];
        assert!(refusal.contains(&first.name) && refusal.contains(&format!("line {}", first.line)), "{refusal}");
    }
    let read = |name: &str| {
        let path = mb_testdata::find(&format!("ldraw/models-broken/{name}")).unwrap();
        Model::read(path, Some(&library)).unwrap()
    };
    let retired = read("31018-1-highway-cruiser-missing-part.mpd");
    assert_eq!(retired.missing().iter().map(|m| m.line).collect::<Vec<_>>(), [186, 187]);
    let truncated = read("7181-1-tie-interceptor-truncated.mpd");
    let malformed: Vec<_> = truncated.warnings().iter().filter(|w| w.contains("skipped")).collect();
    assert_eq!(malformed.len(), 1, "{malformed:?}");
}

#[test]
fn meshes_agree_with_the_figures_and_copies_need_no_library() {
    let Some(library) = library() else { return };
    let folder = tempfile::tempdir().unwrap();
    for name in ["1180-1-moon-buggy", "21019-1-eiffel-tower", "40448-1-vintage-car"] {
        let path = mb_testdata::find(&format!("ldraw/models/{name}.mpd")).unwrap();
        let model = Model::read(path, Some(&library)).unwrap();
        let (info, mesh) = (model.info(), model.mesh(&MeshOptions::default()));
        assert_eq!(mesh.triangles.len(), info.triangles);
        let (bounds, bbox_mm) = (mesh.bounds(), info.bbox_mm.unwrap());
        for axis in 0..3 {
            assert!((bounds.min[axis] * 1e3 - bbox_mm.min[axis]).abs() < 1e-9);
            assert!((bounds.max[axis] * 1e3 - bbox_mm.max[axis]).abs() < 1e-9);
        }
        let copy_path = folder.path().join(format!("{name}.mpd"));
        model.write_self_contained(&copy_path).unwrap();
        let copy = Model::read(&copy_path, None).unwrap();
        assert_eq!(copy.missing(), []);
        assert_eq!(copy.bom(), info.bom);
        assert_eq!(copy.info().steps, info.steps);
        assert_eq!(copy.mesh(&MeshOptions::default()), mesh, "{name}");
    }
}
