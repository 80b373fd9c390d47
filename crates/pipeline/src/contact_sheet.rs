//! Many models in one picture.

use mb_geometry::{ImageSize, Object};
use mb_image::{Image, RgbImage};
use mb_job::{Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use mb_render::{ShadeOptions, over, shade, three_quarter_view};
use nalgebra::Vector3;

/// Size of one model's picture.
const TILE: ImageSize = ImageSize::new(360, 320);
/// Pictures side by side.
const COLUMNS: usize = 6;
const PAPER: [u8; 3] = [244, 246, 249];

/// Pictures of meshes (object frame, y up), six in a row, from left to right and top to bottom; each fills its tile.
///
/// # Errors
/// `Error::Stopped`.
pub fn contact_sheet(meshes: &[TriangleMesh], progress: &dyn Progress) -> Result<RgbImage> {
    let steps = Steps::new(progress, "drawing the contact sheet", meshes.len());
    let columns = meshes.len().clamp(1, COLUMNS);
    let rows = meshes.len().div_ceil(columns).max(1);
    let mut sheet = Image::filled(ImageSize::new(columns * TILE.width, rows * TILE.height), PAPER);
    for (index, mesh) in meshes.iter().enumerate() {
        let view = three_quarter_view::<Object>(&mesh.bounds(), &Vector3::y(), TILE, 0.6, 0.4);
        let tile = over(&shade(mesh, &view, &ShadeOptions::default()), PAPER);
        let (left, top) = (index % columns * TILE.width, index / columns * TILE.height);
        let width = sheet.width();
        for y in 0..TILE.height {
            let start = (top + y) * width + left;
            sheet.data_mut()[start..start + TILE.width].copy_from_slice(tile.row(y));
        }
        steps.step()?;
    }
    Ok(sheet)
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_job::Silent;
    use nalgebra::Point3;

    #[test]
    fn every_model_has_its_tile() {
        let corners = [[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.02, 0.0]].map(Point3::from);
        let mut triangle = TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2]]);
        triangle.triangle_colors = Some(vec![[200, 0, 0]]);
        let sheet = contact_sheet(&vec![triangle; 7], &Silent).expect("nobody stops it");
        assert_eq!(sheet.size(), ImageSize::new(6 * TILE.width, 2 * TILE.height));
        let red_in = |left: usize, top: usize| {
            let tile = (0..TILE.height).flat_map(|y| (0..TILE.width).map(move |x| (left + x, top + y)));
            tile.filter(|&at| sheet[at][0] > sheet[at][1].saturating_add(60)).count()
        };
        assert!((0..6).all(|column| red_in(column * TILE.width, 0) > 1000));
        assert!(red_in(0, TILE.height) > 1000 && red_in(TILE.width, TILE.height) == 0);
        assert_eq!(contact_sheet(&[], &Silent).expect("nobody stops it").size(), TILE);
    }
}
