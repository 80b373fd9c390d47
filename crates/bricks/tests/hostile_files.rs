//! Damaged and malicious files: a clear refusal or a bounded warning, never a panic.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use mb_bricks::{MeshOptions, Model, PartLibrary};
use mb_job::{Error, InputError};
use proptest::prelude::*;
use zip::write::SimpleFileOptions;

const PLACED: &str = "0 0 0 1 0 0 0 1 0 0 0 1";

fn refused(text: &str) -> InputError {
    match Model::from_text(text, "model.ldr", None) {
        Err(Error::Input(input)) => input,
        Err(other) => panic!("not a refusal of the input: {other}"),
        Ok(model) => panic!("accepted, with {} parts", model.instances().len()),
    }
}

#[track_caller]
fn check_refusal(text: &str, place: &str, found: &str) {
    let input = refused(text);
    assert_eq!(input.place.as_deref(), Some(place), "{input}");
    assert!(input.found.contains(found), "{input}");
    assert!(input.help.is_some(), "{input}");
}

#[test]
fn files_that_contain_themselves_are_refused() {
    check_refusal(&format!("0 FILE a.ldr\n1 4 {PLACED} A.LDR\n"), "line 2", "refers to itself");
    let ring = format!("0 FILE a.ldr\n1 4 {PLACED} b.ldr\n0 FILE b.ldr\n1 4 {PLACED} a.ldr\n");
    check_refusal(&ring, "line 4", "contains itself (a.ldr -> b.ldr -> ...)");
}

#[test]
fn numbers_that_are_none_are_refused() {
    check_refusal("0 x\n1 4 NaN 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n", "line 2", "not finite");
    check_refusal("3 4 0 0 0 1 0 0 0 inf 0\n", "line 1", "not finite");
    check_refusal("1 4 0 0 1e300 1 0 0 0 1 0 0 0 1 3001.dat\n", "line 1", "absurdly large");
    check_refusal("1 4 0 0 0 1 0 0 2 0 0 0 0 1 3001.dat\n", "line 1", "singular");
    // Each line is modest; what they place together is not.
    let mut text = String::new();
    for level in 0..60 {
        let _ = writeln!(text, "0 FILE {level}.ldr\n1 4 0 0 1 1e8 0 0 0 1e8 0 0 0 1e8 {}.ldr", level + 1);
    }
    let _ = writeln!(text, "0 FILE 60.ldr\n1 4 {PLACED} 3005.dat");
    assert!(refused(&text).found.contains("infinitely far"));
}

#[test]
fn nesting_and_multiplying_files_are_refused() {
    let mut deep = String::new();
    for level in 0..10_000 {
        let _ = writeln!(deep, "0 FILE {level}.ldr\n1 4 {PLACED} {}.ldr", level + 1);
    }
    assert!(refused(&deep).found.contains("deep"));
    let mut bomb = String::new();
    for level in 0..100 {
        let line = format!("1 4 {PLACED} {}.ldr\n", level + 1);
        let _ = writeln!(bomb, "0 FILE {level}.ldr\n{line}{line}");
    }
    let _ = writeln!(bomb, "0 FILE 100.ldr\n1 4 {PLACED} 3005.dat");
    assert!(refused(&bomb).found.contains("passes"));
    // References that lead nowhere multiply too.
    assert!(refused(&bomb.replace("3005.dat", "nowhere.dat")).found.contains("passes"));
}

#[test]
fn what_is_no_model_is_refused() {
    check_refusal(&format!("0 x\n1 4 {PLACED} {}\n", "a".repeat(200_000)), "line 2", "bytes long");
    let folder = tempfile::tempdir().unwrap();
    let read = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        Model::read(&path, None).unwrap_err().to_string()
    };
    assert!(read("picture.ldr", b"\x89PNG\r\n\x1a\n\0\0\0").contains("not a text file"));
    assert!(read("empty.ldr", b"").contains("no part"));
    assert!(read("comments.ldr", b"0 A model\n0 STEP\n").contains("no part"));
    assert!(read("prose.txt", b"Dear all,\nplease find the model attached.\n").contains("no part"));
    assert!(read("wide.ldr", b"\xff\xfe0\0 \0").contains("UTF-16"));
    assert!(Model::read(folder.path().join("absent.ldr"), None).unwrap_err().to_string().contains("no such file"));
}

