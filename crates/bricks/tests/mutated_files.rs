//! Valid files with faults put in: the readers of LDraw text and of Studio archives never panic, never run away, and
//! what they accept can be measured, meshed, checked and written again.
//!
//! `PROPTEST_CASES=200000 cargo test -p mb-bricks --test mutated_files` looks longer.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use std::io::Write as _;

use mb_bricks::{CheckOptions, MeshOptions, Model, PartLibrary};
use mb_job::Error;
use proptest::prelude::*;
use zip::write::SimpleFileOptions;

/// Models that between them use every kind of line.
const SEEDS: [&str; 4] = [
    "0 FILE main.ldr\r\n0 Main\r\n0 Name: main.ldr\r\n0 !LDRAW_ORG Unofficial_Model\r\n0 ROTATION CENTER 0 0 0 1\r\n\
     1 4 0 0 0 1 0 0 0 1 0 0 0 1 sub model.ldr\r\n1 16 40 -24 0 0 0 -1 0 1 0 1 0 0 sub model.ldr\r\n0 STEP\r\n\
     1 0x2FF8800 0 -48 0 1 0 0 0 1 0 0 0 1 3001.dat\r\n0 ROTSTEP 30 45 0 REL\r\n0 NOFILE\r\n\
     0 FILE sub model.ldr\r\n0 Sub\r\n1 16 0 0 0 1 0 0 0 1 0 0 0 1 3003.DAT\r\n0 STEP\r\n\
     1 15 0 -24 0 1 0 0 0 1 0 0 0 1 s\\own.dat\r\n0 NOFILE\r\n\
     0 FILE s\\own.dat\r\n0 ~Own\r\n0 !LDRAW_ORG Unofficial_Subpart\r\n0 BFC CERTIFY CCW\r\n0 BFC INVERTNEXT\r\n\
     1 16 0 0 0 4 0 0 0 8 0 0 0 4 4-4cyli.dat\r\n3 16 0 0 0 0 0 1 1 0 0\r\n4 16 0 0 0 0 0 1 1 0 1 1 0 0\r\n\
     2 24 0 0 0 1 0 0\r\n5 24 0 0 0 1 0 0 0 0 1 0 1 0\r\n0 NOFILE\r\n",
    "0 A tower\n1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat\n0 STEP\n1 15 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n\
     1 14 20 -48 0 0 0 1 0 1 0 -1 0 0 3039.dat\n1 2 0 -72 0 1 0 0 0 1 0 0 0 1 nowhere.dat\n",
    "0 Textured\n0 BFC CERTIFY CCW\n0 !COLOUR Odd CODE 900 VALUE #102030 EDGE #405060 ALPHA 128 LUMINANCE 5 MATERIAL \
     GLITTER VALUE #FF00FF FRACTION 0.2\n0 !TEXMAP START PLANAR 0 0 0 1 0 0 0 1 0 a.png GLOSSMAP b.png\n\
     0 !: 4 900 0 0 0 0 0 9 9 0 9 9 0 0\n0 !TEXMAP FALLBACK\n4 900 0 0 0 0 0 9 9 0 9 9 0 0\n0 !TEXMAP END\n\
     0 BFC NOCLIP\n3 900 0 0 0 0 0 9 9 0 9\n0 BFC CLIP CW\n3 24 0 0 0 0 0 9 9 0 9\n0 BUFEXCHG A STORE\n0 WRITE hi\n",
    "0 FILE a.ldr\n1 1 0 0 0 1 0 0 0 1 0 0 0 1 b.ldr\n0 FILE b.ldr\n1 2 0 0 0 1 0 0 0 1 0 0 0 1 c.ldr\n\
     1 2 0 0 80 1 0 0 0 1 0 0 0 1 c.ldr\n0 FILE c.ldr\n1 3 0 0 0 -1 0 0 0 1 0 0 0 1 3005.dat\n\
     0 !DATA picture.png\n0 !: aGVsbG8=\n",
];

/// Words with which something is often wrong.
const WORDS: [&str; 18] = [
    "NaN",
    "inf",
    "-0",
    "1e308",
    "1e-320",
    "1e9",
    "-1e9",
    "0",
    "16",
    "24",
    "0x2000000",
    "4294967296",
    "main.ldr",
    "sub model.ldr",
    "a.ldr",
    "..\\..\\x.dat",
    "4-4cyli.dat",
    "\u{feff}",
];

/// A fault to put in; numbers are taken modulo whatever they choose from.
#[derive(Debug, Clone)]
enum Fault {
    FlipBit(usize, u8),
    Delete(usize, usize),
    Repeat(usize, usize, usize),
    Insert(usize, Vec<u8>),
    Truncate(usize),
    /// Replaces the n-th word.
    Word(usize, usize),
    SwapLines(usize, usize),
    /// Copies a line to another place.
    CopyLine(usize, usize),
}

fn fault() -> impl Strategy<Value = Fault> {
    let at = || 0..10_000_usize;
    prop_oneof![
        2 => (at(), 0..8_u8).prop_map(|(at, bit)| Fault::FlipBit(at, bit)),
        1 => (at(), 1..60_usize).prop_map(|(at, length)| Fault::Delete(at, length)),
        1 => (at(), 1..200_usize, 1..40_usize).prop_map(|(at, length, times)| Fault::Repeat(at, length, times)),
        1 => (at(), prop::collection::vec(any::<u8>(), 1..20)).prop_map(|(at, bytes)| Fault::Insert(at, bytes)),
        1 => at().prop_map(Fault::Truncate),
        6 => (at(), 0..WORDS.len()).prop_map(|(at, word)| Fault::Word(at, word)),
        2 => (at(), at()).prop_map(|(a, b)| Fault::SwapLines(a, b)),
        3 => (at(), at()).prop_map(|(from, to)| Fault::CopyLine(from, to)),
    ]
}

