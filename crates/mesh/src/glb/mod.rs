//! Binary glTF 2.0 files (`.glb`): y up, right-handed, metres, like the object frame.

mod read;
mod write;

pub(crate) use read::parse;
pub use write::write_glb;

const MAGIC: u32 = u32::from_le_bytes(*b"glTF");
const JSON_CHUNK: u32 = u32::from_le_bytes(*b"JSON");
const BIN_CHUNK: u32 = u32::from_le_bytes(*b"BIN\0");

// Values of the specification.
const TRIANGLES: u64 = 4;
const TRIANGLE_STRIP: u64 = 5;
const TRIANGLE_FAN: u64 = 6;
const U8: u64 = 5121;
const U16: u64 = 5123;
const U32: u64 = 5125;
const F32: u64 = 5126;

/// glTF stores linear colours; meshes here hold 8-bit sRGB (IEC 61966-2-1).
fn srgb_from_linear(linear: f64) -> u8 {
    let v = linear.clamp(0.0, 1.0);
    let srgb = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    (srgb * 255.0).round() as u8
}

fn linear_from_srgb(srgb: u8) -> f64 {
    let v = f64::from(srgb) / 255.0;
    if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_round_trip_is_exact() {
        for v in 0..=255u8 {
            assert_eq!(srgb_from_linear(linear_from_srgb(v)), v);
            // Through the 16 bits that vertex colours get.
            assert_eq!(srgb_from_linear((linear_from_srgb(v) * 65535.0).round() / 65535.0), v);
        }
    }
}
