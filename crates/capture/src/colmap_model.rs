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
const MODELS: [(&str, u32, usize); 12] = [
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
    // Models with one focal length, then those with two.
    let (focal, rest) = match model {
        "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => {
            ((p[0], p[0]), &p[1..])
        }
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
        "FOV" => Distortion::FieldOfView { omega: c[0] },
        other => return Err(format!("camera model {other} cannot be undistorted here; undistort with COLMAP first")),
    };
    if !(focal.0 > 0.0 && focal.1 > 0.0 && p.iter().all(|v| v.is_finite())) {
        return Err(format!("camera parameters {p:?} hold a focal length that is not above 0, or no number"));
    }
    Ok(Lens { intrinsics: Intrinsics { fx: focal.0, fy: focal.1, cx: cx - 0.5, cy: cy - 0.5 }, distortion })
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
            lines.next();
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
