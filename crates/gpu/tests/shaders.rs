//! Every shader is valid, whatever this machine has: no device is asked.

use mb_gpu::shaders::SOURCES;
use naga::valid::{Capabilities, ValidationFlags, Validator};

#[test]
fn every_shader_is_valid_and_every_entry_point_has_the_same_workgroup() {
    let mut entry_points = 0;
    for (shown, source) in SOURCES {
        let module = naga::front::wgsl::parse_str(source)
            .unwrap_or_else(|e| panic!("{shown}: {}", e.emit_to_string_with_path(source, shown)));
        Validator::new(ValidationFlags::all(), Capabilities::IMMEDIATES)
            .validate(&module)
            .unwrap_or_else(|e| panic!("{shown}: {}", e.emit_to_string_with_path(source, shown)));
        // `Context` asks a device for so many.
        let storage = |space| matches!(space, naga::AddressSpace::Storage { .. });
        assert!(module.global_variables.iter().filter(|(_, v)| storage(v.space)).count() <= 15, "{shown}");
        for entry in &module.entry_points {
            assert_eq!(entry.workgroup_size, [64, 1, 1], "{shown}: {}", entry.name);
            entry_points += 1;
        }
    }
    assert!(entry_points > 10);
}

#[test]
fn every_file_is_a_shader_or_stands_before_one() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/kernels");
    for file in std::fs::read_dir(folder).expect("the shaders") {
        let path = file.expect("a file").path();
        let text = std::fs::read_to_string(&path).expect("text");
        assert!(SOURCES.iter().any(|(_, source)| source.contains(&text)), "{} is not used", path.display());
    }
}
