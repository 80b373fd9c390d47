//! Where everything stands on the pages.

use std::collections::BTreeMap;

use mb_bricks::{ColorCode, Model};

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

const MARGIN: f64 = 8.0;
const FOOT: f64 = 10.0;
const GAP: f64 = 3.0;
/// Space inside a cell.
const PAD: f64 = 3.0;
/// The band over the first step of a submodel.
const BAND: f64 = 9.0;
/// Two colours closer than this are named where they are used (CIE 1976 difference; 2.3 is just noticeable).
const SIMILAR_COLORS: f64 = 26.0;
/// Columns and rows of steps on a page, the fullest first.
const GRIDS: [[usize; 2]; 5] = [[3, 2], [2, 2], [3, 1], [2, 1], [1, 1]];

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

/// A piece in a call-out.
struct Entry {
    id: PictureId,
    size: [f64; 2],
    count: String,
    color: Option<String>,
    submodel: bool,
}

impl Entry {
    fn width(&self) -> f64 {
        let name = self.color.as_ref().map_or(0.0, |name| Weight::Regular.width(name, 2.3));
        self.size[0].max(Weight::Bold.width(&self.count, 3.8)).max(name)
    }

    fn height(&self) -> f64 {
        self.size[1] + 4.6 + if self.color.is_some() { 2.8 } else { 0.0 }
    }
}

/// A call-out: its size and where its entries stand in it.
struct CallOut {
    size: [f64; 2],
    places: Vec<[f64; 2]>,
}

