//! The fonts of the booklet, and how wide text is.
//!
//! Noto Sans (SIL Open Font Licence 1.1), as the crate `notosans` carries it.

use std::sync::LazyLock;

use skrifa::instance::{LocationRef, Size};
use skrifa::{FontRef, GlyphId, MetadataProvider};

/// A weight of the font.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Weight {
    Regular,
    Bold,
}

impl Weight {
    /// The TrueType file.
    pub fn bytes(self) -> &'static [u8] {
        match self {
            Self::Regular => notosans::REGULAR_TTF,
            Self::Bold => notosans::BOLD_TTF,
        }
    }

    fn font(self) -> &'static FontRef<'static> {
        static FONTS: LazyLock<[FontRef<'static>; 2]> = LazyLock::new(|| {
            [notosans::REGULAR_TTF, notosans::BOLD_TTF]
                .map(|bytes| FontRef::new(bytes).expect("the crate's fonts are valid"))
        });
        match self {
            Self::Regular => &FONTS[0],
            Self::Bold => &FONTS[1],
        }
    }

    /// The glyph of each character and its advance in ems. A character that the font lacks is a question mark.
    pub fn glyphs(self, text: &str) -> Vec<(GlyphId, f32)> {
        let font = self.font();
        let (charmap, metrics) = (font.charmap(), font.glyph_metrics(Size::unscaled(), LocationRef::default()));
        let em = f32::from(metrics_units(font));
        text.chars()
            .map(|c| {
                let glyph = charmap.map(c).or_else(|| charmap.map('?')).unwrap_or_default();
                (glyph, metrics.advance_width(glyph).unwrap_or(0.5 * em) / em)
            })
            .collect()
    }

    /// Width of a line of text of a size; both in the same unit.
    pub fn width(self, text: &str, size: f64) -> f64 {
        self.glyphs(text).iter().map(|(_, advance)| f64::from(*advance)).sum::<f64>() * size
    }

    /// The text in lines no wider than `width`; the last of `lines` ends in an ellipsis where more would follow.
    pub fn wrapped(self, text: &str, size: f64, width: f64, lines: usize) -> Vec<String> {
        let mut wrapped: Vec<String> = vec![String::new()];
        for word in text.split_whitespace() {
            let last = wrapped.last_mut().expect("never empty");
            let longer = if last.is_empty() { word.to_owned() } else { format!("{last} {word}") };
            if last.is_empty() || self.width(&longer, size) <= width {
                *last = longer;
            } else {
                wrapped.push(word.to_owned());
            }
        }
        let cut = wrapped.len() > lines;
        wrapped.truncate(lines.max(1));
        for (index, line) in wrapped.iter_mut().enumerate() {
            let ellipsis = if cut && index + 1 == lines { "\u{2026}" } else { "" };
            let mut shown = line.clone() + ellipsis;
            while self.width(&shown, size) > width && line.pop().is_some() {
                shown = line.trim_end().to_owned() + "\u{2026}";
            }
            *line = shown;
        }
        wrapped
    }
}

fn metrics_units(font: &FontRef<'static>) -> u16 {
    font.metrics(Size::unscaled(), LocationRef::default()).units_per_em
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_has_width_and_wraps() {
        assert!(Weight::Bold.width("mm", 1.0) > Weight::Bold.width("ii", 1.0));
        assert!((Weight::Regular.width("abc", 2.0) - 2.0 * Weight::Regular.width("abc", 1.0)).abs() < 1e-6);
        assert_eq!(Weight::Regular.width("\u{4e00}", 1.0), Weight::Regular.width("?", 1.0));
        let lines = Weight::Regular.wrapped("Brick 2 x 4 with a very long name indeed", 3.0, 20.0, 2);
        assert_eq!(lines.len(), 2);
        assert!(lines.iter().all(|line| Weight::Regular.width(line, 3.0) <= 20.0), "{lines:?}");
        assert!(lines[1].ends_with('\u{2026}'), "{lines:?}");
        assert_eq!(Weight::Regular.wrapped("", 3.0, 20.0, 2), [""]);
    }
}
