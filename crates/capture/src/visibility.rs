//! The visibility volume: which part of space a capture could judge.

use std::path::Path;

use mb_job::{InputError, Result, write_atomic_with};
use nalgebra::Point3;

use crate::pickle::{Fault, Pickle, Value};

/// Voxels that some frame sees through or up to its surface; what lies elsewhere (behind surfaces, outside every view)
/// cannot be judged, and scores leave it out.
///
/// On disk it is `visibility_mask.npy`, a pickled dictionary as the published data set has it; in Python it is
/// `numpy.load(path, allow_pickle=True).item()`. Reading it here runs no code.
#[derive(Debug, Clone, PartialEq)]
pub struct VisibilityVolume {
    /// `[X, Y, Z]` in C order (z runs fastest): whether a voxel is visible.
    pub mask: Vec<bool>,
    /// Number of voxels along x, y, z, each at least 1.
    pub resolutions: [usize; 3],
    /// Edge of a voxel, metres.
    pub voxel_size_m: f64,
    /// Centre of voxel (0, 0, 0), in the sequence's world frame, metres.
    pub min_pt_in_world: Point3<f64>,
}

impl VisibilityVolume {
    /// Reads `visibility_mask.npy`.
    ///
    /// Besides the exact published types, `mask` may be any array of numbers (visible where above zero, as the published
    /// scorer has it), flat or three-dimensional; `resolutions` and `min_pts` may be lists.
    ///
    /// # Errors
    /// The file is missing or truncated, is no pickled dictionary of these four entries, wants to run code, or its
    /// numbers contradict each other.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
        Ok(Self::parse(path, &bytes)?)
    }

    fn parse(path: &Path, bytes: &[u8]) -> Result<Self, InputError> {
        let bad = |found: String| {
            InputError::new(path, found).help(
                "Expected a pickled dictionary with mask, resolutions, voxel_size and min_pts; `mobilebrick truth` writes one",
            )
        };
        let start = pickle_start(bytes).map_err(|found| bad(found.to_owned()))?;
        let pickle = Pickle::read(&bytes[start..]).map_err(|Fault { byte, found }| {
            bad(format!("the pickle has {found}")).at(format!("byte {}", start + byte))
        })?;
        let dict = match pickle.root() {
            Value::Dict(dict) => dict,
            Value::Array(array) => match array.content.map(|id| pickle.get(id)) {
                Some(Value::Items(items)) if items.len() == 1 => match pickle.get(items[0]) {
                    Value::Dict(dict) => dict,
                    _ => return Err(bad("the array holds something else than a dictionary".to_owned())),
                },
                _ => return Err(bad("the array does not hold exactly one dictionary".to_owned())),
            },
            _ => return Err(bad("the pickle holds something else than a dictionary".to_owned())),
        };
        let entry = |key: &str| pickle.entry(dict, key).ok_or_else(|| bad(format!("the entry {key:?} is missing")));
        let three = |key: &str| -> Result<[f64; 3], InputError> {
            let numbers = pickle.numbers(entry(key)?).and_then(|n| <[f64; 3]>::try_from(n).ok());
            numbers.ok_or_else(|| bad(format!("the entry {key:?} is not three numbers")))
        };
        let resolutions = three("resolutions")?;
        if !resolutions.iter().all(|&r| r >= 1.0 && r.fract() == 0.0 && r < 1e9) {
            return Err(bad(format!("resolutions are {resolutions:?}")));
        }
        let resolutions = resolutions.map(|r| r as usize);
        let min = three("min_pts")?;
        if !min.iter().all(|m| m.is_finite()) {
            return Err(bad(format!("min_pts is {min:?}")));
        }
        let voxel_size_m = pickle.number(entry("voxel_size")?).filter(|v| v.is_finite() && *v > 0.0);
        let voxel_size_m = voxel_size_m.ok_or_else(|| bad("voxel_size is not a number above zero".to_owned()))?;
        let mask = pickle.numbers_as(entry("mask")?, |m| m > 0.0);
        let mask = mask.ok_or_else(|| bad("the mask is not an array of numbers".to_owned()))?;
        let voxels = resolutions.iter().try_fold(1usize, |n, &r| n.checked_mul(r));
        if voxels != Some(mask.len()) {
            return Err(bad(format!("the mask has {} entries, which {resolutions:?} voxels have not", mask.len())));
        }
        Ok(Self { mask, resolutions, voxel_size_m, min_pt_in_world: min.into() })
    }

    /// Writes `visibility_mask.npy`, readable by numpy 1 and 2 on Python 3.4 and later.
    ///
    /// # Errors
    /// The file cannot be written.
    ///
    /// # Panics
    /// The mask's length is not the product of the resolutions.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        assert_eq!(self.mask.len(), self.resolutions.iter().product::<usize>(), "one mask entry per voxel");
        let mask: Vec<u8> = self.mask.iter().map(|&m| u8::from(m)).collect();
        let resolutions: Vec<u8> = self.resolutions.iter().flat_map(|&r| (r as i64).to_le_bytes()).collect();
        let min: Vec<u8> = self.min_pt_in_world.iter().flat_map(|c| c.to_le_bytes()).collect();

        // Protocol 4 and the module names of numpy 1, which numpy 2 still answers to.
        let mut pickle: Vec<u8> = b"\x80\x04".to_vec();
        begin_array(&mut pickle, &[], "O8", b'|');
        pickle.extend(b"]}(");
        text(&mut pickle, "mask");
        array(&mut pickle, &[mask.len()], "b1", b'|', &mask);
        text(&mut pickle, "resolutions");
        array(&mut pickle, &[3], "i8", b'<', &resolutions);
        text(&mut pickle, "voxel_size");
        pickle.push(b'G');
        pickle.extend(self.voxel_size_m.to_be_bytes());
        text(&mut pickle, "min_pts");
        array(&mut pickle, &[3], "f8", b'<', &min);
        pickle.extend(b"uatb.");

        let mut header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }".to_vec();
        // The content begins at a multiple of 64.
        header.resize(127 - 10, b' ');
        header.push(b'\n');
        write_atomic_with(path, |out| {
            out.write_all(b"\x93NUMPY\x01\x00")?;
            out.write_all(&(header.len() as u16).to_le_bytes())?;
            out.write_all(&header)?;
            out.write_all(&pickle)
        })
    }

    /// Whether the voxel whose centre is nearest to a point is visible; outside the volume nothing is.
    pub fn contains(&self, p_in_world: &Point3<f64>) -> bool {
        let voxel = (p_in_world - self.min_pt_in_world) / self.voxel_size_m;
        self.is_visible(voxel.map(f64::round_ties_even).into())
    }

    /// Whether the voxel with these indices (integers held as floats) is visible; outside the volume, and for NaN,
    /// nothing is.
    pub fn is_visible(&self, voxel: [f64; 3]) -> bool {
        let inside = voxel.iter().zip(&self.resolutions).all(|(&i, &n)| i >= 0.0 && i < n as f64);
        inside && self.mask[self.index(voxel.map(|i| i as usize))]
    }

    /// Where a voxel's entry is in the mask.
    pub fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.resolutions[1] + y) * self.resolutions[2] + z
    }
}

