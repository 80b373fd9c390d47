//! Where everything stands on the pages.

use mb_bricks::{ColorCode, Model};

use crate::call_out::{CallOut, Entry, Fit, call_out, fits};
use crate::colors::similar_colors;
use crate::page::{Align, PAGE_MM, Page, PictureId, Rect, Rgb};
use crate::plan::{PieceKind, Plan, section_title};
use crate::sheet::{Sheets, Shot};
use crate::signs;
use crate::text::Weight;

const INK: Rgb = [32, 36, 42];
const GREY: Rgb = [112, 118, 126];
const RULE: Rgb = [214, 218, 223];
const CALL_OUT: Rgb = [228, 240, 250];
const CALL_OUT_LINE: Rgb = [150, 188, 220];
const SUBMODEL: Rgb = [255, 247, 226];
const SUBMODEL_LINE: Rgb = [232, 196, 112];
const ACCENT: Rgb = [0, 98, 168];
const ALARM: Rgb = [190, 30, 20];

const MARGIN: f64 = 8.0;
const FOOT: f64 = 10.0;
pub(crate) const GAP: f64 = 3.0;
/// Space inside a cell.
pub(crate) const PAD: f64 = 3.0;
/// Height of a step's number, with the space around it.
pub(crate) const NUMBER: f64 = 11.0;
/// The band over the first step of a submodel.
const BAND: f64 = 9.0;
/// Height of the line that says how often a submodel is built.
const TIMES: f64 = 7.0;
/// Most columns, rows and steps of a page.
const MAX_COLUMNS: usize = 3;
const MAX_ROWS: usize = 3;
const MAX_STEPS: usize = 6;
/// Rows are no lower than this, millimetres.
const ROW_MM: f64 = 50.0;

/// The pages and the pictures on them.
pub(crate) struct Book {
    pub pages: Vec<Page>,
    /// How often the view changes from one step of a section to its next.
    pub view_changes: usize,
}

/// Lays out the whole booklet. `cover` and `back` are the sizes of their pictures.
pub(crate) fn book(model: &Model, plan: &Plan, sheets: &Sheets, title: &str, cover: [f64; 2], back: [f64; 2]) -> Book {
    let names = similar_colors(model, plan);
    let mut layout = Layout { model, plan, sheets, names, pages: vec![], view_changes: 0 };
    layout.cover(title, cover);
    layout.parts_list();
    layout.steps();
    layout.back(back);
    layout.feet();
    Book { pages: layout.pages, view_changes: layout.view_changes }
}

struct Layout<'a> {
    model: &'a Model,
    plan: &'a Plan,
    sheets: &'a Sheets,
    /// Colours that need their name beside the picture.
    names: Vec<ColorCode>,
    pages: Vec<Page>,
    view_changes: usize,
}

/// A line of the parts list.
struct ListLine {
    /// `None` where the part is missing.
    picture: Option<PictureId>,
    size: [f64; 2],
    count: usize,
    color: ColorCode,
    description: String,
    number: String,
}

/// How a step fills its cell.
struct Arrangement {
    call_out: CallOut,
    shrink: f64,
    picture: Rect,
    number: [f64; 2],
}

/// A row of a page.
#[derive(Debug, Clone, Copy)]
struct Row {
    columns: usize,
    /// What its steps need.
    height: f64,
}

/// Pages with more steps are better, then rows of equal length, then fewer rows.
fn rank(rows: &[Row]) -> (usize, std::cmp::Reverse<usize>, std::cmp::Reverse<usize>) {
    let columns = || rows.iter().map(|row| row.columns);
    let uneven = columns().max().unwrap_or(0) - columns().min().unwrap_or(0);
    (columns().sum(), std::cmp::Reverse(uneven), std::cmp::Reverse(rows.len()))
}

fn column_width(area: &Rect, columns: usize) -> f64 {
    (area.w - GAP * (columns - 1) as f64) / columns as f64
}

