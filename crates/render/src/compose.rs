//! From the samples of a drawing to its pixels, tile by tile.

use mb_geometry::ImageSize;

use crate::View;
use crate::drawing::{Drawing, DrawingOptions, Layer};
use crate::view::Window;

/// What lines are painted with.
pub(crate) struct Brushes {
    line: Vec<(i64, i64)>,
    band: Vec<(i64, i64)>,
    band_rgb: [u8; 3],
    jump: f32,
}

impl Brushes {
    pub fn of(options: &DrawingOptions, samples: usize) -> Self {
        Self {
            line: disc(0.5 * options.line_px * samples as f64),
            band: disc(options.highlight_px * samples as f64),
            band_rgb: options.highlight,
            jump: options.jump as f32,
        }
    }

    /// Samples around a surface that its lines and its band may change, and one more.
    pub fn reach(&self) -> usize {
        let widest = self.line.iter().chain(&self.band).map(|(x, _)| x.unsigned_abs() as usize).max();
        widest.unwrap_or(0) + 2
    }
}

/// The samples within `radius` of a sample.
fn disc(radius: f64) -> Vec<(i64, i64)> {
    let reach = radius.ceil() as i64;
    let near = |&(x, y): &(i64, i64)| (x * x + y * y) as f64 <= radius * radius;
    (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| (x, y))).filter(near).collect()
}

/// The nearer of two depths, 0 being nothing.
pub(crate) fn nearer(a: f32, b: f32) -> f32 {
    if a == 0.0 || (b != 0.0 && b < a) { b } else { a }
}

/// The farthest depth at a sample and beside it: the surface under a line is sampled up to a pixel beside it. Infinite
/// where there is nothing; `i` is not at the border.
pub(crate) fn behind(i: usize, width: usize, depth: impl Fn(usize) -> f32) -> f32 {
    let far = |j: usize| if depth(j) == 0.0 { f32::INFINITY } else { depth(j) };
    [i + 1, i + width, i - 1, i - width].into_iter().fold(far(i), |a, j| a.max(far(j)))
}

/// Whether an edge at depth `z` shows before a surface at depth `behind`.
pub(crate) fn shows<F>(z: f32, behind: f32, fine: &View<F>) -> bool {
    f64::from(z) <= f64::from(behind) + 1.5 * f64::from(z) / fine.intrinsics.fx
}

/// A tile at full sampling with what can reach into it, while it is composed.
struct Sheet<'a, F> {
    drawing: &'a Drawing<F>,
    window: Window,
    pixels: Vec<[u8; 4]>,
    /// Depth of what is nearest so far; 0 where there is nothing.
    depth: Vec<f32>,
    /// Whether that belongs to a highlighted part.
    is_highlighted: Vec<bool>,
}

/// The pixels of a rectangle of the picture.
pub(crate) fn tile<F: Sync>(drawing: &Drawing<F>, window: &Window) -> Vec<[u8; 4]> {
    let (samples, reach) = (drawing.samples(), drawing.brushes().reach());
    let span = |first: usize, count: usize, limit: usize| {
        let start = (first * samples).saturating_sub(reach);
        (start, ((first + count) * samples + reach).min(limit) - start)
    };
    let full = drawing.fine().size;
    let (x, width) = span(window.x, window.size.width, full.width);
    let (y, height) = span(window.y, window.size.height, full.height);
    let count = width * height;
    let mut sheet = Sheet {
        drawing,
        window: Window { x, y, size: ImageSize::new(width, height) },
        pixels: vec![[0; 4]; count],
        depth: vec![0.0; count],
        is_highlighted: vec![false; count],
    };
    for layer in drawing.layers().into_iter().filter(|layer| layer.is_used) {
        sheet.layer(layer);
    }
    sheet.band();
    sheet.reduced(window)
}

