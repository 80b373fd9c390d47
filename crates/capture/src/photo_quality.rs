//! Sharpness and exposure of a photograph, from its luma alone.

use mb_image::RgbImage;

/// What can be said of a photograph without knowing what it shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PhotoQuality {
    /// Mean absolute difference of neighbouring pixels' luma, along rows and columns, 0 to 255. Blur lowers it; only
    /// photographs of one scene can be compared.
    pub sharpness: f64,
    /// Mean luma, 0 to 255.
    pub brightness: f64,
    /// Share of pixels with luma below 4 or above 251.
    pub clipped: f64,
}

impl PhotoQuality {
    pub fn of(photo: &RgbImage) -> Self {
        let luma = |p: &[u8; 3]| 0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2]);
        let (mut gradient, mut sum, mut clipped) = (0.0f64, 0.0f64, 0usize);
        let mut above: Vec<f32> = Vec::new();
        for y in 0..photo.height() {
            let row: Vec<f32> = photo.row(y).iter().map(luma).collect();
            let along: f32 = row.windows(2).map(|pair| (pair[1] - pair[0]).abs()).sum();
            let across: f32 = row.iter().zip(&above).map(|(a, b)| (a - b).abs()).sum();
            gradient += f64::from(along) + f64::from(across);
            sum += f64::from(row.iter().sum::<f32>());
            clipped += row.iter().filter(|v| **v < 4.0 || **v > 251.0).count();
            above = row;
        }
        let pixels = photo.size().pixels() as f64;
        Self { sharpness: 0.5 * gradient / pixels, brightness: sum / pixels, clipped: clipped as f64 / pixels }
    }
}
