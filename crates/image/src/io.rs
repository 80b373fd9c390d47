//! PNG and JPEG files.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ColorType, DynamicImage, ExtendedColorType, ImageEncoder, ImageReader};
use mb_geometry::ImageSize;
use mb_job::{InputError, Result, write_atomic_with};

use crate::{Confidence, DepthImage, Image, Mask, RgbImage};

/// Larger images are refused before they are decoded (a decompression bomb, not a photograph).
pub const MAX_PIXELS: usize = 200_000_000;

fn open(path: &Path) -> Result<ImageReader<BufReader<File>>> {
    let file = File::open(path).map_err(|e| InputError::unreadable(path, &e))?;
    let reader =
        ImageReader::new(BufReader::new(file)).with_guessed_format().map_err(|e| InputError::unreadable(path, &e))?;
    if reader.format().is_none() {
        return Err(InputError::new(path, "neither a PNG nor a JPEG image").into());
    }
    Ok(reader)
}

/// The size of a PNG or JPEG file, from its header alone.
///
/// # Errors
/// The file is missing, damaged, no PNG or JPEG, empty, or beyond [`MAX_PIXELS`].
pub fn read_size(path: impl AsRef<Path>) -> Result<ImageSize> {
    let path = path.as_ref();
    let (width, height) = open(path)?.into_dimensions().map_err(|e| damaged(path, &e))?;
    let size = ImageSize::new(width as usize, height as usize);
    if size.pixels() == 0 {
        return Err(InputError::new(path, "the image has no pixels").into());
    }
    if size.pixels() > MAX_PIXELS {
        return Err(InputError::new(path, format!("{size} pixels, more than the {MAX_PIXELS} allowed")).into());
    }
    Ok(size)
}

fn decode(path: &Path) -> Result<DynamicImage> {
    read_size(path)?;
    Ok(open(path)?.decode().map_err(|e| damaged(path, &e))?)
}

fn damaged(path: &Path, e: &image::ImageError) -> InputError {
    InputError::new(path, format!("the image is damaged or truncated ({e})")).help("Copy or export the file again")
}

fn size_of(image: &DynamicImage) -> ImageSize {
    ImageSize::new(image.width() as usize, image.height() as usize)
}

fn with_size<P>(size: ImageSize, data: Vec<P>) -> Image<P> {
    Image::from_data(size, data).expect("a decoder returns width * height pixels")
}

/// Reads a PNG or JPEG photograph as 8-bit RGB; grey is spread over the channels, alpha is dropped.
///
/// # Errors
/// The file is missing, damaged, or no PNG or JPEG.
pub fn read_rgb(path: impl AsRef<Path>) -> Result<RgbImage> {
    let image = decode(path.as_ref())?;
    let size = size_of(&image);
    let pixels = image.into_rgb8().into_raw().chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    Ok(with_size(size, pixels))
}

/// Decodes a PNG or JPEG photograph that is in memory as 8-bit RGB; grey is spread over the channels, alpha is
/// dropped. `path` names it in errors.
///
/// # Errors
/// The bytes are damaged, no PNG or JPEG, or of more than [`MAX_PIXELS`].
pub fn decode_rgb(bytes: &[u8], path: &Path) -> Result<RgbImage> {
    let reader = || {
        let reader = ImageReader::new(std::io::Cursor::new(bytes))
            .with_guessed_format()
            .map_err(|e| InputError::unreadable(path, &e))?;
        match reader.format() {
            Some(_) => Ok(reader),
            None => Err(InputError::new(path, "neither a PNG nor a JPEG image")),
        }
    };
    let (width, height) = reader()?.into_dimensions().map_err(|e| damaged(path, &e))?;
    let size = ImageSize::new(width as usize, height as usize);
    if size.pixels() == 0 || size.pixels() > MAX_PIXELS {
        return Err(InputError::new(path, format!("{size} pixels, allowed are 1 to {MAX_PIXELS}")).into());
    }
    let image = reader()?.decode().map_err(|e| damaged(path, &e))?;
    let pixels = image.into_rgb8().into_raw().chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    Ok(with_size(size, pixels))
}

