//! The built-in model.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use mb_bricks::{MeshOptions, Model, demo_model};

#[test]
fn the_castle_is_complete_and_fits_on_a_table() {
    let model = demo_model();
    let info = model.info();
    assert_eq!(info.missing, []);
    assert_eq!(info.warnings, Vec::<String>::new());
    assert!((60..=120).contains(&info.parts), "{} parts", info.parts);
    assert!(info.steps > 20);
    let size = model.mesh(&MeshOptions::default()).bounds().extent();
    assert!(size.iter().all(|&metres| (0.08..0.2).contains(&metres)), "{size}");
}

#[test]
fn the_castle_survives_its_own_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("castle.ldr");
    let model = demo_model();
    for text in [model.to_ldraw(), model.to_self_contained()] {
        std::fs::write(&path, text).unwrap();
        let copy = Model::read(&path, None).unwrap();
        assert_eq!(copy.bom(), model.bom());
        assert_eq!(copy.mesh(&MeshOptions::default()), model.mesh(&MeshOptions::default()));
    }
}