/// Where the pickle begins in an npy file of objects.
fn pickle_start(bytes: &[u8]) -> Result<usize, &'static str> {
    let Some(rest) = bytes.strip_prefix(b"\x93NUMPY") else { return Err("not an npy file") };
    let truncated = "the file ends too early; it is truncated";
    let (header_at, header_length) = match rest {
        [1, _, a, b, ..] => (10usize, u16::from_le_bytes([*a, *b]) as usize),
        [2 | 3, _, a, b, c, d, ..] => (12, u32::from_le_bytes([*a, *b, *c, *d]) as usize),
        [1..=3, ..] | [] => return Err(truncated),
        _ => return Err("an npy file of an unknown version"),
    };
    let header = header_at.checked_add(header_length).and_then(|end| bytes.get(header_at..end)).ok_or(truncated)?;
    let header = String::from_utf8_lossy(header);
    if !header.contains("'|O'") && !header.contains("'O'") {
        return Err("an npy file of plain numbers");
    }
    Ok(header_at + header_length)
}

fn text(pickle: &mut Vec<u8>, text: &str) {
    pickle.push(b'X');
    pickle.extend((text.len() as u32).to_le_bytes());
    pickle.extend(text.as_bytes());
}

fn int(pickle: &mut Vec<u8>, value: usize) {
    pickle.extend(b"\x8a\x08");
    pickle.extend((value as u64).to_le_bytes());
}