/// Reads a PNG or JPEG photograph as sRGB fractions of full scale, in [0, 1], keeping all bits: 8-bit values are
/// divided by 255, 16-bit values by 65535. Grey is spread over the channels; an alpha channel must be opaque throughout.
///
/// # Errors
/// The file is missing, damaged, no PNG or JPEG, or transparent somewhere (its colour would depend on what lies behind).
pub fn read_rgb_fraction(path: impl AsRef<Path>) -> Result<Image<[f32; 3]>> {
    let path = path.as_ref();
    let image = decode(path)?;
    let size = size_of(&image);
    if image.color().has_alpha() {
        let alpha = image.to_rgba16();
        if let Some((x, y, _)) = alpha.enumerate_pixels().find(|(_, _, p)| p[3] != u16::MAX) {
            return Err(InputError::new(path, "the image is transparent here, so its colour is not defined")
                .at(format!("pixel ({x}, {y})"))
                .help("Put it over the background that it should be seen against, and save it without alpha")
                .into());
        }
    }
    let pixels = if matches!(image.color(), ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16) {
        image
            .into_rgb16()
            .into_raw()
            .chunks_exact(3)
            .map(|p| [p[0], p[1], p[2]].map(|v| f32::from(v) / 65535.0))
            .collect()
    } else {
        image.into_rgb8().into_raw().chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0)).collect()
    };
    Ok(with_size(size, pixels))
}

/// Reads a depth map: a 16-bit grey PNG in millimetres, 0 = no value. Returns metres.
///
/// # Errors
/// The file is missing, damaged, or not 16-bit grey.
pub fn read_depth_png(path: impl AsRef<Path>) -> Result<DepthImage> {
    Ok(read_depth_png_mm(path)?.map(|&mm| f32::from(mm) * 1e-3))
}

/// Reads a depth map as the whole millimetres on disk, 0 = no value.
///
/// # Errors
/// The file is missing, damaged, or not 16-bit grey.
pub fn read_depth_png_mm(path: impl AsRef<Path>) -> Result<Image<u16>> {
    let path = path.as_ref();
    let image = decode(path)?;
    let size = size_of(&image);
    match image {
        DynamicImage::ImageLuma16(grey) => Ok(with_size(size, grey.into_raw())),
        other => Err(InputError::new(path, format!("a depth map must be 16-bit grey, this is {:?}", other.color()))
            .help("Depth is stored as a 16-bit PNG in millimetres, 0 = no value")
            .into()),
    }
}

/// Whether a file is an image of 16-bit grey, as depth maps are, by its header alone.
pub fn is_grey16(path: impl AsRef<Path>) -> bool {
    let decoder = open(path.as_ref()).ok().and_then(|reader| reader.into_decoder().ok());
    decoder.is_some_and(|decoder| image::ImageDecoder::color_type(&decoder) == ColorType::L16)
}

/// Reads a LiDAR confidence map: an 8-bit grey PNG with the values 0, 1, 2.
///
/// # Errors
/// The file is missing, damaged, not 8-bit grey, or holds another value.
pub fn read_confidence_png(path: impl AsRef<Path>) -> Result<Confidence> {
    let path = path.as_ref();
    let image = decode(path)?;
    let size = size_of(&image);
    let DynamicImage::ImageLuma8(grey) = image else {
        return Err(
            InputError::new(path, format!("a confidence map must be 8-bit grey, this is {:?}", image.color())).into()
        );
    };
    let data = grey.into_raw();
    match data.iter().position(|&c| c > 2) {
        None => Ok(with_size(size, data)),
        Some(i) => Err(InputError::new(path, format!("confidence {} found, expected 0, 1 or 2", data[i]))
            .at(format!("pixel ({}, {})", i % size.width, i / size.width))
            .into()),
    }
}

/// Reads a mask: any image, true where its brightness is at least half.
///
/// # Errors
/// The file is missing or damaged.
pub fn read_mask_png(path: impl AsRef<Path>) -> Result<Mask> {
    let image = decode(path.as_ref())?;
    let size = size_of(&image);
    Ok(with_size(size, image.into_luma8().into_raw().into_iter().map(|v| v >= 128).collect()))
}

