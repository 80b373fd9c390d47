//! Call-outs: the pieces of a step, and how they stand beside its picture.

use crate::layout::{GAP, NUMBER, PAD};
use crate::page::PictureId;
use crate::text::Weight;

/// A piece in a call-out.
pub(crate) struct Entry {
    pub id: PictureId,
    pub size: [f64; 2],
    pub count: String,
    pub color: Option<String>,
    pub submodel: bool,
}

impl Entry {
    pub fn width(&self) -> f64 {
        let name = self.color.as_ref().map_or(0.0, |name| Weight::Regular.width(name, 2.3));
        self.size[0].max(Weight::Bold.width(&self.count, 3.8)).max(name)
    }

    pub fn height(&self) -> f64 {
        self.size[1] + 4.6 + if self.color.is_some() { 2.8 } else { 0.0 }
    }
}

/// A call-out: its size and where its entries stand in it.
pub(crate) struct CallOut {
    pub size: [f64; 2],
    pub places: Vec<[f64; 2]>,
}

/// A way to put a call-out and a picture into a given width.
pub(crate) struct Fit {
    pub call_out: CallOut,
    /// Whether the picture stands beside the call-out; else below it.
    pub beside: bool,
    /// Between call-out and picture, for the number.
    pub clear: f64,
    /// What is needed.
    pub height: f64,
}

/// The ways to put a call-out and a picture `[w, h]` into a width, the best first.
pub(crate) fn fits(entries: &[Entry], [w, h]: [f64; 2], width: f64) -> Vec<Fit> {
    let mut fits = vec![];
    let above = call_out(entries, width);
    if w <= width && above.size[0] <= width {
        // The corner of a slanted picture leaves room for the number.
        let clear = if w + 2.0 * 16.0 <= width { 0.0 } else { 0.45 * NUMBER };
        let height = above.size[1] + GAP + (clear + h).max(NUMBER);
        fits.push(Fit { call_out: above, beside: false, clear, height });
    }
    let widest = entries.iter().map(Entry::width).fold(0.0, f64::max) + 2.0 * PAD;
    for columns in 1..=2 {
        let beside = call_out(entries, (widest * f64::from(columns)).max(26.0));
        if beside.size[0] + GAP + w <= width {
            let height = h.max(beside.size[1] + NUMBER);
            fits.push(Fit { call_out: beside, beside: true, clear: 0.0, height });
        }
    }
    fits
}

/// Entries in rows no wider than `width`.
pub(crate) fn call_out(entries: &[Entry], width: f64) -> CallOut {
    const BETWEEN: f64 = 3.5;
    let limit = width - 2.0 * PAD;
    let mut rows: Vec<Vec<usize>> = vec![];
    let mut used = f64::INFINITY;
    for (index, entry) in entries.iter().enumerate() {
        if used + BETWEEN + entry.width() > limit {
            rows.push(vec![]);
            used = -BETWEEN;
        }
        used += BETWEEN + entry.width();
        if let Some(row) = rows.last_mut() {
            row.push(index);
        }
    }
    let mut places = vec![[0.0; 2]; entries.len()];
    let (mut y, mut widest) = (PAD, 0.0_f64);
    for row in &rows {
        let height = row.iter().map(|&i| entries[i].height()).fold(0.0, f64::max);
        let mut x = PAD;
        for &i in row {
            // On a common base line.
            places[i] = [x, y + height - entries[i].height()];
            x += entries[i].width() + BETWEEN;
        }
        widest = widest.max(x - BETWEEN + PAD);
        y += height + 2.0;
    }
    CallOut { size: [widest, y - 2.0 + PAD - 1.5], places }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_call_out_breaks_into_rows_and_contains_its_entries() {
        let entry = |w: f64| Entry {
            id: PictureId::Cover,
            size: [w, 10.0],
            count: "2x".to_owned(),
            color: None,
            submodel: false,
        };
        let entries: Vec<Entry> = [20.0, 30.0, 25.0].into_iter().map(entry).collect();
        for width in [40.0, 70.0, 200.0] {
            let call_out = call_out(&entries, width);
            assert!(call_out.size[0] <= width, "{width}");
            for (entry, [x, y]) in entries.iter().zip(&call_out.places) {
                assert!(x + entry.width() <= call_out.size[0] && y + entry.height() <= call_out.size[1] + 0.1);
            }
        }
    }
}
