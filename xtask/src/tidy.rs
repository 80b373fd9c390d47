//! The house rules that no compiler checks.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Files above this length usually hold two rooms.
const LONGEST_FILE: usize = 900;

/// All breaches of the house rules, one sentence each.
pub fn check(root: &Path) -> Result<Vec<String>, String> {
    let mut complaints = Vec::new();
    let architecture = read(&root.join("ARCHITECTURE.md"))?;
    arrows(root, &architecture, &mut complaints)?;
    for path in files(root, "rs")? {
        source(root, &path, &mut complaints)?;
    }
    for path in files(root, "md")? {
        links(root, &path, &mut complaints)?;
    }
    Ok(complaints)
}

/// The table of ARCHITECTURE.md: crate name -> crates that it may use.
fn allowed_arrows(architecture: &str) -> Result<BTreeMap<String, BTreeSet<String>>, String> {
    let mut allowed = BTreeMap::new();
    let mut in_table = false;
    for line in architecture.lines() {
        let cells: Vec<&str> = line.trim().trim_matches('|').split('|').map(str::trim).collect();
        if cells.len() >= 2 && cells[0] == "crate" && cells[1] == "may use" {
            in_table = true;
        } else if in_table && !line.starts_with('|') {
            break;
        } else if in_table && !cells[0].starts_with('-') {
            let uses = cells[1].split([',', ' ']).map(|c| c.trim_matches('`')).filter(|c| !c.is_empty() && *c != "-");
            allowed.insert(cells[0].trim_matches('`').to_owned(), uses.map(str::to_owned).collect());
        }
    }
    if allowed.is_empty() { Err("ARCHITECTURE.md has no table `| crate | may use | ...`".into()) } else { Ok(allowed) }
}

fn arrows(root: &Path, architecture: &str, complaints: &mut Vec<String>) -> Result<(), String> {
    let allowed = allowed_arrows(architecture)?;
    let mut seen = BTreeSet::new();
    for (from, uses) in &allowed {
        for to in uses {
            if allowed.get(to).is_none_or(|back| back.contains(from)) {
                complaints.push(format!("ARCHITECTURE.md: the arrow {from} -> {to} points up or to an unknown crate"));
            }
        }
    }
    for room in ["apps", "crates", "xtask"] {
        let manifests: Vec<PathBuf> = if room == "xtask" {
            vec![root.join("xtask/Cargo.toml")]
        } else {
            let entries = fs::read_dir(root.join(room)).map_err(|e| format!("{room}: {e}"))?;
            let mut paths: Vec<_> =
                entries.flatten().map(|e| e.path().join("Cargo.toml")).filter(|p| p.exists()).collect();
            paths.sort();
            paths
        };
        for manifest in manifests {
            let folder = manifest
                .parent()
                .and_then(Path::file_name)
                .map(|n| n.to_string_lossy().into_owned())
                .unwrap_or_default();
            let text = read(&manifest)?;
            let shown = manifest.strip_prefix(root).unwrap_or(&manifest).display().to_string();
            // The Python bindings are a workspace of their own, which has no lints to inherit.
            let inherits = text.contains("[lints]\nworkspace = true") || text.contains("\n[workspace]\n");
            if !inherits {
                complaints.push(format!("{shown}: does not inherit the workspace lints"));
            }
            let expected = if room == "crates" { format!("mb-{folder}") } else { String::new() };
            if room == "crates" && !text.contains(&format!("name = \"{expected}\"")) {
                complaints.push(format!("{shown}: the package of {folder} must be named {expected}"));
            }
            let Some(uses) = allowed.get(&folder) else {
                complaints.push(format!("{shown}: {folder} has no row in the table of ARCHITECTURE.md"));
                continue;
            };
            seen.insert(folder.clone());
            for to in dependencies(&text) {
                if !uses.contains(&to) {
                    complaints
                        .push(format!("{shown}: the arrow {folder} -> {to} is not in the table of ARCHITECTURE.md"));
                }
            }
        }
    }
    for name in allowed.keys().filter(|name| !seen.contains(*name)) {
        complaints.push(format!("ARCHITECTURE.md: {name} has a row, but there is no such crate"));
    }
    Ok(())
}

/// Workspace crates under `[dependencies]`; tests and benches may reach anywhere.
fn dependencies(manifest: &str) -> Vec<String> {
    let mut section = "";
    let mut found = Vec::new();
    for line in manifest.lines() {
        if line.starts_with('[') {
            section = line.trim();
        } else if section == "[dependencies]"
            && let Some(name) = line.strip_prefix("mb-")
        {
            found.push(name.split(['.', ' ', '=']).next().unwrap_or("").to_owned());
        }
    }
    found
}

fn source(root: &Path, path: &Path, complaints: &mut Vec<String>) -> Result<(), String> {
    let text = read(path)?;
    let shown = path.strip_prefix(root).unwrap_or(path).display().to_string();
    if !text.starts_with("//!") {
        complaints.push(format!("{shown}: must begin with a line `//! what this file is for`"));
    }
    let lines = text.lines().count();
    if lines > LONGEST_FILE {
        complaints.push(format!("{shown}: {lines} lines; a room of over {LONGEST_FILE} usually holds two"));
    }
    // Split, so that this file does not complain about itself.
    for mark in [concat!("TO", "DO"), concat!("FIX", "ME"), concat!("XX", "X:"), concat!("#[", "ignore]")] {
        if let Some(i) = text.lines().position(|line| line.contains(mark)) {
            complaints.push(format!("{shown}: line {}: {mark} left behind", i + 1));
        }
    }
    Ok(())
}

/// Relative links in Markdown must lead somewhere.
fn links(root: &Path, path: &Path, complaints: &mut Vec<String>) -> Result<(), String> {
    let text = read(path)?;
    let shown = path.strip_prefix(root).unwrap_or(path).display().to_string();
    for part in text.split("](").skip(1) {
        let target = part.split([')', '#', ' ']).next().unwrap_or("");
        if target.is_empty() || target.contains("://") || target.starts_with("mailto:") {
            continue;
        }
        if !path.parent().unwrap_or(root).join(target).exists() {
            complaints.push(format!("{shown}: the link to {target} leads nowhere"));
        }
    }
    Ok(())
}

/// Files of one extension outside build outputs, in a fixed order.
fn files(root: &Path, extension: &str) -> Result<Vec<PathBuf>, String> {
    let mut found = Vec::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).map_err(|e| format!("{}: {e}", folder.display()))?.flatten() {
            let path = entry.path();
            let name = entry.file_name().to_string_lossy().into_owned();
            if path.is_dir() {
                if !name.starts_with('.') && !name.starts_with("target") && name != "node_modules" && name != "out" {
                    folders.push(path);
                }
            } else if path.extension().is_some_and(|e| e == extension) {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}

fn read(path: &Path) -> Result<String, String> {
    fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_read_and_upward_arrows_are_found() {
        let table =
            "x\n| crate | may use | knows nothing of |\n|---|---|---|\n| `a` | - | files |\n| `b` | `a` | x |\n\nend";
        let allowed = allowed_arrows(table).unwrap();
        assert_eq!(allowed["a"], BTreeSet::new());
        assert_eq!(allowed["b"], BTreeSet::from(["a".to_owned()]));
        assert!(allowed_arrows("nothing").is_err());
    }

    #[test]
    fn only_ordinary_dependencies_are_arrows() {
        let manifest =
            "[dependencies]\nmb-job.workspace = true\nserde = \"1\"\n[dev-dependencies]\nmb-eval.workspace = true\n";
        assert_eq!(dependencies(manifest), ["job"]);
    }
}