#[test]
fn careless_files_are_read_with_warnings() {
    let text = format!(
        "\u{feff}0 FILE Main Model.ldr \r\n1 4 {PLACED} SUB Model.LDR  \r\n1 4 {PLACED}\r\n1 4 {PLACED}  \r\n7 what\r\n\
         1 99999 {PLACED} 3001.DAT\r\n0 FILE sub model.ldr\r\n1 16 {PLACED} 3005.dat\r\n0 FILE sub model.ldr\r\n"
    );
    let model = Model::from_text(&text, "model.mpd", None).unwrap();
    assert_eq!(model.instances().len(), 2);
    let warnings = model.warnings().join("\n");
    for expected in [
        "line 3: the reference names no file",
        "line 5: it begins with no line type",
        "line 6: colour 99999",
        "defined twice",
    ] {
        assert!(warnings.contains(expected), "{expected} in\n{warnings}");
    }
    // Colour 16 below a coloured submodel takes its colour.
    assert_eq!(model.bom()[1].color, "4");
}

#[test]
fn warnings_are_bounded() {
    let text = format!("1 4 {PLACED} 3001.dat\n{}", "9 9\n".repeat(5000));
    let warnings = Model::from_text(&text, "model.ldr", None).unwrap().warnings().to_vec();
    assert!(warnings.len() < 30);
    assert!(warnings.last().unwrap().contains("4980 more"));
}

