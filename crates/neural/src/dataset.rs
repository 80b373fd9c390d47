//! The photographs of a sequence as rays to learn from.
//!
//! Images are read once, reduced by area averaging to the working size, and kept at 8 bits a channel: 60 frames at
//! 480 x 360 take 31 MB. Every frame has its own intrinsics. Every eighth frame is held out for scoring.

use std::borrow::Cow;

use mb_capture::{Alignment, Frame, FrameId, Sequence, read_neus_sphere};
use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_image::{Image, RgbImage};
use mb_job::{InputError, Progress, Result, Rng, Steps};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cameras::CameraResiduals;
use crate::contraction::expand;
use crate::region::Region;

/// How photographs become rays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DataOptions {
    /// Larger photographs are reduced so that their longer side has this many pixels.
    pub max_side_px: usize,
    /// Frames 0, n, 2n, ... are held out, as NeRF, DVGO and the paper do with n = 8; 0 holds none out.
    pub hold_out_every: usize,
    /// Use the masks beside the photographs, where every frame has one.
    pub masks: bool,
}

impl Default for DataOptions {
    fn default() -> Self {
        Self { max_side_px: 480, hold_out_every: 8, masks: true }
    }
}

/// One photograph at working size.
#[derive(Debug, Clone)]
pub struct View {
    /// Which frame.
    pub frame: FrameId,
    /// Intrinsics at working size.
    pub intrinsics: Intrinsics,
    /// Its pose.
    pub world_from_cam: Rigid3<World, Camera>,
    /// The photograph.
    pub rgb: RgbImage,
    /// Share of each pixel that the object covers, in 255ths; where there are masks.
    pub mask: Option<Image<u8>>,
    /// Kept from training.
    pub held_out: bool,
    scene_from_cam: [[f32; 3]; 3],
    center: [f32; 3],
}

/// A ray in the scene frame (the region of interest is the unit ball).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneRay {
    /// Centre of projection.
    pub origin: [f32; 3],
    /// Unit direction.
    pub direction: [f32; 3],
}

impl SceneRay {
    /// The point at distance `t`.
    #[inline(always)]
    pub fn at(&self, t: f32) -> [f32; 3] {
        std::array::from_fn(|d| self.origin[d] + t * self.direction[d])
    }

    /// The distances where the ray enters and leaves the ball of this radius around the origin; `None` where it
    /// passes by or the ball lies behind.
    pub fn ball(&self, radius: f32) -> Option<(f32, f32)> {
        let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let b = dot(self.origin, self.direction);
        let root = b * b - dot(self.origin, self.origin) + radius * radius;
        if root <= 0.0 {
            return None;
        }
        let root = root.sqrt();
        (root > b).then(|| ((-b - root).max(0.0), root - b))
    }
}

/// A ray with what the photograph shows there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetRay {
    /// The ray.
    pub ray: SceneRay,
    /// Index of its photograph in [`RayDataset::views`].
    pub view: u32,
    /// Its pixel.
    pub pixel: [f32; 2],
    /// sRGB in 0..=1.
    pub rgb: [f32; 3],
    /// Share of the pixel that the object covers; `None` where there are no masks.
    pub mask: Option<f32>,
}

impl TargetRay {
    /// The photograph's colour; where `only_object` and there is a mask, with this background behind the object.
    pub fn before(&self, background: [f32; 3], only_object: bool) -> [f32; 3] {
        match self.mask.filter(|_| only_object) {
            Some(mask) => std::array::from_fn(|c| mask * self.rgb[c] + (1.0 - mask) * background[c]),
            None => self.rgb,
        }
    }
}

impl View {
    /// Works out the camera in the scene frame.
    fn enter(&mut self, region: &Region) {
        let rotation = self.world_from_cam.rotation_matrix();
        self.scene_from_cam = std::array::from_fn(|r| std::array::from_fn(|c| rotation[(r, c)] as f32));
        let center = region.scene_from_world(&self.world_from_cam.translation().into());
        self.center = [center.x as f32, center.y as f32, center.z as f32];
    }

