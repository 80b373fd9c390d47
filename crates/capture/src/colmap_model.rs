//! COLMAP models on disk: cameras and images, as text and as binary.
//!
//! `images` hold `cam_from_world` (quaternion w x y z, translation) with OpenCV camera axes; pixel coordinates have the
//! image's corner at (0, 0). Observations and points are passed over when reading, and left empty when writing.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_job::{InputError, Result, write_atomic};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::lens::{Distortion, Lens};

/// COLMAP's camera models with their ids and numbers of parameters.
const MODELS: [(&str, u32, usize); 18] = [
    ("SIMPLE_PINHOLE", 0, 3),
    ("PINHOLE", 1, 4),
    ("SIMPLE_RADIAL", 2, 4),
    ("RADIAL", 3, 5),
    ("OPENCV", 4, 8),
    ("OPENCV_FISHEYE", 5, 8),
    ("FULL_OPENCV", 6, 12),
    ("FOV", 7, 5),
    ("SIMPLE_RADIAL_FISHEYE", 8, 4),
    ("RADIAL_FISHEYE", 9, 5),
    ("THIN_PRISM_FISHEYE", 10, 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 11, 16),
    ("SIMPLE_DIVISION", 12, 4),
    ("DIVISION", 13, 5),
    ("SIMPLE_FISHEYE", 14, 3),
    ("FISHEYE", 15, 4),
    ("EUCM", 16, 6),
    ("EQUIRECTANGULAR", 17, 2),
];

/// One camera of a model.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ColmapCamera {
    pub size: ImageSize,
    pub lens: Lens,
}

/// One posed photograph of a model.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ColmapImage {
    pub name: String,
    pub camera: u32,
    pub cam_from_world: Rigid3<Camera, World>,
}

/// Cameras by id, and images in the order of the file.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ColmapModel {
    pub cameras: BTreeMap<u32, ColmapCamera>,
    pub images: Vec<ColmapImage>,
}