fn zip_of(path: &Path, entries: &[(&str, &[u8])]) -> PathBuf {
    let mut zip = zip::ZipWriter::new(std::fs::File::create(path).unwrap());
    for (name, bytes) in entries {
        zip.start_file(*name, SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap();
    path.to_owned()
}

#[test]
fn studio_files_are_read_and_bad_ones_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.io");
    let own_part = "0 Own\n0 BFC CERTIFY CCW\n3 16 0 0 0 0 0 1 1 0 0\n";
    let model = format!("0 Model\n1 4 {PLACED} 3001.dat\n1 2 {PLACED} own.dat\n");
    zip_of(&path, &[("model.ldr", model.as_bytes()), ("CustomParts/parts/own.dat", own_part.as_bytes())]);
    let read = Model::read(&path, None).unwrap();
    assert_eq!((read.instances().len(), read.missing().len()), (2, 0));

    let refused = |entries: &[(&str, &[u8])]| Model::read(zip_of(&path, entries), None).unwrap_err().to_string();
    assert!(refused(&[("readme.txt", b"hello")]).contains("no model.ldr"));
    assert!(refused(&[("../../model.ldr", b"0")]).contains("outside the archive"));
    assert!(refused(&[("model.ldr", &vec![b'0'; 50 << 20])]).contains("zip bomb"));

    // An encrypted entry: the flag in the local and the central header (Studio before late 2023).
    let mut bytes = std::fs::read(zip_of(&path, &[("model.ldr", model.as_bytes())])).unwrap();
    let central = bytes.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    bytes[6] |= 1;
    bytes[central + 8] |= 1;
    std::fs::write(&path, &bytes).unwrap();
    let message = Model::read(&path, None).unwrap_err().to_string();
    assert!(message.contains("encrypted") && message.contains("save it again"), "{message}");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert!(Model::read(&path, None).unwrap_err().to_string().contains("no readable zip"));
}

#[test]
fn an_entry_whose_own_header_is_damaged_is_refused_with_advice() {
    // The directory at the end is whole; the header before the entry's bytes is not.
    let folder = tempfile::tempdir().unwrap();
    let model = format!("0 Model\n1 4 {PLACED} 3001.dat\n");
    let path = zip_of(&folder.path().join("model.io"), &[("readme.txt", b"hello"), ("model.ldr", model.as_bytes())]);
    let mut bytes = std::fs::read(&path).unwrap();
    let second = bytes.windows(4).skip(1).position(|w| w == b"PK\x03\x04").unwrap() + 1;
    bytes[second] ^= 0xff;
    std::fs::write(&path, &bytes).unwrap();
    let message = Model::read(&path, None).unwrap_err().to_string();
    assert!(message.contains("entry model.ldr") && message.contains("damaged"), "{message}");
}

#[test]
fn a_line_of_ten_megabytes_is_refused_in_few_words() {
    let text = format!("1 4 {PLACED} 3001.dat\n{}\n", "7".repeat(10 << 20));
    let refusal = Model::from_text(&text, "model.ldr", None).unwrap_err().to_string();
    assert!(refusal.contains("line 2") && refusal.contains("10485761 bytes") && refusal.len() < 500, "{refusal}");
}

#[test]
fn libraries_are_found_as_folder_and_as_zip() {
    let folder = tempfile::tempdir().unwrap();
    let part = b"0 Part\n0 BFC CERTIFY CCW\n1 16 0 0 0 1 0 0 0 1 0 0 0 1 s\\piece.dat\n";
    let piece = b"0 ~Piece\n0 BFC CERTIFY CCW\n4 16 0 0 0 0 0 1 1 0 1 1 0 0\n";
    std::fs::create_dir_all(folder.path().join("ldraw/parts/S")).unwrap();
    std::fs::write(folder.path().join("ldraw/parts/Odd.DAT"), part).unwrap();
    std::fs::write(folder.path().join("ldraw/parts/S/PIECE.dat"), piece).unwrap();
    let zip = zip_of(
        &folder.path().join("complete.zip"),
        &[
            ("ldraw/parts/odd.dat", part),
            ("ldraw/parts/s/piece.dat", piece),
            ("ldraw/LDConfig.ldr", b"0 !COLOUR Odd_Blue CODE 777 VALUE #0000FF EDGE #000000\n"),
        ],
    );
    for path in [folder.path().to_owned(), folder.path().join("ldraw"), zip] {
        let library = PartLibrary::open(&path).unwrap();
        assert_eq!(library.part_names(), ["odd.dat"]);
        let model = Model::from_text(&format!("1 777 {PLACED} ODD.dat\n"), "m.ldr", Some(&library)).unwrap();
        assert_eq!((model.missing().len(), model.info().triangles), (0, 2));
        let color = model.mesh(&MeshOptions::default()).triangle_colors.unwrap()[0];
        assert_eq!(color == [0, 0, 255], path.extension().is_some());
    }
    let refused = |path: &Path| PartLibrary::open(path).err().unwrap().to_string();
    assert!(refused(&folder.path().join("absent")).contains("no such"));
    assert!(refused(&folder.path().join("ldraw/parts/S")).contains("no parts"));
    let escape = zip_of(&folder.path().join("escape.zip"), &[("/etc/parts/a.dat", part)]);
    assert!(refused(&escape).contains("outside the archive"));
}

/// Lines that look like LDraw, with a taste for trouble.
fn odd_line() -> impl Strategy<Value = String> {
    let number = prop_oneof![
        "-?[0-9]{1,3}(\\.[0-9]{1,3})?",
        Just("1e9".into()),
        Just("-0".into()),
        Just("NaN".into()),
        Just("x".into())
    ];
    let name =
        prop_oneof![Just("3001.dat"), Just("A.ldr"), Just("b.LDR"), Just("s\\b.ldr"), Just(" "), Just("../x.dat")];
    let placed = (prop::collection::vec(number.clone(), 10..13), name.clone())
        .prop_map(|(numbers, name)| format!("1 16 {} {name}", numbers.join(" ")));
    let identity = name.clone().prop_map(|name| format!("1 4 {PLACED} {name}"));
    let polygon =
        (2..6_u8, prop::collection::vec(number, 5..13)).prop_map(|(kind, n)| format!("{kind} 16 {}", n.join(" ")));
    let meta = prop_oneof![
        "0 FILE [ab]\\.ldr",
        "0 BFC (CERTIFY|NOCERTIFY|CW|CCW|INVERTNEXT|CLIP|NOCLIP)( CW)?",
        Just("0 STEP".into()),
        Just("0 NOFILE".into()),
        "0 !TEXMAP (START|NEXT|FALLBACK|END).{0,9}",
        Just("0 ROTSTEP 1 2 ABS".into()),
        "0 !COLOUR [a-z]{1,3} CODE [0-9]{1,2} VALUE #[0-9A-F]{4,6}",
        "0 !LDRAW_ORG (Part|Model|Unofficial_Subpart)",
        "\\PC{0,20}"
    ];
    prop_oneof![placed, identity, polygon, meta]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn no_text_panics(lines in prop::collection::vec(odd_line(), 0..30), newline in prop_oneof![Just("\n"), Just("\r\n")]) {
        if let Ok(model) = Model::from_text(&lines.join(newline), "fuzz.mpd", None) {
            let (info, mesh) = (model.info(), model.mesh(&MeshOptions { clearance_mm: 0.1 }));
            prop_assert_eq!(info.triangles, mesh.triangles.len());
            prop_assert_eq!(info.bom.iter().map(|line| line.count).sum::<usize>(), info.parts);
        }
    }

    #[test]
    fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..400), zipped in any::<bool>()) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fuzz.io");
        let mut file = if zipped { std::fs::read(zip_of(&path, &[("model.ldr", &bytes)])).unwrap() } else { bytes.clone() };
        for (index, byte) in bytes.iter().enumerate().take(3) {
            // Bit rot in the archive.
            let at = usize::from(*byte) * (index + 1) % file.len().max(1);
            if let Some(rotten) = file.get_mut(at) {
                *rotten ^= 1 << (byte % 8);
            }
        }
        std::fs::write(&path, &file).unwrap();
        let _ = Model::read(&path, None);
        let _ = PartLibrary::open(&path);
    }
}
