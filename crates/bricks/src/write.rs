//! Copies of a model that carry everything with them.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

use mb_job::{Result, write_atomic};

use crate::ldraw::colors::ColorCode;
use crate::ldraw::file::{FileId, FileKind};
use crate::model::Model;

impl Model {
    /// The model as one MPD text with all submodels, parts, pieces of parts and colours inside: read back without a
    /// library it gives the same parts and the same mesh.
    pub fn to_self_contained(&self) -> String {
        let mut colors: BTreeSet<ColorCode> = self.instances().iter().map(|brick| brick.color).collect();
        for &id in self.used_files() {
            colors.extend(self.file(id).references.iter().map(|r| r.color));
            colors.extend(self.file(id).faces.iter().map(|f| f.color));
        }
        let mut text = String::new();
        for (index, &id) in self.used_files().iter().enumerate() {
            let file = self.file(id);
            // Names with slashes are written as the library writes them.
            let _ = writeln!(text, "0 FILE {}", file.name.replace('/', "\\"));
            if index == 0 {
                // The description must stay the first line.
                let (first, rest) = file.text.split_once('\n').unwrap_or((&file.text, ""));
                let has_description = first.trim().starts_with("0 ") && !first.trim().starts_with("0 !");
                let (head, body) = if has_description { (first, rest) } else { ("0", file.text.as_str()) };
                let _ = writeln!(text, "{}", head.trim_end());
                for color in colors.iter().filter_map(|&code| self.colors().get(code)) {
                    let _ = writeln!(text, "{}", color.definition());
                }
                text.push_str(body.trim_end());
            } else {
                text.push_str(file.text.trim_end());
            }
            text.push('\n');
            let states_kind = file.text.contains("!LDRAW_ORG");
            if file.kind == FileKind::Model && !states_kind && file.name.ends_with(".dat") {
                let _ = writeln!(text, "0 !LDRAW_ORG Model");
            }
            text.push_str("0 NOFILE\n");
        }
        text
    }

    /// The model as LDraw text that refers to parts by name: one file, or an MPD where there are submodels.
    pub fn to_ldraw(&self) -> String {
        let own: Vec<_> = self.used_files().iter().filter(|&&id| self.is_own(id)).collect();
        if let [only] = own[..] {
            return self.file(*only).text.clone();
        }
        let mut text = String::new();
        for &id in own {
            let file = self.file(id);
            let _ = writeln!(text, "0 FILE {}\n{}\n0 NOFILE", file.name, file.text.trim_end());
        }
        text
    }

    /// Writes [`Model::to_ldraw`] to a file.
    ///
    /// # Errors
    /// `Error::Write`.
    pub fn write_ldraw(&self, path: impl AsRef<Path>) -> Result<()> {
        write_atomic(path, self.to_ldraw().as_bytes())
    }

    /// Whether the file came with the model, not from a library.
    fn is_own(&self, id: FileId) -> bool {
        self.file(id).kind == FileKind::Model || self.file(id).source == self.file(self.root()).source
    }

    /// Writes [`Model::to_self_contained`] to a file.
    ///
    /// # Errors
    /// `Error::Write`.
    pub fn write_self_contained(&self, path: impl AsRef<Path>) -> Result<()> {
        write_atomic(path, self.to_self_contained().as_bytes())
    }
}
