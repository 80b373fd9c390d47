//! Depth maps in OpenEXR files, as phone apps export them.

use std::io::Cursor;
use std::path::Path;

use exr::meta::MetaData;
use exr::prelude::{ReadChannels as _, ReadLayers as _, read};
use mb_geometry::ImageSize;
use mb_job::{InputError, Result};

use crate::io::MAX_PIXELS;
use crate::{DepthImage, Image};

/// Names that programs give to the channel of depth, most telling first.
const CHANNELS: [&str; 4] = ["Z", "R", "Y", "depth"];

/// Decodes a depth map in metres from an OpenEXR image of half or single floats: the channel `Z`, `R`, `Y` or `depth`, or
/// the only one. What is not finite or not above 0 becomes 0 (no value). `path` names it in errors.
///
/// # Errors
/// The bytes are damaged, hold no such channel, or are of more than [`MAX_PIXELS`].
pub fn decode_depth_exr(bytes: &[u8], path: &Path) -> Result<DepthImage> {
    let bad = |found: String| InputError::new(path, found);
    let damaged = |e: exr::error::Error| bad(format!("the OpenEXR image is damaged or truncated ({e})"));
    // Before anything is set aside for the pixels: a header can claim any size.
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(damaged)?;
    for header in &meta.headers {
        let pixels = header.layer_size.0.checked_mul(header.layer_size.1);
        if pixels.is_none_or(|n| n == 0 || n > MAX_PIXELS) {
            let (width, height) = (header.layer_size.0, header.layer_size.1);
            return Err(bad(format!("{width}x{height} pixels, allowed are 1 to {MAX_PIXELS}")).into());
        }
    }
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_buffered(Cursor::new(bytes))
        .map_err(damaged)?;
    let layer = &image.layer_data;
    let channels = &layer.channel_data.list;
    let named = CHANNELS.iter().find_map(|name| channels.iter().find(|c| c.name.eq_case_insensitive(name)));
    let channel = match (named, &channels[..]) {
        (Some(channel), _) | (None, [channel]) => channel,
        _ => {
            let names: Vec<String> = channels.iter().map(|c| c.name.to_string()).collect();
            return Err(bad(format!("none of its channels ({}) is depth", names.join(", "))).into());
        }
    };
    let size = ImageSize::new(layer.size.0, layer.size.1);
    let values = channel.sample_data.values_as_f32().map(|z| if z.is_finite() && z > 0.0 { z } else { 0.0 }).collect();
    Ok(Image::from_data(size, values).ok_or_else(|| bad("the channel of depth is subsampled".to_owned()))?)
}