impl Fault {
    fn apply(&self, bytes: &mut Vec<u8>) {
        let length = bytes.len();
        if length == 0 {
            return;
        }
        match self {
            Self::FlipBit(at, bit) => bytes[at % length] ^= 1 << bit,
            Self::Delete(at, count) => {
                let at = at % length;
                bytes.drain(at..(at + count).min(length));
            }
            Self::Repeat(at, count, times) => {
                let at = at % length;
                let piece = bytes[at..(at + count).min(length)].to_vec();
                let many = piece.repeat(*times);
                bytes.splice(at..at, many);
            }
            Self::Insert(at, new) => {
                let at = at % length;
                bytes.splice(at..at, new.iter().copied());
            }
            Self::Truncate(at) => bytes.truncate(at % length),
            Self::Word(index, word) => {
                let starts: Vec<usize> = (0..length)
                    .filter(|&i| !bytes[i].is_ascii_whitespace() && (i == 0 || bytes[i - 1].is_ascii_whitespace()))
                    .collect();
                if let Some(&start) = starts.get(index % starts.len().max(1)) {
                    let end = (start..length).find(|&i| bytes[i].is_ascii_whitespace()).unwrap_or(length);
                    bytes.splice(start..end, WORDS[*word].bytes());
                }
            }
            Self::SwapLines(a, b) => {
                let mut lines: Vec<Vec<u8>> = bytes.split_inclusive(|&b| b == b'\n').map(<[u8]>::to_vec).collect();
                let count = lines.len();
                lines.swap(a % count, b % count);
                *bytes = lines.concat();
            }
            Self::CopyLine(from, to) => {
                let mut lines: Vec<Vec<u8>> = bytes.split_inclusive(|&b| b == b'\n').map(<[u8]>::to_vec).collect();
                let line = lines[from % lines.len()].clone();
                let to = to % lines.len();
                lines.insert(to, line);
                *bytes = lines.concat();
            }
        }
    }
}

/// Everything that can be asked of a model that was accepted.
fn use_model(model: &Model) {
    let info = model.info();
    let mesh = model.mesh(&MeshOptions { clearance_mm: 0.1 });
    assert_eq!(info.triangles, mesh.triangles.len());
    assert_eq!(info.bom.iter().map(|line| line.count).sum::<usize>(), info.parts);
    assert!(mesh.vertices.iter().all(|p| p.iter().all(|v| v.is_finite())));
    let copy = Model::from_text(&model.to_self_contained(), "copy.mpd", None).unwrap();
    assert_eq!(copy.info().triangles, info.triangles);
    if info.parts <= 60 {
        match model.check(&CheckOptions::default()) {
            Ok(report) => assert_eq!(report.build_order.len(), info.parts),
            Err(Error::Input(_)) => assert!(!info.missing.is_empty()),
            Err(other) => panic!("{other}"),
        }
    }
}

fn read_bytes(bytes: &[u8], name: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    match Model::read(&path, None) {
        Ok(model) => use_model(&model),
        Err(Error::Input(input)) => {
            assert!(!input.found.is_empty() && input.help.is_some(), "{input}");
            assert!(input.to_string().len() < 2000, "a long message: {input}");
        }
        Err(other) => panic!("not a refusal of the input: {other}"),
    }
    // The same bytes in the place of a parts library.
    let _ = PartLibrary::open(&path);
}

fn zipped(entries: &[(&str, &[u8])], store: bool) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(vec![]));
    let method = if store { zip::CompressionMethod::Stored } else { zip::CompressionMethod::Deflated };
    for (name, bytes) in entries {
        zip.start_file(*name, SimpleFileOptions::default().compression_method(method)).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: ProptestConfig::default().cases.max(600), ..ProptestConfig::default() })]

    #[test]
    fn faulty_text_is_refused_or_usable(seed in 0..SEEDS.len(), faults in prop::collection::vec(fault(), 1..8)) {
        let mut bytes = SEEDS[seed].as_bytes().to_vec();
        faults.iter().for_each(|fault| fault.apply(&mut bytes));
        read_bytes(&bytes, "faulty.mpd");
    }

    #[test]
    fn faulty_archives_are_refused_or_usable(
        seed in 0..SEEDS.len(),
        inside in prop::collection::vec(fault(), 0..4),
        outside in prop::collection::vec(fault(), 0..4),
        store in any::<bool>(),
        name in prop_oneof![Just("model.ldr"), Just("Model2.LDR"), Just("model.ldr.txt"), Just("a/../model.ldr")],
    ) {
        let mut model = SEEDS[seed].as_bytes().to_vec();
        inside.iter().for_each(|fault| fault.apply(&mut model));
        let own = b"0 Own\n0 BFC CERTIFY CCW\n3 16 0 0 0 0 0 1 1 0 0\n";
        let mut bytes = zipped(
            &[(".info", b"{}"), (name, &model), ("CustomParts/parts/own.dat", own), ("thumbnail.png", b"\x89PNG")],
            store,
        );
        outside.iter().for_each(|fault| fault.apply(&mut bytes));
        read_bytes(&bytes, "faulty.io");
    }
}