    /// The ray through pixel (x, y); centres lie at integers.
    #[inline]
    pub fn ray(&self, x: f32, y: f32) -> SceneRay {
        let direction = self.rotated(self.through([x, y]));
        let length = direction.iter().map(|c| c * c).sum::<f32>().sqrt();
        SceneRay { origin: self.center, direction: direction.map(|c| c / length) }
    }

    /// The point of a pixel on the plane at depth 1 of the camera frame.
    #[inline]
    pub(crate) fn through(&self, pixel: [f32; 2]) -> [f32; 3] {
        let k = &self.intrinsics;
        [(pixel[0] - k.cx as f32) / k.fx as f32, (pixel[1] - k.cy as f32) / k.fy as f32, 1.0]
    }

    /// A vector of the camera frame in the scene frame.
    #[inline]
    pub(crate) fn rotated(&self, v: [f32; 3]) -> [f32; 3] {
        let r = &self.scene_from_cam;
        std::array::from_fn(|d| r[d][0] * v[0] + r[d][1] * v[1] + r[d][2] * v[2])
    }

    /// A vector of the scene frame in the camera frame.
    #[inline]
    pub(crate) fn rotated_back(&self, v: [f32; 3]) -> [f32; 3] {
        let r = &self.scene_from_cam;
        std::array::from_fn(|d| r[0][d] * v[0] + r[1][d] * v[1] + r[2][d] * v[2])
    }

    /// Centre of projection, scene frame.
    pub(crate) fn center(&self) -> [f32; 3] {
        self.center
    }

    /// Width and height at working size.
    pub fn size(&self) -> ImageSize {
        self.rgb.size()
    }

    /// What a model is compared with: the photograph, or, of `only_object`, the object before black. A photograph without
    /// a mask is shown whole.
    pub fn shown(&self, only_object: bool) -> Cow<'_, RgbImage> {
        match self.mask.as_ref().filter(|_| only_object) {
            Some(mask) => Cow::Owned(Image::from_fn(self.size(), |x, y| {
                let covered = f32::from(mask[(x, y)]) / 255.0;
                self.rgb[(x, y)].map(|c| (f32::from(c) * covered).round() as u8)
            })),
            None => Cow::Borrowed(&self.rgb),
        }
    }

    fn target(&self, view: usize, x: usize, y: usize, cameras: &CameraResiduals) -> TargetRay {
        let pixel = [x as f32, y as f32];
        TargetRay {
            ray: cameras.ray(self, view, pixel),
            view: view as u32,
            pixel,
            rgb: self.rgb[(x, y)].map(|v| f32::from(v) / 255.0),
            mask: self.mask.as_ref().map(|m| f32::from(m[(x, y)]) / 255.0),
        }
    }
}

/// An image in memory: colours, how much of each pixel the object covers (in 255ths, where known), and its camera.
pub type Photograph = (RgbImage, Option<Image<u8>>, Intrinsics, Rigid3<World, Camera>);

/// Photographs, cameras and the region of interest: all that training reads.
#[derive(Debug, Clone)]
pub struct RayDataset {
    views: Vec<View>,
    training: Vec<usize>,
    region: Region,
    warnings: Vec<String>,
}

