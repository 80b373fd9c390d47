//! Print: a newspaper spread under the model, and small printed things beside it.

use glam::Vec3;

use super::{Finish, kept, mix, smoothstep};
use crate::random::{fractal, hash, noise, unit};

/// How much ink lies at a place of a line of text whose letters are `size_m` high: words of strokes that look like
/// letters at reading distance.
fn text(x: f32, y: f32, size_m: f32, pixel_m: f32, salt: u32) -> f32 {
    let pitch_m = 1.55 * size_m;
    let line = (y / pitch_m).floor();
    let up = (y / pitch_m - line) * 1.55;
    if !(0.0..1.0).contains(&up) {
        return 0.0;
    }
    let letter_m = 0.62 * size_m;
    let along = x / letter_m + 7.0 * unit(hash(line as i32, 2, salt));
    let letter = along.floor();
    let own = hash(letter as i32, line as i32, salt);
    // A sixth of the places are blanks between words.
    if own.is_multiple_of(6) {
        return 0.0;
    }
    let t = along - letter;
    // An upright, a bar, a bowl: two of four strokes each.
    let upright = smoothstep(0.16, 0.06, (t - 0.25).abs());
    let second = smoothstep(0.16, 0.06, (t - 0.7).abs());
    let bar_at = 0.2 + 0.6 * unit(own ^ 3);
    let bar = smoothstep(0.13, 0.04, (up - bar_at).abs()) * smoothstep(0.95, 0.85, t);
    let low = if own & 16 == 0 { smoothstep(0.62, 0.58, up) } else { 1.0 };
    let strokes = match own % 4 {
        0 => upright.max(bar),
        1 => upright.max(second) * 0.95,
        2 => bar.max(second),
        _ => upright.max(smoothstep(0.14, 0.05, (up - 0.08).abs()).max(bar)),
    };
    let seen = kept(0.3 * size_m, pixel_m);
    low * (seen * strokes + (1.0 - seen) * 0.34)
}

/// A newspaper: columns of text, headlines and grey pictures.
pub(super) fn newspaper((x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    const COLUMN_M: f32 = 0.047;
    const BLOCK_M: f32 = 0.062;
    let column = (x / COLUMN_M).floor();
    let inside = x - column * COLUMN_M;
    let shifted = y + BLOCK_M * unit(hash(column as i32, 9, salt));
    let block = (shifted / BLOCK_M).floor();
    let (down, own) = (shifted - block * BLOCK_M, hash(column as i32, block as i32, salt));
    let paper = Vec3::new(0.66, 0.635, 0.57) * (0.94 + 0.12 * fractal(x * 60.0, y * 60.0, 3, 0.6, salt ^ 1));
    let fibre = kept(0.0004, pixel_m) * 0.10 * (noise(x * 1400.0, y * 1700.0, salt ^ 2) - 0.5);
    let mut ink = 0.0;
    let mut color = paper * (1.0 + fibre);
    let margin = inside > 0.003 && inside < COLUMN_M - 0.003;
    if margin && own.is_multiple_of(4) {
        // A picture in print dots.
        if down > 0.004 && down < BLOCK_M - 0.010 {
            let tone = fractal(x * 55.0, y * 55.0, 4, 0.6, own);
            let subject = smoothstep(0.012, 0.008, (inside - 0.5 * COLUMN_M).hypot(down - 0.022) * (0.6 + unit(own)));
            let tint =
                mix(Vec3::splat(0.12), Vec3::new(0.16, 0.07 + 0.1 * unit(own ^ 8), 0.05 + 0.2 * unit(own ^ 9)), 0.6);
            let dark = smoothstep(0.25, 0.75, tone) * 0.8 + 0.3 * subject;
            color = mix(color, tint, dark.min(0.95));
        } else if down >= BLOCK_M - 0.008 {
            ink = text(inside, down, 0.0016, pixel_m, own);
        }
    } else if margin {
        let headline = own % 3 == 1 && down < 0.013;
        ink = if headline {
            text(inside, down - 0.002, 0.0062, pixel_m, own) * f32::from(down > 0.002)
        } else {
            text(inside, down, 0.0019, pixel_m, own)
        };
    } else if inside < 0.0006 {
        // The rule between columns.
        ink = 0.5 * kept(0.0006, pixel_m);
    }
    color = mix(color, Vec3::splat(0.055), 0.92 * ink);
    // Folds, and paper that does not lie flat.
    let fold = smoothstep(0.004, 0.0, (y - 0.01).abs()) * (y - 0.01).signum();
    let slope = (
        0.05 * (noise(x * 18.0, y * 18.0, salt ^ 4) - 0.5),
        0.18 * fold + 0.05 * (noise(x * 18.0, y * 18.0, salt ^ 5) - 0.5),
    );
    Finish { albedo: color, roughness: 0.8, coat: 0.3, slope }
}

/// A booklet or a card: flat colour with blocks of text.
pub(super) fn booklet(base: Vec3, (x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    let block = noise(x * 22.0, y * 22.0, salt ^ 1) > 0.45;
    let ink = if block { text(x, y, 0.0024, pixel_m, salt) } else { 0.0 };
    let contrast = if base.element_sum() > 0.6 { Vec3::splat(0.05) } else { Vec3::splat(0.7) };
    Finish { albedo: mix(base, contrast, 0.85 * ink), roughness: 0.45, coat: 0.7, slope: (0.0, 0.0) }
}
