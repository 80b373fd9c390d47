//! Downloads from a local server that behaves, and from ones that do not.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

mod common;

use std::io::{Cursor, Write as _};
use std::path::Path;
use std::time::Duration;

use common::{Faults, TestServer};
use mb_download::{DownloadOptions, DownloadSummary, Patience, download};
use mb_job::{Error, Progress, Result, Silent};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Bytes that do not compress.
fn noise(seed: u64, count: usize) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    std::iter::repeat_with(|| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 32) as u8
    })
    .take(count)
    .collect()
}

/// Paths and contents of a small data set.
fn data_set() -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    for (i, sequence) in ["test/aston", "test/bridge", "train/random_1"].iter().enumerate() {
        for frame in 0..4 {
            let bytes = noise((10 * i + frame) as u64, 300_000);
            files.push((format!("MobileBrick/{sequence}/image/{frame:06}.jpg"), bytes));
        }
        files.push((
            format!("MobileBrick/{sequence}/mesh/gt_mesh.ply"),
            format!("ply {sequence}\n").repeat(5000).into(),
        ));
        files.push((format!("MobileBrick/{sequence}/pose/000000.txt"), Vec::new()));
    }
    files
}

fn zipped(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (i, (name, bytes)) in files.iter().enumerate() {
        // Photographs are stored, the rest is deflated; every other member has the sizes of zip64.
        let method = if name.ends_with(".jpg") { CompressionMethod::Stored } else { CompressionMethod::Deflated };
        zip.start_file(name, SimpleFileOptions::default().compression_method(method).large_file(i % 2 == 0)).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn options(url: &str, parts: &[&str]) -> DownloadOptions {
    let patience = Patience { silence: Duration::from_millis(700), attempts: 4, pause: Duration::from_millis(5) };
    DownloadOptions { url: url.to_owned(), parts: parts.iter().map(|p| (*p).to_owned()).collect(), patience }
}

fn fetch(server: &TestServer, out: &Path, parts: &[&str]) -> Result<DownloadSummary> {
    download(out, &options(&server.url, parts), &Silent)
}

/// Whether exactly the files that `wanted` picks are there, byte for byte.
fn assert_has(out: &Path, files: &[(String, Vec<u8>)], wanted: impl Fn(&str) -> bool) {
    for (name, bytes) in files {
        let path = out.join(name);
        assert_eq!(path.exists(), wanted(name), "{name}");
        if wanted(name) {
            assert!(std::fs::read(&path).unwrap() == *bytes, "{name} differs");
        }
    }
}

fn message(result: Result<DownloadSummary>) -> String {
    result.unwrap_err().to_string()
}

#[test]
fn one_sequence_or_only_meshes_come_without_the_rest() {
    let files = data_set();
    let archive = zipped(&files);
    let whole = archive.len() as u64;
    for (parts, wanted) in [
        (vec!["aston"], "test/aston/"),
        (vec!["mesh"], "/mesh/"),
        (vec!["bridge/mesh"], "test/bridge/mesh/"),
        (vec!["test"], "/test/"),
        (vec![], ""),
    ] {
        let server = TestServer::start(archive.clone(), Faults::default());
        let dir = tempfile::tempdir().unwrap();
        let summary = fetch(&server, dir.path(), &parts).unwrap();
        assert_has(dir.path(), &files, |name| name.contains(wanted));
        assert!(summary.ranges && summary.archive.is_none() && summary.files_kept == 0);
        assert_eq!(summary.files_written, files.iter().filter(|f| f.0.contains(wanted)).count());
        if parts == ["mesh"] {
            // Each jump costs at most a first window, and there are three sequences.
            assert!(server.sent() < whole / 2, "{} of {whole} bytes for the meshes", server.sent());
        }
    }
}

#[test]
fn a_second_run_fetches_only_what_is_missing_or_damaged() {
    let files = data_set();
    let server = TestServer::start(zipped(&files), Faults::default());
    let dir = tempfile::tempdir().unwrap();
    fetch(&server, dir.path(), &["aston"]).unwrap();
    let damaged = dir.path().join("MobileBrick/test/aston/image/000001.jpg");
    let mut bytes = std::fs::read(&damaged).unwrap();
    bytes[1000] ^= 1;
    std::fs::write(&damaged, &bytes).unwrap();
    std::fs::remove_file(dir.path().join("MobileBrick/test/aston/image/000003.jpg")).unwrap();
    let summary = fetch(&server, dir.path(), &["aston"]).unwrap();
    assert_eq!((summary.files, summary.files_written, summary.files_kept), (6, 2, 4));
    assert_has(dir.path(), &files, |name| name.contains("aston"));
}

#[test]
fn cut_silent_refused_and_short_answers_are_asked_for_again() {
    let files = data_set();
    let archive = zipped(&files);
    let faulty = [
        Faults { cuts: 3, ..Faults::default() },
        Faults { silences: 2, ..Faults::default() },
        Faults { wrong_lengths: 3, ..Faults::default() },
        Faults { refusals: 3, ..Faults::default() },
        Faults { cuts: 2, refusals: 2, wrong_lengths: 2, ..Faults::default() },
    ];
    for faults in faulty {
        for ignores_ranges in [false, true] {
            let server = TestServer::start(archive.clone(), Faults { ignores_ranges, ..faults.clone() });
            let dir = tempfile::tempdir().unwrap();
            let summary = fetch(&server, dir.path(), &["train"]);
            let summary = summary.unwrap_or_else(|e| panic!("{faults:?}, ignores_ranges {ignores_ranges}: {e}"));
            assert_has(dir.path(), &files, |name| name.contains("train"));
            assert_eq!((summary.ranges, summary.archive.is_some()), (!ignores_ranges, ignores_ranges));
        }
    }
}

#[test]
fn a_cut_connection_goes_on_at_the_byte_that_is_due() {
    let files = data_set();
    let archive = zipped(&files);
    let whole = archive.len() as u64;
    let server = TestServer::start(archive, Faults { cuts: 3, ..Faults::default() });
    let dir = tempfile::tempdir().unwrap();
    fetch(&server, dir.path(), &[]).unwrap();
    // What was received is not asked for again: little more than the archive and its index.
    assert!(server.sent() < whole + whole / 5, "{} bytes sent for {whole}", server.sent());
}

#[test]
fn a_server_without_ranges_sends_the_archive_once() {
    let files = data_set();
    let archive = zipped(&files);
    let server = TestServer::start(archive.clone(), Faults { ignores_ranges: true, ..Faults::default() });
    let dir = tempfile::tempdir().unwrap();
    fetch(&server, dir.path(), &["aston"]).unwrap();
    let kept = dir.path().join("set.zip");
    assert_eq!(std::fs::read(&kept).unwrap(), archive);
    // The second run needs no more than the head of an answer. What the server puts into its socket does not tell: the kernel
    // takes megabytes before anyone reads.
    server.misbehave(Faults { ignores_ranges: true, mute: true, ..Faults::default() });
    let summary = fetch(&server, dir.path(), &["mesh"]).unwrap();
    assert_eq!((summary.files_written, summary.files_kept), (2, 1));
    // The archive itself can be named as the source.
    let again = tempfile::tempdir().unwrap();
    download(again.path(), &options(kept.to_str().unwrap(), &["bridge"]), &Silent).unwrap();
    assert_has(again.path(), &files, |name| name.contains("bridge"));
}

#[test]
fn a_byte_that_is_wrong_once_is_fetched_again_and_one_that_stays_wrong_is_named() {
    let files = data_set();
    let archive = zipped(&files);
    // A byte within the second photograph.
    let place = archive.windows(64).position(|w| w == &files[1].1[5000..5064]).unwrap();
    let server = TestServer::start(archive.clone(), Faults { corrupts: Some((place, 1)), ..Faults::default() });
    let dir = tempfile::tempdir().unwrap();
    fetch(&server, dir.path(), &["aston"]).unwrap();
    assert_has(dir.path(), &files, |name| name.contains("aston"));

    let server = TestServer::start(archive, Faults { corrupts: Some((place, usize::MAX)), ..Faults::default() });
    let dir = tempfile::tempdir().unwrap();
    let result = fetch(&server, dir.path(), &["aston"]);
    assert!(matches!(result, Err(Error::Input(_))));
    let message = message(result);
    assert!(message.contains("aston/image/000001.jpg") && message.contains("damaged, 3 times"), "{message}");
    assert!(!dir.path().join("MobileBrick/test/aston/image/000001.jpg").exists());
}

#[test]
fn servers_that_cannot_be_trusted_or_reached_are_given_up_with_a_reason() {
    let archive = zipped(&data_set());
    let failing = |faults: Faults| {
        let server = TestServer::start(archive.clone(), faults);
        let dir = tempfile::tempdir().unwrap();
        let message = message(fetch(&server, dir.path(), &["aston"]));
        assert!(!dir.path().join("MobileBrick").exists(), "{message}");
        message
    };
    let found = failing(Faults { status: Some("404 Not Found"), ..Faults::default() });
    assert!(found.contains("404") && found.contains("--url"), "{found}");
    let found = failing(Faults { changes: true, ..Faults::default() });
    assert!(found.contains("has changed on the server"), "{found}");
    let found = failing(Faults { shifts: true, ..Faults::default() });
    assert!(found.contains("was asked for"), "{found}");
    let found = failing(Faults { mute: true, ..Faults::default() });
    assert!(found.contains("fell silent") && found.contains("to go on from here"), "{found}");
    let found = failing(Faults { refusals: usize::MAX, ..Faults::default() });
    assert!(found.contains("503"), "{found}");
    let dir = tempfile::tempdir().unwrap();
    let closed = options("http://127.0.0.1:1/set.zip", &[]);
    assert!(message(download(dir.path(), &closed, &Silent)).contains("127.0.0.1:1"));
    assert!(message(download(dir.path(), &options("ftp://x", &[]), &Silent)).contains("http://"));
}

#[test]
fn what_is_no_archive_or_a_hostile_one_is_refused() {
    let failing = |bytes: Vec<u8>, parts: &[&str]| {
        let server = TestServer::start(bytes, Faults::default());
        let dir = tempfile::tempdir().unwrap();
        message(fetch(&server, dir.path(), parts))
    };
    let archive = zipped(&data_set());
    assert!(failing(noise(3, 50_000), &[]).contains("no readable zip archive"));
    assert!(failing(archive[..archive.len() / 2].to_vec(), &[]).contains("no readable zip archive"));
    let unknown = failing(archive, &["austin"]);
    assert!(unknown.contains("no folder or file 'austin'") && unknown.contains("aston, bridge"), "{unknown}");
    let outside = zipped(&[("../outside.txt".to_owned(), vec![1])]);
    assert!(failing(outside, &[]).contains("leaves the folder"));
    // A member that claims to be far larger than its data can unpack to: the size in the index, changed by hand.
    let mut bomb = zipped(&[("zeros.bin".to_owned(), vec![0; 100_000]), ("a".to_owned(), vec![])]);
    let index = bomb.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    bomb[index + 24..index + 28].copy_from_slice(&0xffff_fff0u32.to_le_bytes());
    let found = failing(bomb, &[]);
    assert!(found.contains("zeros.bin") && found.contains("claims to unpack"), "{found}");
}

#[test]
fn an_index_of_more_members_than_fit_in_a_plain_zip_is_read() {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let plain = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for i in 0..70_000 {
        zip.start_file(format!("s{:02}/pose/{i:06}.txt", i % 100), plain).unwrap();
    }
    zip.start_file("last/mesh/gt_mesh.ply", plain).unwrap();
    zip.write_all(b"ply").unwrap();
    let server = TestServer::start(zip.finish().unwrap().into_inner(), Faults::default());
    let dir = tempfile::tempdir().unwrap();
    let summary = fetch(&server, dir.path(), &["last"]).unwrap();
    assert_eq!((summary.files, summary.bytes), (1, 3));
    assert_eq!(std::fs::read(dir.path().join("last/mesh/gt_mesh.ply")).unwrap(), b"ply");
}

#[test]
fn a_stop_leaves_whole_files_and_a_second_run_goes_on() {
    /// Asks for a stop after some reports.
    struct Impatient(std::sync::atomic::AtomicUsize);
    impl Progress for Impatient {
        fn report(&self, _what: &str, _done: usize, _total: usize) {
            self.0.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
        }
        fn stop_requested(&self) -> bool {
            self.0.load(std::sync::atomic::Ordering::SeqCst) > 4
        }
    }
    let files = data_set();
    let server = TestServer::start(zipped(&files), Faults::default());
    let dir = tempfile::tempdir().unwrap();
    let stopped = download(dir.path(), &options(&server.url, &[]), &Impatient(0.into()));
    assert!(matches!(stopped, Err(Error::Stopped)));
    let summary = fetch(&server, dir.path(), &[]).unwrap();
    assert!(summary.files_kept > 0 && summary.files_written > 0, "{summary:?}");
    assert_has(dir.path(), &files, |_| true);
}