impl RayDataset {
    /// Reads a sequence. Cameras are those of its alignment, where it has one.
    ///
    /// # Errors
    /// Fewer than three usable photographs; a damaged file; cameras that do not look at a common place.
    pub fn open(sequence: &Sequence, options: &DataOptions, progress: &dyn Progress) -> Result<Self> {
        let mut frames = match sequence.root().join(Alignment::FILE).exists() {
            true => sequence.aligned_frames(&sequence.read_alignment()?),
            false => sequence.frames().to_vec(),
        };
        frames.retain(|f| f.image.is_some());
        if frames.len() < 3 {
            return Err(InputError::new(
                sequence.root().join("image"),
                format!("{} photographs with a camera, at least 3 are needed", frames.len()),
            )
            .help("Capture the object from all sides; 40 or more photographs are usual")
            .into());
        }
        let with_masks = options.masks && frames.iter().all(|f| sequence.mask_path(f.id).exists());
        let steps = Steps::new(progress, "reading photographs", frames.len());
        let views: Vec<View> = frames
            .par_iter()
            .enumerate()
            .map(|(i, frame)| {
                let held_out = options.hold_out_every > 0 && i.is_multiple_of(options.hold_out_every);
                let view = read_view(sequence, frame, options.max_side_px, with_masks, held_out)?;
                steps.step()?;
                Ok(view)
            })
            .collect::<Result<_>>()?;
        let (views, mut warnings) = drop_blank(views);
        let training = views.iter().filter(|v| !v.held_out).count();
        if training < MIN_TRAINING {
            let blank = frames.len() - views.len();
            return Err(InputError::new(
                sequence.root().join("image"),
                format!(
                    "{training} of {} photographs are left for training, at least {MIN_TRAINING} are needed: {blank} are all \
                     black or over-exposed, {} are held out",
                    frames.len(),
                    views.len() - training
                ),
            )
            .help("Film the object again, with the exposure set for it; 40 or more photographs are usual")
            .into());
        }
        let named = match sequence.neus_cameras_path() {
            path if !with_masks && path.is_file() => Some(read_neus_sphere(path)?),
            _ => None,
        };
        let region = named.and_then(|sphere| Region::from_sphere(&sphere, &views));
        if named.is_some() && region.is_none() {
            warnings
                .push("most photographs do not show the middle of the sphere of cameras.npz; it was not used".into());
        }
        Self::new(views, region, warnings).map_err(|found| {
            InputError::new(sequence.root(), found)
                .help("Check the poses: OpenCV axes (x right, y down, z forward), camera to world, metres")
                .into()
        })
    }

    /// From views whose scene frame is not known yet; without a region it is found from the views.
    fn new(mut views: Vec<View>, region: Option<Region>, warnings: Vec<String>) -> std::result::Result<Self, String> {
        if views.iter().filter(|v| !v.held_out).count() < MIN_TRAINING {
            return Err(format!("fewer than {MIN_TRAINING} photographs are left for training"));
        }
        let region = region.map_or_else(|| Region::find(&views), Ok)?;
        views.iter_mut().for_each(|view| view.enter(&region));
        let training = (0..views.len()).filter(|i| !views[*i].held_out).collect();
        Ok(Self { views, training, region, warnings })
    }

    /// From images that exist only in memory, such as analytic ones in tests: colour, cover (where masks are wanted)
    /// and camera of each view; every `hold_out_every`-th is held out.
    ///
    /// # Errors
    /// As [`RayDataset::open`].
    pub fn from_images(images: Vec<Photograph>, hold_out_every: usize) -> Result<Self> {
        let views = images
            .into_iter()
            .enumerate()
            .map(|(i, (rgb, mask, intrinsics, world_from_cam))| View {
                frame: FrameId(i as u32),
                intrinsics,
                world_from_cam,
                rgb,
                mask,
                held_out: hold_out_every > 0 && i.is_multiple_of(hold_out_every),
                scene_from_cam: [[0.0; 3]; 3],
                center: [0.0; 3],
            })
            .collect();
        Self::new(views, None, Vec::new()).map_err(mb_job::Error::Failed)
    }

    /// All views in frame order.
    pub fn views(&self) -> &[View] {
        &self.views
    }

    /// The views that are kept from training.
    pub fn held_out(&self) -> impl Iterator<Item = &View> {
        self.views.iter().filter(|v| v.held_out)
    }

    /// Where the object is.
    pub fn region(&self) -> &Region {
        &self.region
    }

    /// Whether every view has a mask.
    pub fn has_masks(&self) -> bool {
        self.views.iter().all(|v| v.mask.is_some())
    }

    /// What was found and mended.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Replaces `out` by `n` rays of training pixels, drawn uniformly, from cameras with these residuals.
    pub fn draw(&self, rng: &mut Rng, n: usize, cameras: &CameraResiduals, out: &mut Vec<TargetRay>) {
        out.clear();
        out.extend((0..n).map(|_| {
            let index = self.training[rng.random_range(0..self.training.len())];
            let view = &self.views[index];
            let pixel = rng.random_range(0..view.size().pixels());
            view.target(index, pixel % view.size().width, pixel / view.size().width, cameras)
        }));
    }

