//! The image type.

use mb_geometry::ImageSize;

/// A row-major image: `data[y * width + x]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Image<P> {
    size: ImageSize,
    data: Vec<P>,
}

/// 8-bit sRGB.
pub type RgbImage = Image<[u8; 3]>;
/// Depth along z in metres, 0 = no value.
pub type DepthImage = Image<f32>;
/// True where the object is.
pub type Mask = Image<bool>;
/// LiDAR confidence: 0 low, 1 medium, 2 high.
pub type Confidence = Image<u8>;

impl<P> Image<P> {
    /// From pixels in row-major order. `None` where their number is not `size.pixels()`.
    pub fn from_data(size: ImageSize, data: Vec<P>) -> Option<Self> {
        (data.len() == size.pixels()).then_some(Self { size, data })
    }

    /// Computes each pixel from its column and row.
    pub fn from_fn(size: ImageSize, mut pixel: impl FnMut(usize, usize) -> P) -> Self {
        let data = (0..size.pixels()).map(|i| pixel(i % size.width, i / size.width)).collect();
        Self { size, data }
    }

    /// Width and height.
    pub fn size(&self) -> ImageSize {
        self.size
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.size.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.size.height
    }

    /// All pixels, row-major.
    pub fn data(&self) -> &[P] {
        &self.data
    }

    /// All pixels, row-major.
    pub fn data_mut(&mut self) -> &mut [P] {
        &mut self.data
    }

    /// All pixels, row-major, without a copy.
    pub fn into_data(self) -> Vec<P> {
        self.data
    }

    /// One row.
    pub fn row(&self, y: usize) -> &[P] {
        &self.data[y * self.size.width..(y + 1) * self.size.width]
    }

    /// The pixel at column `x`, row `y`, or `None` outside.
    pub fn get(&self, x: usize, y: usize) -> Option<&P> {
        (x < self.size.width && y < self.size.height).then(|| &self.data[y * self.size.width + x])
    }

    /// A new image of the same size with every pixel mapped.
    pub fn map<Q>(&self, f: impl FnMut(&P) -> Q) -> Image<Q> {
        Image { size: self.size, data: self.data.iter().map(f).collect() }
    }
}

impl<P: Copy> Image<P> {
    /// The image turned clockwise by `quarter_turns` times 90 degrees, for displays: published photographs lie on
    /// their side.
    #[must_use]
    pub fn rotated_clockwise(&self, quarter_turns: usize) -> Self {
        let ImageSize { width, height } = self.size;
        match quarter_turns % 4 {
            0 => self.clone(),
            1 => Self::from_fn(ImageSize::new(height, width), |x, y| self[(y, height - 1 - x)]),
            2 => Self::from_fn(self.size, |x, y| self[(width - 1 - x, height - 1 - y)]),
            _ => Self::from_fn(ImageSize::new(height, width), |x, y| self[(width - 1 - y, x)]),
        }
    }
}

impl<P: Clone> Image<P> {
    /// An image of one value.
    pub fn filled(size: ImageSize, value: P) -> Self {
        Self { size, data: vec![value; size.pixels()] }
    }
}

/// Indexed by (column, row); panics outside, like a slice.
impl<P> std::ops::Index<(usize, usize)> for Image<P> {
    type Output = P;
    fn index(&self, (x, y): (usize, usize)) -> &P {
        debug_assert!(x < self.size.width);
        &self.data[y * self.size.width + x]
    }
}

impl<P> std::ops::IndexMut<(usize, usize)> for Image<P> {
    fn index_mut(&mut self, (x, y): (usize, usize)) -> &mut P {
        debug_assert!(x < self.size.width);
        &mut self.data[y * self.size.width + x]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_turn_clockwise_brings_the_left_column_to_the_top() {
        let image = Image::from_data(ImageSize::new(3, 2), vec![1, 2, 3, 4, 5, 6]).unwrap();
        assert_eq!(image.rotated_clockwise(1).data(), [4, 1, 5, 2, 6, 3]);
        assert_eq!(image.rotated_clockwise(2).data(), [6, 5, 4, 3, 2, 1]);
        assert_eq!(image.rotated_clockwise(3).rotated_clockwise(1), image);
    }
}
