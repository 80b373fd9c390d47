//! Studio's `.io` files: zip archives with an LDraw model inside.

use std::path::Path;

use mb_job::{InputError, Result};

use super::archive::Archive;

/// The files of a Studio archive that matter, as bytes.
pub(crate) struct StudioFile {
    /// `model.ldr`.
    pub model: Vec<u8>,
    /// Its name for messages.
    pub source: String,
    /// The designer's own parts: name, bytes, name for messages.
    pub custom_parts: Vec<(String, Vec<u8>, String)>,
}

/// Reads the model out of a Studio archive.
pub(crate) fn read(path: &Path) -> Result<StudioFile> {
    let archive = Archive::open(path)?;
    let help = "Studio encrypted its files until late 2023: open it in a current Studio, save it again, \
                or export it as LDraw";
    let find = |wanted: &str| archive.entries().find(|(name, _)| name.eq_ignore_ascii_case(wanted));
    let Some((name, index)) = find("model.ldr").or_else(|| find("model2.ldr")) else {
        return Err(InputError::new(path, "the zip archive holds no model.ldr")
            .help("A Studio .io file does; a parts library goes to --parts")
            .into());
    };
    let model = archive.read(index, help)?;
    let mut custom_parts = vec![];
    for (name, index) in archive.entries() {
        let lower = name.to_lowercase();
        let custom = lower.strip_prefix("customparts/parts/").or_else(|| lower.strip_prefix("customparts/p/"));
        if let Some(part) = custom
            && part.ends_with(".dat")
        {
            custom_parts.push((part.to_owned(), archive.read(index, help)?, archive.label(name)));
        }
    }
    Ok(StudioFile { model, source: archive.label(name), custom_parts })
}