    /// How many training cameras see something of a cell of contracted space that is not nearer than `near`; the cell is
    /// given by its centre and half edge in the unit cube.
    pub fn seen_by(&self, center: [f32; 3], half: f32, near: f32) -> usize {
        let inside = |v: f32| v.clamp(0.002, 0.998);
        let at = |sign: f32| expand(center.map(|c| inside(c + sign * half)));
        let (low, middle, high) = (at(-1.0), at(0.0), at(1.0));
        let reach = (0..3).map(|d| (high[d] - low[d]).powi(2)).sum::<f32>().sqrt() * 0.5;
        let mut seen = 0;
        for view in self.training.iter().map(|i| &self.views[*i]) {
            let p = view.rotated_back(std::array::from_fn(|d| middle[d] - view.center[d]));
            if p.iter().map(|c| c * c).sum::<f32>().sqrt() + reach < near || p[2] + reach <= 0.0 {
                continue;
            }
            let (k, z) = (&view.intrinsics, p[2].max(1e-3));
            let margin = k.fx.max(k.fy) as f32 * reach / z;
            let (x, y) = (k.fx as f32 * p[0] / z + k.cx as f32, k.fy as f32 * p[1] / z + k.cy as f32);
            let (width, height) = (view.size().width as f32, view.size().height as f32);
            if x > -margin && y > -margin && x < width + margin && y < height + margin {
                seen += 1;
            }
        }
        seen
    }

    /// A view that no photograph was taken from: black.
    pub(crate) fn new_view(
        &self,
        frame: FrameId,
        intrinsics: Intrinsics,
        size: ImageSize,
        world_from_cam: Rigid3<World, Camera>,
    ) -> View {
        let rgb = Image::from_fn(size, |_, _| [0; 3]);
        let mut view = View {
            frame,
            intrinsics,
            world_from_cam,
            rgb,
            mask: None,
            held_out: false,
            scene_from_cam: [[0.0; 3]; 3],
            center: [0.0; 3],
        };
        view.enter(&self.region);
        view
    }

    /// Indices of the views that are trained on.
    pub fn training(&self) -> &[usize] {
        &self.training
    }

    /// Bytes that the photographs and masks take.
    pub fn bytes(&self) -> usize {
        self.views.iter().map(|v| v.size().pixels() * (3 + usize::from(v.mask.is_some()))).sum()
    }

    /// A number that changes with the pictures, cameras or region, to tell a checkpoint of other data.
    pub fn fingerprint(&self) -> u64 {
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        let mut add = |bytes: &[u8]| {
            for b in bytes {
                hash = (hash ^ u64::from(*b)).wrapping_mul(0x0000_0100_0000_01b3);
            }
        };
        for view in &self.views {
            add(&view.frame.0.to_le_bytes());
            add(&[u8::from(view.held_out), u8::from(view.mask.is_some())]);
            let k = &view.intrinsics;
            let pose = view.world_from_cam.to_matrix();
            [k.fx, k.fy, k.cx, k.cy].iter().chain(pose.iter()).for_each(|v| add(&v.to_le_bytes()));
            // Every 97th pixel: a changed photograph differs in more than the rest.
            view.rgb.data().iter().step_by(97).for_each(|p| add(p));
        }
        add(&self.region.radius_m.to_le_bytes());
        hash
    }
}

