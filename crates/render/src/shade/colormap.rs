//! Colours for numbers.

/// Ten evenly spaced colours of viridis (van der Walt and Smith 2015, CC0): even steps look even, also in grey and to
/// colour-blind eyes.
const VIRIDIS: [[u8; 3]; 10] = [
    [0x44, 0x01, 0x54],
    [0x48, 0x28, 0x78],
    [0x3e, 0x49, 0x89],
    [0x31, 0x68, 0x8e],
    [0x26, 0x82, 0x8e],
    [0x1f, 0x9e, 0x89],
    [0x35, 0xb7, 0x79],
    [0x6e, 0xce, 0x58],
    [0xb5, 0xde, 0x2b],
    [0xfd, 0xe7, 0x25],
];

/// Colours (8-bit sRGB) for values on a scale from `low` (dark violet) to `high` (yellow); what is beyond gets the end's
/// colour, and what is no number gets grey. Pictures with the same scale can be compared.
pub fn heat_colors(values: &[f64], low: f64, high: f64) -> Vec<[u8; 3]> {
    let last = (VIRIDIS.len() - 1) as f64;
    values
        .iter()
        .map(|value| {
            let share = (value - low) / (high - low);
            if share.is_nan() {
                return [128; 3];
            }
            let at = share.clamp(0.0, 1.0) * last;
            let step = (at as usize).min(VIRIDIS.len() - 2);
            let mix = at - step as f64;
            std::array::from_fn(|channel| {
                let [from, to] = [VIRIDIS[step][channel], VIRIDIS[step + 1][channel]].map(f64::from);
                (from + (to - from) * mix).round() as u8
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_is_kept_and_its_ends_hold() {
        let colors = heat_colors(&[0.0, 5.0, -1.0, 99.0, f64::NAN, 0.5], 0.0, 5.0);
        assert_eq!(colors[..5], [VIRIDIS[0], VIRIDIS[9], VIRIDIS[0], VIRIDIS[9], [128; 3]]);
        // A tenth of the scale: nine tenths of the way to the second colour.
        assert_eq!(colors[5], [0x48, 0x24, 0x74]);
    }
}