impl<F: Sync> Sheet<'_, F> {
    /// Place of a sample of the sheet in the drawing.
    fn place(&self, i: usize) -> usize {
        let (x, y) = (i % self.window.size.width, i / self.window.size.width);
        (self.window.y + y) * self.drawing.fine().size.width + self.window.x + x
    }

    /// Draws a layer with its lines over what is there.
    fn layer(&mut self, layer: &Layer) {
        const NOTHING: u32 = u32::MAX;
        let ImageSize { width, height } = self.window.size;
        let mut part = vec![NOTHING; width * height];
        let mut fader = Fader::default();
        for i in 0..width * height {
            let at = self.place(i);
            let z = layer.depth[at];
            if z == 0.0 || (self.depth[i] != 0.0 && z > self.depth[i]) {
                continue;
            }
            let look = self.drawing.look(layer.part[at]);
            let [r, g, b, opacity] = layer.color[at];
            self.pixels[i] = over(fader.faded([r, g, b], look.fade), opacity, self.pixels[i]);
            (self.depth[i], self.is_highlighted[i], part[i]) = (z, look.highlighted, layer.part[at]);
        }
        let jump = self.drawing.brushes().jump;
        let mut lines = vec![];
        for i in 0..width * height {
            let (x, y) = (i % width, i / width);
            let neighbors = [(x + 1 < width).then_some(i + 1), (y + 1 < height).then_some(i + width)];
            for j in neighbors.into_iter().flatten() {
                let (a, b) = (part[i], part[j]);
                if a == b && (a == NOTHING || (self.depth[i] - self.depth[j]).abs() < jump) {
                    continue;
                }
                // The nearer surface owns the line.
                let i_is_nearer = a != NOTHING && (b == NOTHING || self.depth[i] <= self.depth[j]);
                lines.push(if i_is_nearer { (i, a) } else { (j, b) });
            }
        }
        let fine = self.drawing.fine();
        for y in 1..height.saturating_sub(1) {
            for i in y * width + 1..(y + 1) * width - 1 {
                let at = self.place(i);
                let z = layer.edge_depth[at];
                if z != 0.0 && shows(z, behind(i, width, |j| self.depth[j]), fine) {
                    lines.push((i, layer.edge_part[at]));
                }
            }
        }
        for (i, part) in lines {
            let look = self.drawing.look(part);
            let color = fader.faded(look.line, look.fade);
            self.stamp(i, &self.drawing.brushes().line, color, |_| true);
        }
    }

    /// The band around highlighted parts, outside of them.
    fn band(&mut self) {
        let ImageSize { width, height } = self.window.size;
        let marks = &self.is_highlighted;
        let is_border = |&i: &usize| {
            let (x, y) = (i % width, i / width);
            marks[i]
                && ((x > 0 && !marks[i - 1])
                    || (x + 1 < width && !marks[i + 1])
                    || (y > 0 && !marks[i - width])
                    || (y + 1 < height && !marks[i + width]))
        };
        let border: Vec<usize> = (0..width * height).filter(is_border).collect();
        let Brushes { band, band_rgb, .. } = self.drawing.brushes();
        for i in border {
            self.stamp(i, band, *band_rgb, |is_highlighted| !is_highlighted);
        }
    }

    /// Paints the samples around `i` whose highlight mark pleases.
    fn stamp(&mut self, i: usize, brush: &[(i64, i64)], color: [u8; 3], pleases: impl Fn(bool) -> bool) {
        let (width, height) = (self.window.size.width as i64, self.window.size.height as i64);
        let (x, y) = (i as i64 % width, i as i64 / width);
        for (dx, dy) in brush {
            let (x, y) = (x + dx, y + dy);
            if x >= 0 && y >= 0 && x < width && y < height {
                let j = (y * width + x) as usize;
                if pleases(self.is_highlighted[j]) {
                    self.pixels[j] = [color[0], color[1], color[2], 255];
                }
            }
        }
    }

    /// The mean of each pixel's samples.
    fn reduced(&self, window: &Window) -> Vec<[u8; 4]> {
        let (samples, width) = (self.drawing.samples(), self.window.size.width);
        let pixel = |i: usize| {
            let (x, y) = (window.x + i % window.size.width, window.y + i / window.size.width);
            let first = (y * samples - self.window.y) * width + x * samples - self.window.x;
            let mut sum = [0u32; 4];
            for sub in 0..samples * samples {
                let [r, g, b, a] = self.pixels[first + sub / samples * width + sub % samples].map(u32::from);
                sum = [sum[0] + r * a, sum[1] + g * a, sum[2] + b * a, sum[3] + a];
            }
            let [r, g, b, a] = sum;
            if a == 0 {
                return [0; 4];
            }
            let mean = |v: u32| ((v + a / 2) / a) as u8;
            let count = (samples * samples) as u32;
            [mean(r), mean(g), mean(b), ((a + count / 2) / count) as u8]
        };
        (0..window.size.pixels()).map(pixel).collect()
    }
}

/// Fades colours; remembers the last degree.
struct Fader {
    fade: f32,
    table: [u8; 256],
}

impl Default for Fader {
    fn default() -> Self {
        Self { fade: 0.0, table: std::array::from_fn(|v| v as u8) }
    }
}

impl Fader {
    fn faded(&mut self, rgb: [u8; 3], fade: f32) -> [u8; 3] {
        if fade == 0.0 {
            return rgb;
        }
        if fade != self.fade {
            self.fade = fade;
            self.table = std::array::from_fn(|v| (v as f32 + (255.0 - v as f32) * fade).round() as u8);
        }
        rgb.map(|v| self.table[usize::from(v)])
    }
}

/// One colour over another; what was empty becomes opaque where the upper is.
fn over(color: [u8; 3], opacity: u8, below: [u8; 4]) -> [u8; 4] {
    let [r, g, b, a] = below;
    // Clear bricks on nothing are drawn on white: paper shines through them.
    let ground = if a == 0 { [255; 3] } else { [r, g, b] };
    let mix = |c: usize| {
        let (upper, lower) = (u32::from(color[c]), u32::from(ground[c]));
        ((upper * u32::from(opacity) + lower * (255 - u32::from(opacity)) + 127) / 255) as u8
    };
    [mix(0), mix(1), mix(2), 255]
}