fn read_view(sequence: &Sequence, frame: &Frame, max_side_px: usize, with_mask: bool, held_out: bool) -> Result<View> {
    let full = sequence.read_image(frame)?;
    let size = full.size();
    let scale = (max_side_px as f64 / size.width.max(size.height) as f64).min(1.0);
    let side = |n: usize| ((n as f64 * scale).round() as usize).max(1);
    let to = ImageSize::new(side(size.width), side(size.height));
    let mask = match with_mask {
        true => {
            let mask = sequence.read_mask(frame)?.map(|m| [if *m { 255 } else { 0 }]);
            Some(area_averaged(&mask, to).map(|p| p[0]))
        }
        false => None,
    };
    Ok(View {
        frame: frame.id,
        intrinsics: frame.intrinsics.resized(size, to),
        world_from_cam: frame.world_from_cam,
        rgb: area_averaged(&full, to),
        mask,
        held_out,
        scene_from_cam: [[0.0; 3]; 3],
        center: [0.0; 3],
    })
}

/// Fewest photographs that can be trained on: one says nothing of depth.
const MIN_TRAINING: usize = 2;

/// Leaves out photographs that show nothing, and says so.
fn drop_blank(views: Vec<View>) -> (Vec<View>, Vec<String>) {
    let mut warnings = Vec::new();
    let kept = views
        .into_iter()
        .filter(|view| {
            let sum: u64 = view.rgb.data().iter().flatten().map(|v| u64::from(*v)).sum();
            let mean = sum as f64 / (3 * view.size().pixels()) as f64;
            let what = match mean {
                m if m < 2.0 => "black",
                m if m > 253.0 => "over-exposed",
                _ => return true,
            };
            warnings.push(format!("frame {}: the photograph is all {what}; it was left out", view.frame));
            false
        })
        .collect();
    (kept, warnings)
}

/// Reduces an image: each new pixel is the mean over the area that it covers.
fn area_averaged<const C: usize>(image: &Image<[u8; C]>, to: ImageSize) -> Image<[u8; C]> {
    if image.size() == to {
        return image.clone();
    }
    let spans = |from: usize, to: usize| -> Vec<Vec<(usize, f32)>> {
        let scale = from as f64 / to as f64;
        (0..to)
            .map(|i| {
                let (a, b) = (i as f64 * scale, (i + 1) as f64 * scale);
                (a.floor() as usize..(b.ceil() as usize).min(from))
                    .map(|j| (j, (((j + 1) as f64).min(b) - (j as f64).max(a)) as f32))
                    .filter(|(_, w)| *w > 1e-6)
                    .collect()
            })
            .collect()
    };
    let (columns, rows) = (spans(image.width(), to.width), spans(image.height(), to.height));
    Image::from_fn(to, |x, y| {
        let (mut sum, mut total) = ([0.0f32; C], 0.0);
        for (row, wy) in &rows[y] {
            for (column, wx) in &columns[x] {
                let w = wx * wy;
                total += w;
                let pixel = &image[(*column, *row)];
                for c in 0..C {
                    sum[c] += w * f32::from(pixel[c]);
                }
            }
        }
        sum.map(|v| (v / total).round() as u8)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn area_averaging_keeps_the_mean_and_an_integer_ratio_is_a_plain_mean() {
        let image = Image::from_fn(ImageSize::new(6, 4), |x, y| [(10 * x + 40 * y) as u8]);
        let half = area_averaged(&image, ImageSize::new(3, 2));
        assert_eq!(half[(0, 0)], [25]);
        let odd = area_averaged(&image, ImageSize::new(4, 3));
        let mean = |i: &Image<[u8; 1]>| i.data().iter().map(|p| f64::from(p[0])).sum::<f64>() / i.data().len() as f64;
        assert!((mean(&odd) - mean(&image)).abs() < 1.0);
    }

    #[test]
    fn a_ray_meets_a_ball_where_geometry_says() {
        let ray = SceneRay { origin: [0.0, 0.0, -3.0], direction: [0.0, 0.0, 1.0] };
        assert_eq!(ray.ball(1.0), Some((2.0, 4.0)));
        assert_eq!(SceneRay { origin: [0.0; 3], ..ray }.ball(1.0), Some((0.0, 1.0)));
        assert_eq!(SceneRay { origin: [0.0, 0.0, 3.0], ..ray }.ball(1.0), None);
        assert_eq!(SceneRay { origin: [2.0, 0.0, -3.0], ..ray }.ball(1.0), None);
    }
}
