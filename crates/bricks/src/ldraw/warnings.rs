//! Things worth saying that are no errors, bounded in number.

use std::collections::BTreeMap;

/// How many warnings of one kind are kept; the rest is counted.
const KEPT_PER_KIND: usize = 20;

/// Collects warnings in the order in which they arise.
#[derive(Debug, Default)]
pub(crate) struct Warnings {
    kept: Vec<String>,
    count_of_kind: BTreeMap<&'static str, usize>,
}

impl Warnings {
    pub fn add(&mut self, kind: &'static str, message: String) {
        let count = self.count_of_kind.entry(kind).or_default();
        *count += 1;
        if *count <= KEPT_PER_KIND {
            self.kept.push(message);
        }
    }

    pub fn finish(mut self) -> Vec<String> {
        for (kind, count) in self.count_of_kind {
            if count > KEPT_PER_KIND {
                self.kept.push(format!("{} more of the kind: {kind}", count - KEPT_PER_KIND));
            }
        }
        self.kept
    }
}
