//! The board as a page to print.

use mb_job::{InputError, Result};
use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str};
use serde::{Deserialize, Serialize};

use crate::BoardSpec;

/// Paper to print on. The board lies in the middle; a sheet is turned where it only fits sideways.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Paper {
    /// A page of the board's own size with a margin, for plotters and print shops.
    #[default]
    Fit,
    /// 210 x 297 mm.
    A4,
    /// 297 x 420 mm.
    A3,
    /// 420 x 594 mm.
    A2,
    /// 594 x 841 mm.
    A1,
    /// 841 x 1189 mm.
    A0,
    /// 8.5 x 11 inches.
    Letter,
}

/// White around the board that is kept free, and that printers need, metres.
const MARGIN_M: f64 = 0.01;
/// Room below the board for the line of text and the ruler, metres.
const FOOT_M: f64 = 0.012;
/// Length of the ruler, metres.
const RULER_M: f64 = 0.1;

impl Paper {
    fn size_m(self) -> Option<[f64; 2]> {
        match self {
            Self::Fit => None,
            Self::A4 => Some([0.210, 0.297]),
            Self::A3 => Some([0.297, 0.420]),
            Self::A2 => Some([0.420, 0.594]),
            Self::A1 => Some([0.594, 0.841]),
            Self::A0 => Some([0.841, 1.189]),
            Self::Letter => Some([0.2159, 0.2794]),
        }
    }
}

impl BoardSpec {
    /// A PDF of one page with the board in its true size, its text below, and a ruler of 100 mm to check the print by
    /// (of 10 mm on a page too narrow for it).
    ///
    /// # Errors
    /// The board does not fit on the paper.
    pub fn pdf(&self, paper: Paper) -> Result<Vec<u8>> {
        let [width, height] = self.size_m();
        let needed = [width + 2.0 * MARGIN_M, height + 2.0 * MARGIN_M + FOOT_M];
        let page = match paper.size_m() {
            None => needed,
            Some([a, b]) if needed[0] <= a && needed[1] <= b => [a, b],
            Some([a, b]) if needed[0] <= b && needed[1] <= a => [b, a],
            Some([a, b]) => {
                let mm = |m: f64| (m * 1e3).ceil();
                let found = format!(
                    "a board of {} x {} mm with its margins does not fit on paper of {} x {} mm",
                    mm(needed[0]),
                    mm(needed[1]),
                    mm(a),
                    mm(b)
                );
                return Err(InputError::new(self.to_string(), found)
                    .help("Choose larger paper, or `fit` for a page of the board's own size")
                    .into());
            }
        };
        let points = |m: f64| (m / 0.0254 * 72.0) as f32;
        let [left, top] = [0.5 * (page[0] - width), 0.5 * (page[1] - height - FOOT_M)];
        let mut content = Content::new();
        content.set_fill_gray(0.0);
        // One path for everything black: painted at once, rectangles that touch leave no seams.
        for r in self.black_rectangles() {
            let (x, bottom) = (left + r.x_m, page[1] - top - r.y_m - r.height_m);
            content.rect(points(x), points(bottom), points(r.width_m), points(r.height_m));
        }
        content.fill_nonzero();
        let foot = page[1] - top - height - 0.5 * MARGIN_M;
        let ruler_m = if width >= RULER_M { RULER_M } else { 0.1 * RULER_M };
        for (x, y, w, h) in [
            (left, foot - 0.002, ruler_m, 0.0003),
            (left, foot - 0.003, 0.0003, 0.002),
            (left + ruler_m - 0.0003, foot - 0.003, 0.0003, 0.002),
        ] {
            content.rect(points(x), points(y), points(w), points(h));
        }
        content.fill_nonzero();
        let text = format!("{self}   print at 100 %: the line is {:.0} mm long", ruler_m * 1e3);
        let size = (1.9 * points(width) / text.len() as f32).clamp(3.0, 8.0);
        content.begin_text();
        content.set_font(FONT, size);
        content.next_line(points(left), points(foot - 0.007));
        // The font's encoding is that of ASCII; a custom dictionary's path may hold more.
        let ascii: Vec<u8> = text.chars().map(|c| u8::try_from(c).ok().filter(u8::is_ascii).unwrap_or(b'?')).collect();
        content.show(Str(&ascii));
        content.end_text();

        let [catalog, pages, page_id, font, stream] = [1, 2, 3, 4, 5].map(Ref::new);
        let mut pdf = Pdf::new();
        pdf.catalog(catalog).pages(pages);
        pdf.pages(pages).kids([page_id]).count(1);
        let mut sheet = pdf.page(page_id);
        sheet.parent(pages).media_box(Rect::new(0.0, 0.0, points(page[0]), points(page[1]))).contents(stream);
        sheet.resources().fonts().pair(FONT, font);
        sheet.finish();
        pdf.type1_font(font).base_font(Name(b"Helvetica"));
        pdf.stream(stream, &content.finish());
        Ok(pdf.finish())
    }
}

const FONT: Name = Name(b"F1");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_the_boards_size_in_points() {
        let board: BoardSpec = "charuco:5x7:0.0254:0.0127:DICT_6X6_250".parse().expect("a board");
        let pdf = String::from_utf8_lossy(&board.pdf(Paper::Fit).expect("a page")).into_owned();
        assert!(pdf.starts_with("%PDF-") && pdf.trim_end().ends_with("%%EOF"));
        // 5 inches and 2 cm; 7 inches and 3.2 cm.
        assert!(pdf.contains("/MediaBox [0 0 416.69"), "{pdf}");
        let inch = pdf.matches(" 72 72 re").count();
        assert_eq!(inch, 18, "black squares of an inch");
        assert!(pdf.contains("charuco:5x7:0.0254:0.0127:DICT_6X6_250"));
    }

    #[test]
    fn paper_is_turned_or_refused() {
        let wide: BoardSpec = "charuco:8x5:0.03:0.02:DICT_6X6_250".parse().expect("a board");
        let pdf = String::from_utf8_lossy(&wide.pdf(Paper::A4).expect("sideways")).into_owned();
        assert!(pdf.contains("/MediaBox [0 0 841.8"), "{pdf}");
        let large: BoardSpec = "charuco:9x6:0.04:0.02:DICT_6X6_250".parse().expect("a board");
        let error = large.pdf(Paper::Letter).expect_err("too large").to_string();
        assert!(error.contains("380 x 272 mm") && error.contains("Choose larger paper"), "{error}");
    }
}
