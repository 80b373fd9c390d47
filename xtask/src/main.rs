//! Project chores: `cargo xtask test`, `cargo xtask tidy`, `cargo xtask ci`.

mod tidy;

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

const HELP: &str = "\
cargo xtask test    all tests; says how many were skipped for want of real data
cargo xtask tidy    house rules: allowed arrows, file headers, manifests, documentation links
cargo xtask ci      format, lints, tidy and test, as continuous integration runs them";

fn main() -> ExitCode {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."));
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let result = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["test"] => test(root),
        ["tidy"] => tidy_all(root),
        ["ci"] => ci(root),
        [] | ["help" | "-h" | "--help"] => {
            println!("{HELP}");
            return ExitCode::SUCCESS;
        }
        _ => {
            eprintln!("unknown task {arguments:?}\n{HELP}");
            return ExitCode::from(2);
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("xtask: {message}");
            ExitCode::FAILURE
        }
    }
}

/// GPU kernels are tested wherever there is a Vulkan device, a software one included.
const GPU: &str = "--features=mb-gpu/wgpu";

fn ci(root: &Path) -> Result<(), String> {
    cargo(root, &["fmt", "--all", "--check"], &[])?;
    tidy_all(root)?;
    cargo(root, &["clippy", "--workspace", "--all-targets", GPU, "--quiet", "--", "-D", "warnings"], &[])?;
    test(root)?;
    cargo(root, &["doc", "--workspace", "--no-deps", "--quiet"], &[("RUSTDOCFLAGS", "-D warnings")])
}

/// Runs every test, and reports the tests that passed without testing because their real inputs are absent.
fn test(root: &Path) -> Result<(), String> {
    let log = root.join("target").join(format!("skipped-{}.log", std::process::id()));
    let _ = std::fs::remove_file(&log);
    let run =
        cargo(root, &["test", "--workspace", GPU, "--quiet"], &[("MOBILEBRICK_SKIP_LOG", &log.to_string_lossy())]);
    let skipped = std::fs::read_to_string(&log).unwrap_or_default();
    let _ = std::fs::remove_file(&log);
    match skipped.lines().count() {
        0 => println!("no test was skipped: the real inputs were there"),
        n => println!(
            "{n} real inputs were absent, and their tests were SKIPPED:\n{skipped}Set MOBILEBRICK_TEST_DATA to the folder that holds them."
        ),
    }
    run
}

fn tidy_all(root: &Path) -> Result<(), String> {
    let complaints = tidy::check(root)?;
    if complaints.is_empty() {
        println!("tidy: all house rules hold");
        return Ok(());
    }
    for complaint in &complaints {
        eprintln!("tidy: {complaint}");
    }
    Err(format!("{} house rules are broken", complaints.len()))
}

fn cargo(root: &Path, arguments: &[&str], environment: &[(&str, &str)]) -> Result<(), String> {
    let program = std::env::var_os("CARGO").map_or_else(|| PathBuf::from("cargo"), PathBuf::from);
    eprintln!("$ cargo {}", arguments.join(" "));
    let status = Command::new(program)
        .current_dir(root)
        .args(arguments)
        .envs(environment.iter().copied())
        .status()
        .map_err(|e| format!("cannot run cargo: {e}"))?;
    if status.success() { Ok(()) } else { Err(format!("cargo {} failed ({status})", arguments.join(" "))) }
}
