//! The report in one picture.

use image::imageops::{self, FilterType};
use mb_geometry::ImageSize;
use mb_image::RgbImage;

use super::Report;

const HEIGHT: u32 = 420;
const GAP: u32 = 12;

impl Report {
    /// One picture of each gallery side by side, for a README or a slide: the second where a gallery has several, as
    /// the first often shows what was given. `None` where the report has no pictures.
    pub fn overview(&self) -> Option<RgbImage> {
        let panels: Vec<image::RgbImage> = self
            .galleries
            .iter()
            .filter_map(|gallery| gallery.pictures.get(1).or_else(|| gallery.pictures.first()))
            .filter_map(|picture| {
                let size = picture.image.size();
                let bytes = picture.image.data().as_flattened().to_vec();
                let image = image::RgbImage::from_raw(size.width as u32, size.height as u32, bytes)?;
                let width = (u64::from(image.width()) * u64::from(HEIGHT) / u64::from(image.height().max(1))) as u32;
                Some(imageops::resize(&image, width.max(1), HEIGHT, FilterType::Triangle))
            })
            .collect();
        if panels.is_empty() {
            return None;
        }
        let width = panels.iter().map(|p| p.width() + GAP).sum::<u32>() - GAP;
        let mut canvas = image::RgbImage::from_pixel(width, HEIGHT, image::Rgb([255; 3]));
        let mut x = 0;
        for panel in &panels {
            imageops::replace(&mut canvas, panel, i64::from(x), 0);
            x += panel.width() + GAP;
        }
        let pixels = canvas.pixels().map(|p| p.0).collect();
        RgbImage::from_data(ImageSize::new(width as usize, HEIGHT as usize), pixels)
    }
}