fn write_png(path: &Path, size: ImageSize, bytes: &[u8], color: ExtendedColorType) -> Result<()> {
    write_atomic_with(path, |out| {
        // Depth maps compress to a third with the up filter; the slower settings gain little.
        PngEncoder::new_with_quality(out, CompressionType::Fast, FilterType::Adaptive)
            .write_image(bytes, size.width as u32, size.height as u32, color)
            .map_err(std::io::Error::other)
    })
}

/// Writes depth in metres as a 16-bit PNG in millimetres, rounded to nearest. What is not finite, not above 0 or
/// beyond 65.535 m becomes 0 (no value).
///
/// # Errors
/// The file cannot be written.
pub fn write_depth_png(path: impl AsRef<Path>, depth: &DepthImage) -> Result<()> {
    let bytes: Vec<u8> = depth
        .data()
        .iter()
        .flat_map(|&z| {
            let mm = (f64::from(z) * 1e3).round();
            (if (1.0..=65535.0).contains(&mm) { mm as u16 } else { 0 }).to_ne_bytes()
        })
        .collect();
    write_png(path.as_ref(), depth.size(), &bytes, ExtendedColorType::L16)
}

/// Writes a confidence map as an 8-bit grey PNG.
///
/// # Errors
/// The file cannot be written.
pub fn write_confidence_png(path: impl AsRef<Path>, confidence: &Confidence) -> Result<()> {
    write_png(path.as_ref(), confidence.size(), confidence.data(), ExtendedColorType::L8)
}

/// Writes a mask as an 8-bit grey PNG, 255 = object.
///
/// # Errors
/// The file cannot be written.
pub fn write_mask_png(path: impl AsRef<Path>, mask: &Mask) -> Result<()> {
    let bytes: Vec<u8> = mask.data().iter().map(|&m| if m { 255 } else { 0 }).collect();
    write_png(path.as_ref(), mask.size(), &bytes, ExtendedColorType::L8)
}

/// Writes an 8-bit RGB PNG.
///
/// # Errors
/// The file cannot be written.
pub fn write_rgb_png(path: impl AsRef<Path>, image: &RgbImage) -> Result<()> {
    write_png(path.as_ref(), image.size(), image.data().as_flattened(), ExtendedColorType::Rgb8)
}

/// Writes a JPEG with `quality` from 1 to 100.
///
/// # Errors
/// The file cannot be written.
pub fn write_jpeg(path: impl AsRef<Path>, image: &RgbImage, quality: u8) -> Result<()> {
    let size = image.size();
    write_atomic_with(path, |out| {
        JpegEncoder::new_with_quality(out, quality)
            .write_image(image.data().as_flattened(), size.width as u32, size.height as u32, ExtendedColorType::Rgb8)
            .map_err(std::io::Error::other)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_survives_to_half_a_millimetre_and_bad_values_become_none() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("depth.png");
        let values = [0.0, 0.3004, 0.3006, 65.535, 65.6, -1.0, f32::NAN, f32::INFINITY];
        let depth = Image::from_data(ImageSize::new(4, 2), values.to_vec()).unwrap();
        write_depth_png(&path, &depth).unwrap();
        let expected = [0.0, 0.3, 0.301, 65.535, 0.0, 0.0, 0.0, 0.0];
        for (found, expected) in read_depth_png(&path).unwrap().data().iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{found} is not {expected}");
        }
    }

    #[test]
    fn rgb_png_round_trip_is_exact() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("image.png");
        let image = Image::from_fn(ImageSize::new(7, 5), |x, y| [x as u8 * 30, y as u8 * 50, (x * y) as u8]);
        write_rgb_png(&path, &image).unwrap();
        assert_eq!(read_rgb(&path).unwrap(), image);
    }

    #[test]
    fn damaged_files_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("image.png");
        write_rgb_png(&path, &Image::filled(ImageSize::new(64, 64), [1, 2, 3])).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for cut in [0, 7, 20, whole.len() / 2] {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let message = read_rgb(&path).unwrap_err().to_string();
            assert!(message.contains("image.png"), "{message}");
        }
        assert!(read_rgb(dir.path().join("none.png")).unwrap_err().to_string().contains("no such file"));
        write_rgb_png(&path, &Image::filled(ImageSize::new(4, 4), [1, 2, 3])).unwrap();
        assert!(read_depth_png(&path).unwrap_err().to_string().contains("16-bit"));
    }
}