/// The lens of a camera model and its parameters. COLMAP's corner convention becomes ours here.
fn lens(model: &str, p: &[f64]) -> std::result::Result<Lens, String> {
    let radial = |k: [f64; 6], t: [f64; 2]| Distortion::Radial { k, p: t };
    let fisheye = |k: [f64; 4]| Distortion::Fisheye { k, p: [0.0; 2], s: [0.0; 2] };
    if !p.iter().all(|v| v.is_finite()) {
        return Err(format!("camera parameters {p:?} hold something that is not finite"));
    }
    if model == "EQUIRECTANGULAR" {
        // Its parameters are width and height; the pinhole has the panorama's pixels per radian at its centre.
        let (fx, fy) = (p[0] / std::f64::consts::TAU, p[1] / std::f64::consts::PI);
        return lens_of(fx, fy, 0.5 * p[0], 0.5 * p[1], Distortion::Equirectangular);
    }
    // Models with one focal length, then those with two.
    let (focal, rest) = match model {
        "SIMPLE_PINHOLE"
        | "SIMPLE_RADIAL"
        | "RADIAL"
        | "SIMPLE_RADIAL_FISHEYE"
        | "RADIAL_FISHEYE"
        | "SIMPLE_DIVISION"
        | "SIMPLE_FISHEYE" => ((p[0], p[0]), &p[1..]),
        _ => ((p[0], p[1]), &p[2..]),
    };
    let (cx, cy, c) = (rest[0], rest[1], &rest[2..]);
    let distortion = match model {
        "SIMPLE_PINHOLE" | "PINHOLE" => Distortion::None,
        "SIMPLE_RADIAL" => radial([c[0], 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        "RADIAL" => radial([c[0], c[1], 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        "OPENCV" => radial([c[0], c[1], 0.0, 0.0, 0.0, 0.0], [c[2], c[3]]),
        "FULL_OPENCV" => radial([c[0], c[1], c[4], c[5], c[6], c[7]], [c[2], c[3]]),
        "OPENCV_FISHEYE" => fisheye([c[0], c[1], c[2], c[3]]),
        "SIMPLE_RADIAL_FISHEYE" => fisheye([c[0], 0.0, 0.0, 0.0]),
        "RADIAL_FISHEYE" => fisheye([c[0], c[1], 0.0, 0.0]),
        "THIN_PRISM_FISHEYE" => Distortion::Fisheye { k: [c[0], c[1], c[4], c[5]], p: [c[2], c[3]], s: [c[6], c[7]] },
        "SIMPLE_FISHEYE" | "FISHEYE" => fisheye([0.0; 4]),
        "RAD_TAN_THIN_PRISM_FISHEYE" => Distortion::RadTanThinPrism {
            k: [c[0], c[1], c[2], c[3], c[4], c[5]],
            p: [c[6], c[7]],
            s: [c[8], c[9], c[10], c[11]],
        },
        "FOV" => Distortion::FieldOfView { omega: c[0] },
        "SIMPLE_DIVISION" | "DIVISION" => Distortion::Division { k: c[0] },
        "EUCM" if (0.0..=1.0).contains(&c[0]) && c[1] > 0.0 => Distortion::EnhancedUnified { alpha: c[0], beta: c[1] },
        "EUCM" => return Err(format!("alpha {} and beta {}, expected 0 to 1 and above 0", c[0], c[1])),
        other => return Err(format!("camera model {other} is not known here")),
    };
    lens_of(focal.0, focal.1, cx, cy, distortion)
}

/// A lens from numbers in COLMAP's corner convention.
fn lens_of(fx: f64, fy: f64, cx: f64, cy: f64, distortion: Distortion) -> std::result::Result<Lens, String> {
    if !(fx > 0.0 && fy > 0.0) {
        return Err(format!("the focal lengths are {fx} and {fy}, both must be above 0"));
    }
    Ok(Lens { intrinsics: Intrinsics { fx, fy, cx: cx - 0.5, cy: cy - 0.5 }, distortion })
}

fn size(width: u64, height: u64) -> std::result::Result<ImageSize, String> {
    if width == 0 || height == 0 || width > 100_000 || height > 100_000 {
        return Err(format!("a camera of {width}x{height} pixels"));
    }
    Ok(ImageSize::new(width as usize, height as usize))
}

fn pose(q: [f64; 4], t: [f64; 3]) -> std::result::Result<Rigid3<Camera, World>, String> {
    let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
    if !((quaternion.norm() - 1.0).abs() < 1e-2 && t.iter().all(|v| v.is_finite())) {
        return Err(format!(
            "the quaternion has norm {:.4}, not 1, or the translation is not finite",
            quaternion.norm()
        ));
    }
    Ok(Rigid3::from_parts(UnitQuaternion::from_quaternion(quaternion), Vector3::from(t)))
}

/// Whether a folder holds a model, text or binary.
pub(crate) fn is_model(folder: &Path) -> bool {
    ["txt", "bin"].iter().any(|e| ["cameras", "images"].iter().all(|f| folder.join(format!("{f}.{e}")).is_file()))
}

impl ColmapModel {
    /// Reads a model folder; binary where both forms lie there.
    pub fn read(folder: &Path) -> Result<Self> {
        let model =
            if folder.join("cameras.bin").is_file() { Self::read_binary(folder) } else { Self::read_text(folder) }?;
        for image in &model.images {
            if !model.cameras.contains_key(&image.camera) {
                let found = format!("names camera {}, which the model does not have", image.camera);
                return Err(InputError::new(folder, found).at(format!("image '{}'", image.name)).into());
            }
        }
        Ok(model)
    }

    fn read_text(folder: &Path) -> Result<Self> {
        let open = |name: &str| -> Result<(std::path::PathBuf, String)> {
            let path = folder.join(name);
            let bytes = std::fs::read(&path).map_err(|e| InputError::unreadable(&path, &e))?;
            let text = String::from_utf8(bytes).map_err(|_| InputError::new(&path, "not a text file"))?;
            Ok((path, text))
        };
        let mut model = Self::default();
        let (path, text) = open("cameras.txt")?;
        for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#')) {
            let bad = |found: String| InputError::new(&path, found).at_line(i + 1);
            let words: Vec<&str> = line.split_whitespace().collect();
            let [id, name, width, height, parameters @ ..] = &words[..] else {
                return Err(bad("expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS".to_owned()).into());
            };
            let numbers: Option<Vec<f64>> = parameters.iter().map(|w| w.parse().ok()).collect();
            let count = MODELS.iter().find(|m| m.0 == *name).map(|m| m.2);
            let count = count.ok_or_else(|| bad(format!("unknown camera model {name}")))?;
            let (Ok(id), Ok(width), Ok(height), Some(numbers)) = (id.parse(), width.parse(), height.parse(), numbers)
            else {
                return Err(bad("holds something that is no number".to_owned()).into());
            };
            if numbers.len() != count {
                return Err(bad(format!("{} parameters, {name} has {count}", numbers.len())).into());
            }
            let camera =
                ColmapCamera { size: size(width, height).map_err(bad)?, lens: lens(name, &numbers).map_err(bad)? };
            model.cameras.insert(id, camera);
        }
        let (path, text) = open("images.txt")?;
        // Every image has two lines; the second, with its observations, may be empty.
        let mut lines = text.lines().enumerate().filter(|(_, l)| !l.starts_with('#'));
        while let Some((i, line)) = lines.next() {
            if line.trim().is_empty() {
                continue;
            }
            let bad = |found: String| InputError::new(&path, found).at_line(i + 1);
            let words: Vec<&str> = line.split_whitespace().collect();
            if words.len() < 10 {
                return Err(bad("expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME".to_owned()).into());
            }
            let numbers: Option<Vec<f64>> = words[1..8].iter().map(|w| w.parse().ok()).collect();
            let (Some(n), Ok(camera)) = (numbers, words[8].parse()) else {
                return Err(bad("holds something that is no number".to_owned()).into());
            };
            let cam_from_world = pose([n[0], n[1], n[2], n[3]], [n[4], n[5], n[6]]).map_err(bad)?;
            model.images.push(ColmapImage { name: words[9..].join(" "), camera, cam_from_world });
            // A model whose empty lines were stripped would lose every second image without a word.
            if let Some((i, observations)) = lines.next() {
                let words = observations.split_whitespace();
                if words.clone().any(|w| w.parse::<f64>().is_err()) || words.count() % 3 != 0 {
                    return Err(InputError::new(&path, "expected the image's observations, X Y POINT3D_ID each")
                        .at_line(i + 1)
                        .help("Every image has two lines, the second of which may be empty")
                        .into());
                }
            }
        }
        Ok(model)
    }

    fn read_binary(folder: &Path) -> Result<Self> {
        let mut model = Self::default();
        let path = folder.join("cameras.bin");
        let mut reader = Reader::open(&path)?;
        for _ in 0..reader.u64()? {
            let (id, kind) = (reader.u32()?, reader.u32()?);
            let (width, height) = (reader.u64()?, reader.u64()?);
            let &(name, _, count) = MODELS.iter().find(|m| m.1 == kind).ok_or_else(|| {
                InputError::new(&path, format!("unknown camera model {kind}")).at(format!("camera {id}"))
            })?;
            let parameters = (0..count).map(|_| reader.f64()).collect::<Result<Vec<f64>>>()?;
            let bad = |found: String| InputError::new(&path, found).at(format!("camera {id}"));
            let camera =
                ColmapCamera { size: size(width, height).map_err(bad)?, lens: lens(name, &parameters).map_err(bad)? };
            model.cameras.insert(id, camera);
        }
        let path = folder.join("images.bin");
        let mut reader = Reader::open(&path)?;
        for _ in 0..reader.u64()? {
            let id = reader.u32()?;
            let mut n = [0.0; 7];
            for v in &mut n {
                *v = reader.f64()?;
            }
            let camera = reader.u32()?;
            let name = reader.name()?;
            let observations = reader.u64()?;
            // Each is two doubles and a point id.
            reader.skip(observations.saturating_mul(24))?;
            let bad = |found: String| InputError::new(&path, found).at(format!("image {id}"));
            let cam_from_world = pose([n[0], n[1], n[2], n[3]], [n[4], n[5], n[6]]).map_err(bad)?;
            model.images.push(ColmapImage { name, camera, cam_from_world });
        }
        Ok(model)
    }

    /// Writes the model as text; every camera must be a pinhole.
    pub fn write_text(&self, folder: &Path) -> Result<()> {
        let mut text =
            String::from("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[fx fy cx cy], corner of the image at (0, 0)\n");
        for (id, camera) in &self.cameras {
            let k = camera.lens.intrinsics;
            let ImageSize { width, height } = camera.size;
            let _ = writeln!(text, "{id} PINHOLE {width} {height} {} {} {} {}", k.fx, k.fy, k.cx + 0.5, k.cy + 0.5);
        }
        write_atomic(folder.join("cameras.txt"), text.as_bytes())?;
        let mut text =
            String::from("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then an empty list of observations\n");
        for (i, image) in self.images.iter().enumerate() {
            let (q, t) = (image.cam_from_world.rotation(), image.cam_from_world.translation());
            let _ = writeln!(
                text,
                "{} {} {} {} {} {} {} {} {} {}\n",
                i + 1,
                q.w,
                q.i,
                q.j,
                q.k,
                t.x,
                t.y,
                t.z,
                image.camera,
                image.name
            );
        }
        write_atomic(folder.join("images.txt"), text.as_bytes())?;
        write_atomic(folder.join("points3D.txt"), b"# no points\n")
    }

    /// Writes the model as binary; every camera must be a pinhole.
    pub fn write_binary(&self, folder: &Path) -> Result<()> {
        let mut bytes = (self.cameras.len() as u64).to_le_bytes().to_vec();
        for (id, camera) in &self.cameras {
            bytes.extend(id.to_le_bytes());
            bytes.extend(1u32.to_le_bytes());
            bytes.extend((camera.size.width as u64).to_le_bytes());
            bytes.extend((camera.size.height as u64).to_le_bytes());
            let k = camera.lens.intrinsics;
            for v in [k.fx, k.fy, k.cx + 0.5, k.cy + 0.5] {
                bytes.extend(v.to_le_bytes());
            }
        }
        write_atomic(folder.join("cameras.bin"), &bytes)?;
        let mut bytes = (self.images.len() as u64).to_le_bytes().to_vec();
        for (i, image) in self.images.iter().enumerate() {
            bytes.extend((i as u32 + 1).to_le_bytes());
            let (q, t) = (image.cam_from_world.rotation(), image.cam_from_world.translation());
            for v in [q.w, q.i, q.j, q.k, t.x, t.y, t.z] {
                bytes.extend(v.to_le_bytes());
            }
            bytes.extend(image.camera.to_le_bytes());
            bytes.extend(image.name.as_bytes());
            bytes.push(0);
            bytes.extend(0u64.to_le_bytes());
        }
        write_atomic(folder.join("images.bin"), &bytes)?;
        write_atomic(folder.join("points3D.bin"), &0u64.to_le_bytes())
    }
}

/// Little-endian numbers of a file in memory.
struct Reader {
    path: std::path::PathBuf,
    bytes: Vec<u8>,
    at: usize,
}

impl Reader {
    fn open(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
        Ok(Self { path: path.to_owned(), bytes, at: 0 })
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let bytes = self.bytes.get(self.at..self.at + N).and_then(|b| <[u8; N]>::try_from(b).ok());
        self.at += N;
        bytes.ok_or_else(|| self.truncated())
    }

    fn truncated(&self) -> mb_job::Error {
        InputError::new(&self.path, "the file ends too early; it is truncated")
            .at(format!("byte {}", self.bytes.len()))
            .into()
    }

    fn u32(&mut self) -> Result<u32> {
        Ok(u32::from_le_bytes(self.take()?))
    }

    fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_le_bytes(self.take()?))
    }

    fn f64(&mut self) -> Result<f64> {
        Ok(f64::from_le_bytes(self.take()?))
    }

    fn name(&mut self) -> Result<String> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = rest.iter().position(|b| *b == 0).ok_or_else(|| self.truncated())?;
        let name = String::from_utf8_lossy(&rest[..length]).into_owned();
        self.at += length + 1;
        Ok(name)
    }

    fn skip(&mut self, count: u64) -> Result<()> {
        let left = self.bytes.len().saturating_sub(self.at) as u64;
        if count > left {
            return Err(self.truncated());
        }
        self.at += count as usize;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point2;

    /// Where COLMAP (pycolmap 4.2.1) sees the points (0.31, -0.22, 1) and (-0.6, 0.45, 1) through each of its models.
    const SEEN: [(&str, &[f64], [f64; 4]); 18] = [
        ("SIMPLE_PINHOLE", &[500.0, 320.0, 240.0], [475.0, 130.0, 20.0, 465.0]),
        ("PINHOLE", &[500.0, 510.0, 321.0, 239.0], [476.0, 126.8, 21.0, 468.5]),
        ("SIMPLE_RADIAL", &[500.0, 320.0, 240.0, -0.1], [472.76025, 131.5895, 36.875_000_000_000_06, 452.34375]),
        (
            "RADIAL",
            &[500.0, 320.0, 240.0, -0.1, 0.02],
            [472.824_978_775, 131.543_563_45, 34.976_562_5, 453.767_578_125],
        ),
        (
            "OPENCV",
            &[500.0, 510.0, 321.0, 239.0, -0.1, 0.02, 0.003, -0.004],
            [472.946_978_775, 129.021_879_719, 32.601_562_5, 459.624_804_687_5],
        ),
        (
            "OPENCV_FISHEYE",
            &[500.0, 510.0, 321.0, 239.0, -0.1, 0.02, 0.003, -0.004],
            [467.219_190_924_607_9, 133.156_172_762_961_26, 73.351_041_168_853_44, 428.451_453_505_827_1],
        ),
        (
            "FULL_OPENCV",
            &[500.0, 510.0, 321.0, 239.0, -0.1, 0.02, 0.003, -0.004, 0.01, 0.02, -0.03, 0.004],
            [472.604_656_550_923_1, 129.269_676_838_622_13, 32.771_138_102_284_57, 459.495_079_351_752_34],
        ),
        (
            "FOV",
            &[500.0, 510.0, 321.0, 239.0, 0.9],
            [480.457_911_327_784_13, 123.573_047_413_049_17, 42.317_980_364_137_554, 452.191_745_021_434_77],
        ),
        (
            "SIMPLE_RADIAL_FISHEYE",
            &[500.0, 320.0, 240.0, -0.1],
            [466.166_764_032_142_1, 136.268_748_106_221_75, 73.258_346_094_905_9, 425.056_240_428_820_6],
        ),
        (
            "RADIAL_FISHEYE",
            &[500.0, 320.0, 240.0, -0.1, 0.02],
            [466.218_349_501_684_26, 136.232_139_063_320_86, 72.375_598_618_288_45, 425.718_301_036_283_6],
        ),
        (
            "THIN_PRISM_FISHEYE",
            &[500.0, 510.0, 321.0, 239.0, -0.1, 0.02, 0.003, -0.004, 0.01, 0.02, 0.005, -0.006],
            [466.750_748_636_979_84, 133.341_127_614_512_46, 71.592_132_810_311_14, 429.321_845_905_733_6],
        ),
        (
            "RAD_TAN_THIN_PRISM_FISHEYE",
            &[
                500.0, 510.0, 321.0, 239.0, -0.1, 0.02, 0.01, -0.004, 0.003, 0.001, 0.002, -0.003, 0.005, -0.006,
                0.004, 0.002,
            ],
            [467.975_194_503_118_7, 132.981_267_731_502_84, 75.157_503_091_826_75, 428.104_933_543_877_2],
        ),
        (
            "SIMPLE_DIVISION",
            &[500.0, 320.0, 240.0, -0.2],
            [470.762_101_881_229_8, 133.007_540_600_417_54, 47.787_389_494_360_58, 444.159_457_879_229_54],
        ),
        (
            "DIVISION",
            &[500.0, 510.0, 321.0, 239.0, 0.15],
            [479.513_668_980_807_67, 124.256_557_034_537_96, -9.771_502_568_914_912, 492.040_199_465_219_9],
        ),
        (
            "SIMPLE_FISHEYE",
            &[500.0, 320.0, 240.0],
            [468.121_362_460_431_95, 134.881_613_737_757_96, 62.599_556_482_686_296, 433.050_332_637_985_3],
        ),
        (
            "FISHEYE",
            &[500.0, 510.0, 321.0, 239.0],
            [469.121_362_460_431_95, 131.779_246_012_513_1, 63.599_556_482_686_296, 435.911_339_290_745],
        ),
        (
            "EUCM",
            &[500.0, 510.0, 321.0, 239.0, 0.6, 1.1],
            [469.193_864_735_936_13, 131.726_763_720_180_43, 63.130_829_804_871_61, 436.269_915_199_273_2],
        ),
        (
            "EQUIRECTANGULAR",
            &[1024.0, 512.0],
            [560.991_107_388_107_3, 222.244_506_045_816_56, 423.925_314_753_213_1, 316.018_335_357_420_14],
        ),
    ];

    #[test]
    fn every_camera_model_sees_what_colmap_sees() {
        assert_eq!(SEEN.len(), MODELS.len());
        for (model, parameters, seen) in SEEN {
            assert!(MODELS.iter().any(|m| m.0 == model && m.2 == parameters.len()), "{model}");
            let lens = lens(model, parameters).unwrap();
            let k = lens.intrinsics;
            for (p, expected) in [(Point2::new(0.31, -0.22), &seen[..2]), (Point2::new(-0.6, 0.45), &seen[2..])] {
                let bent = lens.distortion.distort(&p);
                // The corner of COLMAP's images is (0, 0).
                let found = [bent.x * k.fx + k.cx + 0.5, bent.y * k.fy + k.cy + 0.5];
                let off = (found[0] - expected[0]).abs().max((found[1] - expected[1]).abs());
                assert!(off < 1e-9, "{model}: {found:?}, COLMAP {expected:?}");
            }
        }
    }

    #[test]
    fn what_a_lens_cannot_see_has_no_pixel() {
        // Beyond r = 1.12 the division model with k = 0.2 has no image; the fold of a polynomial is no image either.
        let lens = lens("SIMPLE_DIVISION", &[50.0, 80.0, 60.0, 0.2]).unwrap();
        assert!(lens.distortion.distort(&Point2::new(1.2, 0.0)).x.is_nan());
        let photo = mb_image::RgbImage::filled(ImageSize::new(160, 120), [9; 3]);
        let (_, valid) = lens.undistort(&photo);
        assert!(valid[(80, 60)] && !valid[(0, 0)]);
    }

    #[test]
    fn a_text_model_without_its_empty_lines_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("cameras.txt"), "1 PINHOLE 64 48 50 50 32 24\n").unwrap();
        let image = |id: u32| format!("{id} 1 0 0 0 0 0 0 1 {id}.jpg\n");
        std::fs::write(dir.path().join("images.txt"), image(1) + &image(2)).unwrap();
        let message = ColmapModel::read(dir.path()).unwrap_err().to_string();
        assert!(message.contains("images.txt: line 2") && message.contains("two lines"), "{message}");
        std::fs::write(dir.path().join("images.txt"), image(1) + "1.5 2.5 -1\n" + &image(2)).unwrap();
        assert_eq!(ColmapModel::read(dir.path()).unwrap().images.len(), 2);
    }
}