/// An array up to the content of its state: `_reconstruct(ndarray, (0,), b"b")` and `(1, shape, dtype, False, ...`.
fn begin_array(pickle: &mut Vec<u8>, shape: &[usize], code: &str, byte_order: u8) {
    pickle.extend(b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R(K\x01(");
    shape.iter().for_each(|&d| int(pickle, d));
    pickle.extend(b"tcnumpy\ndtype\n");
    text(pickle, code);
    // dtype(code, False, True), then its state (3, byte order, None, None, None, -1, -1, flags); 63 are the flags of
    // objects.
    pickle.extend(b"\x89\x88\x87R(K\x03");
    text(pickle, std::str::from_utf8(&[byte_order]).expect("byte orders are ASCII"));
    pickle.extend(b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK");
    pickle.push(if code.starts_with('O') { 63 } else { 0 });
    pickle.extend(b"tb\x89");
}

fn array(pickle: &mut Vec<u8>, shape: &[usize], code: &str, byte_order: u8, content: &[u8]) {
    begin_array(pickle, shape, code, byte_order);
    pickle.push(0x8e);
    pickle.extend((content.len() as u64).to_le_bytes());
    pickle.extend(content);
    pickle.extend(b"tb");
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn volume(resolutions: [usize; 3], mask: impl Fn([usize; 3]) -> bool) -> VisibilityVolume {
        let [nx, ny, nz] = resolutions;
        let mut cells = Vec::new();
        for x in 0..nx {
            for y in 0..ny {
                for z in 0..nz {
                    cells.push(mask([x, y, z]));
                }
            }
        }
        VisibilityVolume {
            mask: cells,
            resolutions,
            voxel_size_m: 0.0025,
            min_pt_in_world: Point3::new(0.1, -0.2, 0.3),
        }
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(
            resolutions in prop::array::uniform3(1..6usize),
            bits in any::<u128>(),
            voxel_size_m in 1e-4..1.0f64,
            min in prop::array::uniform3(-10.0..10.0f64),
        ) {
            let mut volume = volume(resolutions, |[x, y, z]| bits >> ((x * 7 + y * 3 + z) % 128) & 1 == 1);
            volume.voxel_size_m = voxel_size_m;
            volume.min_pt_in_world = min.into();
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("visibility_mask.npy");
            volume.write(&path).unwrap();
            prop_assert_eq!(VisibilityVolume::read(&path).unwrap(), volume);
        }

        #[test]
        fn a_damaged_file_is_refused_or_consistent(at in 0..900usize, byte in any::<u8>()) {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("v.npy");
            volume([2, 3, 4], |_| true).write(&path).unwrap();
            let mut bytes = std::fs::read(&path).unwrap();
            let at = at % bytes.len();
            bytes[at] = byte;
            if let Ok(read) = VisibilityVolume::parse(&path, &bytes) {
                prop_assert_eq!(read.mask.len(), read.resolutions.iter().product::<usize>());
            }
            prop_assert!(VisibilityVolume::parse(&path, &bytes[..at]).is_err());
        }
    }

    #[test]
    fn a_point_belongs_to_the_nearest_voxel() {
        let volume = volume([2, 3, 4], |v| v == [1, 2, 0]);
        let centre = volume.min_pt_in_world + nalgebra::Vector3::new(1.0, 2.0, 0.0) * 0.0025;
        for (offset, expected) in [
            ([0.0; 3], true),
            ([0.00124, -0.00124, 0.00124], true),
            ([0.0, 0.0, 0.00126], false),
            ([0.00126, 0.0, 0.0], false),
        ] {
            assert_eq!(volume.contains(&(centre + nalgebra::Vector3::from(offset))), expected, "{offset:?}");
        }
        assert!(!volume.contains(&Point3::new(f64::NAN, 0.0, 0.0)));
        assert!(!volume.contains(&Point3::new(1e300, 0.0, 0.0)));
    }

    #[test]
    fn the_published_format_is_read() {
        let Some(path) = mb_testdata::find("official_scorer/wedge/visibility_mask.npy") else { return };
        let volume = VisibilityVolume::read(path).unwrap();
        assert_eq!(volume.resolutions, [61, 68, 80]);
        assert_eq!(volume.voxel_size_m, 0.0025);
        assert!((volume.min_pt_in_world - Point3::new(0.04926827, -0.42713558, -0.6572488)).norm() < 1e-7);
        // numpy counts the same.
        assert_eq!(volume.mask.iter().filter(|&&m| m).count(), 318_818);
    }

    #[test]
    fn each_defect_is_named() {
        let path = Path::new("v.npy");
        let dir = tempfile::tempdir().unwrap();
        let good_path = dir.path().join("v.npy");
        volume([2, 3, 4], |_| true).write(&good_path).unwrap();
        let good = std::fs::read(&good_path).unwrap();
        let replaced = |from: &[u8], to: &[u8]| {
            let at = good.windows(from.len()).position(|w| w == from).unwrap();
            [&good[..at], to, &good[at + from.len()..]].concat()
        };
        for (bytes, found) in [
            (b"no".to_vec(), "not an npy file"),
            (good[..40].to_vec(), "truncated"),
            (replaced(b"'|O'", b"'<f8"), "plain numbers"),
            (replaced(b"cnumpy\nndarray\n", b"cos\nsystem\n"), "os.system, which is never made"),
            (replaced(b"min_pts", b"max_pts"), "\"min_pts\" is missing"),
            (
                replaced(b"\x02\x00\x00\x00\x00\x00\x00\x00\x03", b"\x05\x00\x00\x00\x00\x00\x00\x00\x03"),
                "24 entries, which [5, 3, 4] voxels have not",
            ),
            (replaced(&0.0025f64.to_be_bytes(), &(-1f64).to_be_bytes()), "voxel_size"),
        ] {
            let message = VisibilityVolume::parse(path, &bytes).unwrap_err().to_string();
            assert!(message.contains(found), "{message}");
        }
    }
}