impl Layout<'_> {
    fn cover(&mut self, title: &str, [w, h]: [f64; 2]) {
        let mut page = Page { title: "Cover".to_owned(), ..Page::default() };
        page.filled(Rect::new(0.0, 0.0, PAGE_MM[0], PAGE_MM[1]), 0.0, [244, 247, 250]);
        page.filled(Rect::new(0.0, 0.0, 7.0, PAGE_MM[1]), 0.0, ACCENT);
        let mut y = 27.0;
        for line in Weight::Bold.wrapped(title, 13.0, PAGE_MM[0] - 40.0, 2) {
            page.text([20.0, y], 13.0, Weight::Bold, INK, Align::Left, line);
            y += 15.0;
        }
        page.text([20.0, y - 4.0], 6.0, Weight::Regular, GREY, Align::Left, "Building instructions");
        let (top, bottom) = (y + 2.0, PAGE_MM[1] - 22.0);
        let middle = [0.5 * PAGE_MM[0] + 3.5, 0.5 * (top + bottom)];
        page.picture(Rect::new(middle[0] - 0.5 * w, middle[1] - 0.5 * h, w, h), PictureId::Cover);
        let parts: usize = self.plan.totals().iter().map(|(_, count)| count).sum();
        let steps = self.plan.order.len();
        let facts = format!("{parts} {}", if parts == 1 { "part" } else { "parts" });
        page.text([20.0, PAGE_MM[1] - 12.0], 7.5, Weight::Bold, INK, Align::Left, &facts);
        let after = 20.0 + Weight::Bold.width(&facts, 7.5) + 5.0;
        let more = format!("{steps} {}", if steps == 1 { "step" } else { "steps" });
        page.text([after, PAGE_MM[1] - 12.0], 5.0, Weight::Regular, GREY, Align::Left, more);
        let missing = self.model.missing().len();
        if missing > 0 {
            let are = if missing == 1 { "1 part is".to_owned() } else { format!("{missing} parts are") };
            let words = format!("Incomplete: {are} missing from the parts library");
            page.text([PAGE_MM[0] - 12.0, PAGE_MM[1] - 12.0], 5.0, Weight::Bold, ALARM, Align::Right, words);
        }
        self.pages.push(page);
    }

    fn parts_list(&mut self) {
        const COLUMNS: usize = 6;
        let width = (PAGE_MM[0] - 2.0 * MARGIN) / COLUMNS as f64;
        let lines = self.list_lines();
        let (top, bottom) = (24.0, PAGE_MM[1] - FOOT - 4.0);
        let mut page = Page::default();
        let mut y = f64::INFINITY;
        for row in lines.chunks(COLUMNS) {
            let height = row.iter().map(|line| line.size[1]).fold(0.0, f64::max) + 17.5;
            if y + height > bottom {
                let first = self.pages.len() == 1 && page.elements.is_empty();
                if !page.elements.is_empty() {
                    self.pages.push(std::mem::take(&mut page));
                }
                page.title = "Parts".to_owned();
                page.text([MARGIN + 2.0, 17.0], 8.0, Weight::Bold, INK, Align::Left, "Parts");
                if first {
                    let count: usize = lines.iter().map(|line| line.count).sum();
                    let sum = format!("{count} in all, {} different", lines.len());
                    page.text([PAGE_MM[0] - MARGIN - 2.0, 17.0], 4.0, Weight::Regular, GREY, Align::Right, sum);
                }
                y = top;
            }
            for (column, line) in row.iter().enumerate() {
                let left = MARGIN + column as f64 * width + 2.0;
                let base = y + height - 17.5;
                let [w, h] = line.size;
                let picture = Rect::new(left + 0.5 * (width - 4.0 - w), base - h, w, h);
                match line.picture {
                    Some(id) => page.picture(picture, id),
                    None => {
                        let frame = Some((ALARM, 0.3));
                        page.elements.push(crate::page::Element::Box {
                            rect: picture,
                            radius: 1.2,
                            fill: None,
                            line: frame,
                        });
                        let middle = [picture.x + 0.5 * w, picture.y + 0.5 * h + 2.2];
                        page.text(middle, 6.0, Weight::Bold, ALARM, Align::Center, "?");
                    }
                }
                page.text([left, base + 4.6], 4.4, Weight::Bold, INK, Align::Left, format!("{}x", line.count));
                let look = self.model.colors().look(line.color);
                let swatch = Rect::new(left + 12.0, base + 1.6, 3.2, 3.2);
                let edge = Some((crate::geometry::line_rgb(look.rgb), 0.15));
                page.elements.push(crate::page::Element::Box {
                    rect: swatch,
                    radius: 0.5,
                    fill: Some(look.rgb),
                    line: edge,
                });
                let name = Weight::Regular.wrapped(&look.name, 2.7, width - 20.5, 1);
                page.text([left + 16.4, base + 4.2], 2.7, Weight::Regular, INK, Align::Left, name.concat());
                let ink = if line.picture.is_some() { INK } else { ALARM };
                let mut at = base + 8.2;
                for text in Weight::Regular.wrapped(&line.description, 2.5, width - 5.0, 2) {
                    page.text([left, at], 2.5, Weight::Regular, ink, Align::Left, text);
                    at += 3.0;
                }
                let number = Weight::Regular.wrapped(&line.number, 2.3, width - 5.0, 1).concat();
                page.text([left, at], 2.3, Weight::Regular, GREY, Align::Left, number);
            }
            y += height;
        }
        if !page.elements.is_empty() {
            self.pages.push(page);
        }
    }

    /// What the parts list names: colours together, as parts are sorted by hand; within a colour by what they are; what is
    /// missing last.
    fn list_lines(&self) -> Vec<ListLine> {
        let mut totals = self.plan.totals();
        totals.sort_by_key(|((part, color), _)| {
            (self.model.colors().look(*color).name, natural(&self.model.file(*part).description), *part, *color)
        });
        let there = totals.into_iter().map(|((part, color), count)| {
            let (kind, file) = (PieceKind::Part(part, color), self.model.file(part));
            ListLine {
                picture: Some(PictureId::Piece(kind)),
                size: self.shot(kind).size_mm(),
                count,
                color,
                description: plain(&file.description),
                number: stem(&file.name),
            }
        });
        let missing = self.plan.missing.iter().map(|(brick, count)| ListLine {
            picture: None,
            size: [12.0, 12.0],
            count: *count,
            color: brick.color,
            description: "Missing: in no step".to_owned(),
            number: stem(&brick.name),
        });
        there.chain(missing).collect()
    }

    fn shot(&self, kind: PieceKind) -> &Shot {
        &self.sheets.pieces[&kind]
    }

    fn entries(&self, section: usize, step: usize) -> Vec<Entry> {
        let entry = |(kind, count): (PieceKind, usize)| Entry {
            id: PictureId::Piece(kind),
            size: self.shot(kind).size_mm(),
            count: format!("{count}x"),
            color: match kind {
                PieceKind::Part(_, color) if self.names.contains(&color) => Some(self.model.colors().look(color).name),
                _ => None,
            },
            submodel: matches!(kind, PieceKind::Submodel(_)),
        };
        self.plan.sections[section].steps[step].counts().into_iter().map(entry).collect()
    }

    fn steps(&mut self) {
        let area = Rect::new(MARGIN, MARGIN, PAGE_MM[0] - 2.0 * MARGIN, PAGE_MM[1] - MARGIN - FOOT);
        let mut at = 0;
        while at < self.plan.order.len() {
            let left = &self.plan.order[at..];
            let mut page = Page { title: format!("Page {}", self.pages.len() + 1), ..Page::default() };
            let rows = self.rows(left, &area);
            let count: usize = rows.iter().map(|row| row.columns).sum();
            // What is free is shared among the rows.
            let heights: f64 = rows.iter().map(|row| row.height).sum();
            let spare = (area.h - GAP * (rows.len() - 1) as f64 - heights) / rows.len() as f64;
            let (mut y, mut next) = (area.y, left.iter().copied());
            for row in rows {
                let (w, h) = (column_width(&area, row.columns), row.height + spare);
                for (column, (section, step)) in next.by_ref().take(row.columns).enumerate() {
                    let cell = Rect::new(area.x + column as f64 * (w + GAP), y, w, h);
                    let arrangement = self.arrange(section, step, &cell);
                    self.step(&mut page, section, step, &cell, &arrangement);
                }
                y += h + GAP;
            }
            at += count;
            self.pages.push(page);
        }
    }

    /// The rows of the next page: those that hold the most steps; of these the most even ones.
    fn rows(&self, left: &[(usize, usize)], area: &Rect) -> Vec<Row> {
        let row = |from: usize, columns: usize| {
            let w = column_width(area, columns);
            let heights = left[from..from + columns].iter().map(|&(section, step)| self.least_height(section, step, w));
            let height = heights.reduce(|sum, height| Some(sum?.max(height?))).flatten()?.max(ROW_MM);
            Some(Row { columns, height })
        };
        let mut best: Vec<Row> = vec![Row { columns: 1, height: area.h }];
        let mut open: Vec<Vec<Row>> = vec![vec![]];
        while let Some(rows) = open.pop() {
            let from: usize = rows.iter().map(|row| row.columns).sum();
            let used: f64 = rows.iter().map(|row| row.height + GAP).sum();
            if rank(&rows) > rank(&best) {
                best.clone_from(&rows);
            }
            let most =
                if rows.len() < MAX_ROWS { (MAX_STEPS - from).min(left.len() - from).min(MAX_COLUMNS) } else { 0 };
            let longer = (1..=most).filter_map(|columns| row(from, columns)).filter(|row| used + row.height <= area.h);
            open.extend(longer.map(|row| rows.iter().copied().chain([row]).collect::<Vec<_>>()));
        }
        best
    }

    /// Whether this is a submodel, and so stands on coloured ground.
    fn is_submodel(&self, section: usize) -> bool {
        section + 1 != self.plan.sections.len()
    }

    /// The least height of a cell of width `w` that holds a step; `None` where none does.
    fn least_height(&self, section: usize, step: usize, w: f64) -> Option<f64> {
        let [top, bottom] = self.margins(section, step);
        let picture = self.sheets.steps[section][step].size_mm();
        let ways = fits(&self.entries(section, step), picture, w - 2.0 * PAD);
        ways.into_iter().map(|fit| fit.height + top + bottom).reduce(f64::min)
    }

    /// What of a cell is not free, above and below: a submodel has a band over its first step, and under its last one
    /// how often it is built.
    fn margins(&self, section: usize, step: usize) -> [f64; 2] {
        let band = if self.is_submodel(section) && step == 0 { BAND } else { 0.0 };
        let times = if self.ends_copies(section, step) { TIMES } else { 0.0 };
        [PAD + band, PAD + times]
    }

    /// Whether this is the last step of something that is built more than once.
    fn ends_copies(&self, section: usize, step: usize) -> bool {
        let of_section = &self.plan.sections[section];
        of_section.copies > 1 && step + 1 == of_section.steps.len()
    }

    /// How a step stands in a cell. Where it does not fit, its call-out shrinks until it does.
    fn arrange(&self, section: usize, step: usize, cell: &Rect) -> Arrangement {
        let [w, h] = self.sheets.steps[section][step].size_mm();
        let [above, below] = self.margins(section, step);
        let inner = Rect::new(cell.x + PAD, cell.y + above, cell.w - 2.0 * PAD, cell.h - above - below);
        let mut shrink = 1.0;
        loop {
            let mut entries = self.entries(section, step);
            entries.iter_mut().for_each(|entry| entry.size = entry.size.map(|v| v * shrink));
            let fitting = fits(&entries, [w, h], inner.w).into_iter().find(|fit| fit.height <= inner.h + 1e-6);
            if let Some(Fit { call_out, beside, clear, .. }) = fitting {
                let [left, top] =
                    if beside { [call_out.size[0] + GAP, 0.0] } else { [0.0, call_out.size[1] + GAP + clear] };
                let picture = Rect::new(
                    inner.x + left + 0.5 * (inner.w - left - w),
                    inner.y + top + 0.5 * (inner.h - top - h),
                    w,
                    h,
                );
                let number = [inner.x, inner.y + call_out.size[1] + NUMBER];
                return Arrangement { call_out, shrink, picture, number };
            }
            if shrink < 0.2 {
                // Nothing fits: the picture keeps its scale and may run under the call-out.
                let call_out = call_out(&entries, inner.w);
                let picture = Rect::new(inner.right() - w, inner.bottom() - h, w, h);
                let number = [inner.x, inner.y + call_out.size[1] + NUMBER];
                return Arrangement { call_out, shrink, picture, number };
            }
            shrink *= 0.8;
        }
    }

    fn step(&mut self, page: &mut Page, section: usize, step: usize, cell: &Rect, arrangement: &Arrangement) {
        let of_section = &self.plan.sections[section];
        let submodel = self.is_submodel(section);
        let (fill, line) = if submodel { (SUBMODEL, SUBMODEL_LINE) } else { ([255; 3], RULE) };
        page.elements.push(crate::page::Element::Box {
            rect: *cell,
            radius: 2.0,
            fill: Some(fill),
            line: Some((line, 0.3)),
        });
        if submodel && step == 0 {
            let band = Rect::new(cell.x, cell.y, cell.w, BAND);
            page.filled(band, 2.0, SUBMODEL_LINE);
            let times = format!("{}x", of_section.copies);
            let width = Weight::Bold.width(&times, 6.0);
            page.text([cell.x + PAD, cell.y + 6.8], 6.0, Weight::Bold, INK, Align::Left, times);
            let name = Weight::Regular.wrapped(&section_title(self.model, of_section), 3.6, cell.w - width - 12.0, 1);
            page.text(
                [cell.x + PAD + width + 4.0, cell.y + 6.2],
                3.6,
                Weight::Regular,
                INK,
                Align::Left,
                name.concat(),
            );
        }
        page.picture(arrangement.picture, PictureId::Step(section, step));
        let size = if submodel { 7.0 } else { 9.5 };
        let number = (step + 1).to_string();
        let number_width = Weight::Bold.width(&number, size);
        page.text(arrangement.number, size, Weight::Bold, INK, Align::Left, number);

        let call_out = &arrangement.call_out;
        let rect = Rect::new(cell.x + PAD, cell.y + self.margins(section, step)[0], call_out.size[0], call_out.size[1]);
        page.elements.push(crate::page::Element::Box {
            rect,
            radius: 1.8,
            fill: Some(CALL_OUT),
            line: Some((CALL_OUT_LINE, 0.3)),
        });
        for (entry, [x, y]) in self.entries(section, step).into_iter().zip(&call_out.places) {
            let [w, h] = entry.size.map(|v| v * arrangement.shrink);
            let (x, y) = (rect.x + x, rect.y + y);
            if entry.submodel {
                let ground = Rect::new(x - 0.8, y - 0.8, w + 1.6, h + 1.6);
                page.elements.push(crate::page::Element::Box {
                    rect: ground,
                    radius: 1.2,
                    fill: Some(SUBMODEL),
                    line: Some((SUBMODEL_LINE, 0.3)),
                });
            }
            page.picture(Rect::new(x, y, w, h), entry.id);
            let mut line = y + h + 4.0;
            page.text([x, line], 3.8, Weight::Bold, INK, Align::Left, entry.count.clone());
            if let Some(color) = &entry.color {
                line += 2.8;
                page.text([x, line], 2.3, Weight::Regular, INK, Align::Left, color.clone());
            }
        }

        let shots = &self.sheets.steps[section];
        if step > 0
            && let Some(turn) = shots[step - 1].sight.look.turn_to(&shots[step].sight.look)
        {
            self.view_changes += 1;
            let [x, y] = arrangement.number;
            signs::turn(page, [x + number_width + 8.0, y - 3.2], turn);
        }
        if self.ends_copies(section, step) {
            let times = format!("{}x", of_section.copies);
            page.text([cell.right() - PAD, cell.bottom() - PAD], 8.0, Weight::Bold, INK, Align::Right, times);
        }
    }

    fn back(&mut self, [w, h]: [f64; 2]) {
        if self.plan.sections.is_empty() {
            let mut page = Page { title: "Nothing to build".to_owned(), ..Page::default() };
            let middle = [0.5 * PAGE_MM[0], 0.5 * PAGE_MM[1]];
            page.text(
                middle,
                7.0,
                Weight::Bold,
                GREY,
                Align::Center,
                "This model has no parts: there is nothing to build",
            );
            self.pages.push(page);
            return;
        }
        let mut page = Page { title: "The finished model".to_owned(), ..Page::default() };
        page.filled(Rect::new(0.0, 0.0, PAGE_MM[0], PAGE_MM[1]), 0.0, [244, 247, 250]);
        page.text([0.5 * PAGE_MM[0], 20.0], 8.0, Weight::Bold, INK, Align::Center, "Finished");
        let middle = [0.5 * PAGE_MM[0], 0.5 * PAGE_MM[1] + 4.0];
        page.picture(Rect::new(middle[0] - 0.5 * w, middle[1] - 0.5 * h, w, h), PictureId::Back);
        self.pages.push(page);
    }

    /// Page numbers, outside, and how much is done.
    fn feet(&mut self) {
        let count = self.pages.len();
        for (index, page) in self.pages.iter_mut().enumerate().skip(1) {
            let y = PAGE_MM[1] - 3.6;
            let (x, align) = if index % 2 == 1 { (PAGE_MM[0] - MARGIN, Align::Right) } else { (MARGIN, Align::Left) };
            page.text([x, y], 4.0, Weight::Bold, GREY, align, (index + 1).to_string());
            let bar = Rect::new(MARGIN + 16.0, y - 1.6, PAGE_MM[0] - 2.0 * MARGIN - 32.0, 0.9);
            page.filled(bar, 0.45, RULE);
            let done = Rect::new(bar.x, bar.y, bar.w * (index + 1) as f64 / count as f64, bar.h);
            page.filled(done, 0.45, ACCENT);
        }
    }
}