/// How a step fills its cell.
struct Arrangement {
    call_out: CallOut,
    shrink: f64,
    picture: Rect,
    number: [f64; 2],
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
        self.pages.push(page);
    }

    fn parts_list(&mut self) {
        const COLUMNS: usize = 6;
        let width = (PAGE_MM[0] - 2.0 * MARGIN) / COLUMNS as f64;
        let mut totals = self.plan.totals();
        // Colours together, as parts are sorted by hand; within a colour by what they are.
        totals.sort_by_key(|((part, color), _)| {
            (self.model.colors().look(*color).name, natural(&self.model.file(*part).description), *part, *color)
        });
        let (top, bottom) = (24.0, PAGE_MM[1] - FOOT - 4.0);
        let mut page = Page::default();
        let mut y = f64::INFINITY;
        for row in totals.chunks(COLUMNS) {
            let pictures = row.iter().map(|((part, color), _)| self.shot(PieceKind::Part(*part, *color)).size_mm());
            let height = pictures.map(|size| size[1]).fold(0.0, f64::max) + 17.5;
            if y + height > bottom {
                let first = self.pages.len() == 1 && page.elements.is_empty();
                if !page.elements.is_empty() {
                    self.pages.push(std::mem::take(&mut page));
                }
                page.title = "Parts".to_owned();
                page.text([MARGIN + 2.0, 17.0], 8.0, Weight::Bold, INK, Align::Left, "Parts");
                if first {
                    let count: usize = totals.iter().map(|(_, count)| count).sum();
                    let sum = format!("{count} in all, {} different", totals.len());
                    page.text([PAGE_MM[0] - MARGIN - 2.0, 17.0], 4.0, Weight::Regular, GREY, Align::Right, sum);
                }
                y = top;
            }
            for (column, ((part, color), count)) in row.iter().enumerate() {
                let kind = PieceKind::Part(*part, *color);
                let [w, h] = self.shot(kind).size_mm();
                let left = MARGIN + column as f64 * width + 2.0;
                let base = y + height - 17.5;
                page.picture(Rect::new(left + 0.5 * (width - 4.0 - w), base - h, w, h), PictureId::Piece(kind));
                page.text([left, base + 4.6], 4.4, Weight::Bold, INK, Align::Left, format!("{count}x"));
                let look = self.model.colors().look(*color);
                let swatch = Rect::new(left + 12.0, base + 1.6, 3.2, 3.2);
                let line = Some((crate::geometry::line_rgb(look.rgb), 0.15));
                page.elements.push(crate::page::Element::Box { rect: swatch, radius: 0.5, fill: Some(look.rgb), line });
                let name = Weight::Regular.wrapped(&look.name, 2.7, width - 20.5, 1);
                page.text([left + 16.4, base + 4.2], 2.7, Weight::Regular, INK, Align::Left, name.concat());
                let file = self.model.file(*part);
                let mut line = base + 8.2;
                for text in Weight::Regular.wrapped(&plain(&file.description), 2.5, width - 5.0, 2) {
                    page.text([left, line], 2.5, Weight::Regular, INK, Align::Left, text);
                    line += 3.0;
                }
                let number = Weight::Regular.wrapped(&stem(&file.name), 2.3, width - 5.0, 1).concat();
                page.text([left, line], 2.3, Weight::Regular, GREY, Align::Left, number);
            }
            y += height;
        }
        if !page.elements.is_empty() {
            self.pages.push(page);
        }
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
            let cells = |[columns, rows]: [usize; 2]| {
                let (w, h) = (
                    (area.w - GAP * (columns - 1) as f64) / columns as f64,
                    (area.h - GAP * (rows - 1) as f64) / rows as f64,
                );
                (0..columns * rows).map(move |i| {
                    let (column, row) = ((i % columns) as f64, (i / columns) as f64);
                    Rect::new(area.x + column * (w + GAP), area.y + row * (h + GAP), w, h)
                })
            };
            let fits = |grid: [usize; 2]| {
                let arranged: Option<Vec<(Rect, Arrangement)>> = left
                    .iter()
                    .zip(cells(grid))
                    .map(|(&(section, step), cell)| Some((cell, self.arrange(section, step, &cell, false)?)))
                    .collect();
                // A grid that the last steps leave half empty is the wrong one.
                arranged.filter(|a| a.len() * 2 > grid[0] * grid[1] || grid == [1, 1])
            };
            let arranged = GRIDS.into_iter().find_map(fits).unwrap_or_else(|| {
                let (section, step) = left[0];
                self.arrange(section, step, &area, true).map(|a| (area, a)).into_iter().collect()
            });
            let mut page = Page { title: format!("Page {}", self.pages.len() + 1), ..Page::default() };
            let count = arranged.len().max(1);
            for (index, (cell, arrangement)) in arranged.into_iter().enumerate() {
                let (section, step) = self.plan.order[at + index];
                self.step(&mut page, section, step, &cell, &arrangement);
            }
            at += count;
            self.pages.push(page);
        }
    }

    /// Whether this is a submodel, and so stands on coloured ground.
    fn is_submodel(&self, section: usize) -> bool {
        section + 1 != self.plan.sections.len()
    }

    /// How a step fits into a cell; `None` where it does not. With `force` the call-out shrinks until it does.
    fn arrange(&self, section: usize, step: usize, cell: &Rect, force: bool) -> Option<Arrangement> {
        let [w, h] = self.sheets.steps[section][step].size_mm();
        let mut inner = cell.inset(PAD);
        if self.is_submodel(section) && step == 0 {
            inner.y += BAND;
            inner.h -= BAND;
        }
        let number_h = 11.0;
        let mut shrink = 1.0;
        loop {
            let entries: Vec<Entry> = self
                .entries(section, step)
                .into_iter()
                .map(|mut e| {
                    e.size = e.size.map(|v| v * shrink);
                    e
                })
                .collect();
            // The call-out above the picture, or beside it.
            let above = call_out(&entries, inner.w);
            let room = inner.h - above.size[1] - GAP;
            // The corner of a slanted picture leaves room for the number.
            let clear = if w + 2.0 * 16.0 <= inner.w { 0.0 } else { 0.45 * number_h };
            if w <= inner.w && h + clear <= room && above.size[0] <= inner.w {
                let y = inner.y + above.size[1] + GAP + clear + 0.5 * (room - clear - h);
                let picture = Rect::new(inner.x + 0.5 * (inner.w - w), y, w, h);
                let number = [inner.x, inner.y + above.size[1] + number_h];
                return Some(Arrangement { call_out: above, shrink, picture, number });
            }
            let widest = entries.iter().map(Entry::width).fold(0.0, f64::max) + 2.0 * PAD;
            for columns in 1..=2 {
                let beside = call_out(&entries, (widest * f64::from(columns)).max(26.0));
                let room = inner.w - beside.size[0] - GAP;
                if w <= room && h <= inner.h && beside.size[1] + number_h <= inner.h {
                    let x = inner.x + beside.size[0] + GAP + 0.5 * (room - w);
                    let picture = Rect::new(x, inner.y + 0.5 * (inner.h - h), w, h);
                    let number = [inner.x, inner.y + beside.size[1] + number_h];
                    return Some(Arrangement { call_out: beside, shrink, picture, number });
                }
            }
            if !force {
                return None;
            }
            if shrink < 0.2 {
                // Nothing fits: the picture keeps its scale and may run under the call-out.
                let picture = Rect::new(inner.right() - w, inner.bottom() - h, w, h);
                let number = [inner.x, inner.y + above.size[1] + number_h];
                return Some(Arrangement { call_out: above, shrink, picture, number });
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
        let inner_y = if submodel && step == 0 { cell.y + BAND + PAD } else { cell.y + PAD };
        let rect = Rect::new(cell.x + PAD, inner_y, call_out.size[0], call_out.size[1]);
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
            && let Some(turn) = shots[step - 1].look.turn_to(&shots[step].look)
        {
            self.view_changes += 1;
            let [x, y] = arrangement.number;
            signs::turn(page, [x + number_width + 8.0, y - 3.2], turn);
        }
        if submodel && of_section.copies > 1 && step + 1 == of_section.steps.len() {
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

/// Entries in rows no wider than `width`.
fn call_out(entries: &[Entry], width: f64) -> CallOut {
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

/// The colours of a plan that look like another one of it.
fn similar_colors(model: &Model, plan: &Plan) -> Vec<ColorCode> {
    let mut used: Vec<ColorCode> = plan.totals().iter().map(|((_, color), _)| *color).collect();
    used.sort_unstable();
    used.dedup();
    let looks: BTreeMap<ColorCode, ([f64; 3], u8)> = used
        .iter()
        .map(|&code| {
            let look = model.colors().look(code);
            (code, (lab(look.rgb), look.alpha))
        })
        .collect();
    let similar = |a: &ColorCode, b: &ColorCode| {
        let ((x, x_alpha), (y, y_alpha)) = (looks[a], looks[b]);
        let difference = (0..3).map(|i| (x[i] - y[i]).powi(2)).sum::<f64>().sqrt();
        a != b && (x_alpha < 255) == (y_alpha < 255) && difference < SIMILAR_COLORS
    };
    used.iter().filter(|a| used.iter().any(|b| similar(a, b))).copied().collect()
}

/// CIE L*a*b* of an sRGB colour under D65.
fn lab(rgb: Rgb) -> [f64; 3] {
    let linear = rgb.map(|v| {
        let v = f64::from(v) / 255.0;
        if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    });
    let dot = |row: [f64; 3]| row.iter().zip(linear).map(|(a, b)| a * b).sum::<f64>();
    let x = dot([0.4124, 0.3576, 0.1805]) / 0.950_47;
    let y = dot([0.2126, 0.7152, 0.0722]);
    let z = dot([0.0193, 0.1192, 0.9505]) / 1.088_83;
    let f = |t: f64| if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 };
    [116.0 * f(y) - 16.0, 500.0 * (f(x) - f(y)), 200.0 * (f(y) - f(z))]
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
    fn numbers_sort_by_value_and_similar_greys_are_named() {
        let mut names = vec!["Brick  2 x 10", "Brick  2 x  4", "Arch  1 x  3"];
        names.sort_by_key(|name| natural(name));
        assert_eq!(names, ["Arch  1 x  3", "Brick  2 x  4", "Brick  2 x 10"]);
        let text = "1 71 0 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n1 7 40 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n\
                    1 4 80 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n";
        let model = Model::from_text(text, "greys.ldr", None).unwrap();
        assert_eq!(similar_colors(&model, &Plan::of(&model)), [ColorCode(7), ColorCode(71)]);
    }

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