/// Sorts `2 x 10` after `2 x 4`: numbers by value.
fn natural(text: &str) -> Vec<(u64, String)> {
    let mut key = vec![];
    for word in text.split_whitespace() {
        match word.parse::<u64>() {
            Ok(number) => key.push((number, String::new())),
            Err(_) => key.push((u64::MAX, word.to_lowercase())),
        }
    }
    key
}

/// A description without the marks that LDraw puts before some.
fn plain(description: &str) -> String {
    description.trim_start_matches(['~', '=', '_', '|']).split_whitespace().collect::<Vec<_>>().join(" ")
}

/// A file's name without folder and ending.
fn stem(name: &str) -> String {
    let name = name.rsplit('/').next().unwrap_or(name);
    name.strip_suffix(".dat").unwrap_or(name).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_sort_by_value() {
        let mut names = vec!["Brick  2 x 10", "Brick  2 x  4", "Arch  1 x  3"];
        names.sort_by_key(|name| natural(name));
        assert_eq!(names, ["Arch  1 x  3", "Brick  2 x  4", "Brick  2 x 10"]);
    }

    #[test]
    fn full_pages_of_even_rows_are_best() {
        let rows = |columns: &[usize]| columns.iter().map(|&columns| Row { columns, height: 60.0 }).collect::<Vec<_>>();
        let best_first = [rows(&[3, 3]), rows(&[1, 2, 3]), rows(&[2, 2]), rows(&[1, 3]), rows(&[3]), rows(&[1, 2])];
        assert!(best_first.windows(2).all(|pair| rank(&pair[0]) > rank(&pair[1])));
    }
}
