//! Reading GLB files.

use std::borrow::Cow;
use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use mb_job::{InputError, Result};
use nalgebra::{Matrix4, Point3, Quaternion, UnitQuaternion, Vector3};
use serde_json::Value;

use super::{
    BIN_CHUNK, F32, JSON_CHUNK, MAGIC, TRIANGLE_FAN, TRIANGLE_STRIP, TRIANGLES, U8, U16, U32, srgb_from_linear,
};
use crate::TriangleMesh;
use crate::files::{Builder, Dropped};

/// Deeper trees of nodes are refused.
const MAX_DEPTH: usize = 256;
/// More vertices or triangles than this are refused: instances can ask for any number in few bytes.
const MAX_ITEMS: usize = 1 << 28;

/// Reads all triangles of the default scene, with node transforms applied: `COLOR_0` as vertex colours, the material's
/// base colour as triangle colours, and each node with a mesh as a part where there are several. Textures, skins and
/// animations are passed over; compressed (Draco, meshopt) and external data is an error, a buffer inside the JSON chunk
/// (a `data:` URI, as Open3D writes) is not.
pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<(TriangleMesh, Dropped)> {
    let glb = Glb::open(path, bytes)?;
    let scene = &glb.json["scenes"][glb.json["scene"].as_u64().unwrap_or(0) as usize];
    let roots: Vec<u64> = match scene["nodes"].as_array() {
        Some(nodes) => nodes.iter().filter_map(Value::as_u64).collect(),
        None => (0..array(&glb.json["nodes"]).len() as u64).collect(),
    };
    let mut instances = Vec::new();
    let mut visited = vec![false; array(&glb.json["nodes"]).len()];
    for root in roots {
        glb.collect(root, &Matrix4::identity(), 0, &mut visited, &mut instances)?;
    }
    let mut builder = Builder::new(path);
    let parts = instances.len();
    for (part, (mesh, transform)) in instances.into_iter().enumerate() {
        let primitives = array(&glb.json["meshes"][mesh as usize]["primitives"]);
        for primitive in primitives {
            let place = || format!("mesh {mesh}");
            glb.primitive(primitive, &transform, (parts > 1).then_some(part as u32), &mut builder)
                .map_err(|found| InputError::new(path, found).at(place()))?;
        }
    }
    builder.finish()
}

fn array(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

struct Glb<'a> {
    path: &'a Path,
    json: Value,
    bin: Cow<'a, [u8]>,
}

/// A view of numbers in the buffer.
struct Accessor<'a> {
    bytes: &'a [u8],
    component: u64,
    components: usize,
    stride: usize,
    count: usize,
}

impl<'a> Glb<'a> {
    fn open(path: &'a Path, bytes: &'a [u8]) -> Result<Self> {
        let bad = |found: &str| InputError::new(path, found).help("Export the file again as binary glTF 2.0 (.glb)");
        let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        if word(0) != Some(MAGIC) {
            return Err(bad("not a binary glTF file").into());
        }
        if word(4) != Some(2) {
            return Err(bad("not version 2 of binary glTF").into());
        }
        let mut chunks = Vec::new();
        let mut at = 12;
        while let (Some(length), Some(kind)) = (word(at), word(at + 4)) {
            let start = at + 8;
            let end = start.checked_add(length as usize).filter(|&end| end <= bytes.len());
            let end = end.ok_or_else(|| bad("a chunk is longer than the file; it is truncated"))?;
            chunks.push((kind, &bytes[start..end]));
            at = end;
        }
        let chunk = |wanted: u32| chunks.iter().find(|(kind, _)| *kind == wanted).map(|(_, bytes)| *bytes);
        let json = chunk(JSON_CHUNK).ok_or_else(|| bad("the file has no JSON chunk; it is truncated"))?;
        let json: Value = serde_json::from_slice(json).map_err(|e| bad(&format!("the JSON chunk is damaged ({e})")))?;
        if let Some(required) = array(&json["extensionsRequired"])
            .iter()
            .filter_map(Value::as_str)
            .find(|name| name.contains("draco") || name.contains("meshopt") || name.contains("quantization"))
        {
            let found = format!("the file needs the extension {required}, which cannot be read");
            return Err(InputError::new(path, found).help("Export it without compression").into());
        }
        let inline = match json["buffers"][0]["uri"].as_str().and_then(|uri| uri.strip_prefix("data:")) {
            Some(data) => {
                let (_, encoded) =
                    data.split_once(";base64,").ok_or_else(|| bad("the buffer in the JSON chunk is not in base64"))?;
                let decoded = BASE64_STANDARD.decode(encoded);
                Some(decoded.map_err(|e| bad(&format!("the buffer in the JSON chunk is damaged ({e})")))?)
            }
            None => None,
        };
        let bin = inline.map_or_else(|| Cow::Borrowed(chunk(BIN_CHUNK).unwrap_or_default()), Cow::Owned);
        Ok(Self { path, json, bin })
    }

    /// Adds (mesh, transform) of a node and its children.
    fn collect(
        &self,
        node: u64,
        parent: &Matrix4<f64>,
        depth: usize,
        visited: &mut [bool],
        instances: &mut Vec<(u64, Matrix4<f64>)>,
    ) -> Result<()> {
        let bad = |found: String| InputError::new(self.path, found).at(format!("node {node}"));
        let json =
            array(&self.json["nodes"]).get(node as usize).ok_or_else(|| bad("there is no such node".to_owned()))?;
        if std::mem::replace(&mut visited[node as usize], true) {
            return Err(bad("the node has two parents".to_owned()).into());
        }
        if depth > MAX_DEPTH {
            return Err(bad(format!("the nodes are nested more than {MAX_DEPTH} deep")).into());
        }
        let transform = parent * local_transform(json);
        if let Some(mesh) = json["mesh"].as_u64() {
            instances.push((mesh, transform));
        }
        for child in array(&json["children"]).iter().filter_map(Value::as_u64) {
            self.collect(child, &transform, depth + 1, visited, instances)?;
        }
        Ok(())
    }

    fn primitive(
        &self,
        primitive: &Value,
        transform: &Matrix4<f64>,
        part: Option<u32>,
        builder: &mut Builder,
    ) -> std::result::Result<(), String> {
        let mode = primitive["mode"].as_u64().unwrap_or(TRIANGLES);
        if ![TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN].contains(&mode) {
            return Ok(());
        }
        let attributes = &primitive["attributes"];
        let positions = self.accessor(&attributes["POSITION"])?;
        let colors = match &attributes["COLOR_0"] {
            Value::Null => None,
            color => Some(self.accessor(color)?),
        };
        if positions.component != F32 || positions.components != 3 {
            return Err("POSITION is not of three floats".to_owned());
        }
        if colors.as_ref().is_some_and(|c| c.count != positions.count || c.components < 3) {
            return Err("COLOR_0 is not one colour a vertex".to_owned());
        }
        let first = builder.vertex_count();
        if first + positions.count > MAX_ITEMS {
            return Err(format!("the scene has more than {MAX_ITEMS} vertices"));
        }
        for i in 0..positions.count {
            let p = Point3::from(std::array::from_fn(|axis| positions.number(i, axis)));
            let color = colors.as_ref().map(|c| std::array::from_fn(|axis| srgb_from_linear(c.number(i, axis))));
            builder.vertex(Point3::from((transform * p.to_homogeneous()).xyz()), color);
        }
        let corners: Vec<f64> = match &primitive["indices"] {
            Value::Null => (0..positions.count).map(|i| i as f64).collect(),
            indices => {
                let indices = self.accessor(indices)?;
                if indices.component == F32 || indices.components != 1 {
                    return Err("the indices are not integers".to_owned());
                }
                (0..indices.count).map(|i| indices.integer(i)).collect()
            }
        };
        let material = primitive["material"].as_u64().map(|m| &self.json["materials"][m as usize]);
        let base = material.map(|m| array(&m["pbrMetallicRoughness"]["baseColorFactor"]));
        let color =
            base.filter(|b| b.len() >= 3).map(|b| [0, 1, 2].map(|i| srgb_from_linear(b[i].as_f64().unwrap_or(1.0))));
        let mirrored = transform.fixed_view::<3, 3>(0, 0).determinant() < 0.0;
        let steps = if mode == TRIANGLES { corners.len() / 3 } else { corners.len().saturating_sub(2) };
        if builder.triangle_count() + steps > MAX_ITEMS {
            return Err(format!("the scene has more than {MAX_ITEMS} triangles"));
        }
        for i in 0..steps {
            let [a, b, c] = match mode {
                TRIANGLES => [3 * i, 3 * i + 1, 3 * i + 2],
                TRIANGLE_STRIP => [i, i + 1 + i % 2, i + 2 - i % 2],
                _ => [0, i + 1, i + 2],
            };
            let (b, c) = if mirrored { (c, b) } else { (b, c) };
            let face = [a, b, c].map(|k| corners[k]);
            if let Some(bad) = face.iter().find(|&&k| k >= positions.count as f64) {
                return Err(format!("an index is {bad}, but there are {} vertices", positions.count));
            }
            builder.face(&face.map(|k| k + first as f64), color, part)?;
        }
        Ok(())
    }

    fn accessor(&self, index: &Value) -> std::result::Result<Accessor<'_>, String> {
        let bad = || "an accessor is missing or damaged".to_owned();
        let accessor = array(&self.json["accessors"]).get(index.as_u64().ok_or_else(bad)? as usize).ok_or_else(bad)?;
        if !accessor["sparse"].is_null() {
            return Err("sparse accessors cannot be read".to_owned());
        }
        let view = accessor["bufferView"].as_u64().ok_or_else(bad)?;
        let view = array(&self.json["bufferViews"]).get(view as usize).ok_or_else(bad)?;
        let is_outside = |uri: &str| !uri.starts_with("data:");
        if view["buffer"].as_u64() != Some(0) || self.json["buffers"][0]["uri"].as_str().is_some_and(is_outside) {
            return Err("the data lies outside the file".to_owned());
        }
        let component = accessor["componentType"].as_u64().ok_or_else(bad)?;
        let size = match component {
            U8 => 1,
            U16 => 2,
            U32 | F32 => 4,
            other => return Err(format!("an accessor has the component type {other}")),
        };
        let components = match accessor["type"].as_str() {
            Some("SCALAR") => 1,
            Some("VEC3") => 3,
            Some("VEC4") => 4,
            _ => return Err(bad()),
        };
        let number = |value: &Value| value.as_u64().unwrap_or(0) as usize;
        let count = accessor["count"].as_u64().ok_or_else(bad)? as usize;
        let start = number(&view["byteOffset"]);
        let end = start.checked_add(number(&view["byteLength"])).ok_or_else(bad)?;
        let bytes = self.bin.get(start..end).and_then(|bytes| bytes.get(number(&accessor["byteOffset"])..));
        let bytes = bytes.ok_or("a buffer view reaches past the end; the file is truncated")?;
        let stride = match number(&view["byteStride"]) {
            0 => size * components,
            stride => stride,
        };
        let needed = count.checked_sub(1).map_or(Some(0), |n| n.checked_mul(stride)?.checked_add(size * components));
        if needed.is_none_or(|needed| needed > bytes.len()) {
            return Err(format!("an accessor of {count} items reaches past the end of its data"));
        }
        Ok(Accessor { bytes, component, components, stride, count })
    }
}

impl Accessor<'_> {
    fn at<const N: usize>(&self, item: usize, component: usize) -> [u8; N] {
        let start = item * self.stride + component * N;
        self.bytes[start..start + N].try_into().expect("a slice of N bytes")
    }

    /// A component; integers are shares of their largest value.
    fn number(&self, item: usize, component: usize) -> f64 {
        match self.component {
            U8 => f64::from(self.at::<1>(item, component)[0]) / 255.0,
            U16 => f64::from(u16::from_le_bytes(self.at(item, component))) / 65535.0,
            U32 => f64::from(u32::from_le_bytes(self.at(item, component))) / f64::from(u32::MAX),
            _ => f64::from(f32::from_le_bytes(self.at(item, component))),
        }
    }

    fn integer(&self, item: usize) -> f64 {
        match self.component {
            U8 => f64::from(self.at::<1>(item, 0)[0]),
            U16 => f64::from(u16::from_le_bytes(self.at(item, 0))),
            _ => f64::from(u32::from_le_bytes(self.at(item, 0))),
        }
    }
}

fn local_transform(node: &Value) -> Matrix4<f64> {
    let numbers = |key: &str| -> Vec<f64> { array(&node[key]).iter().filter_map(Value::as_f64).collect() };
    let matrix = numbers("matrix");
    if matrix.len() == 16 {
        return Matrix4::from_column_slice(&matrix);
    }
    let mut transform = Matrix4::identity();
    if let [x, y, z] = numbers("translation")[..] {
        transform.append_translation_mut(&Vector3::new(x, y, z));
    }
    if let [x, y, z, w] = numbers("rotation")[..] {
        transform *= UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_homogeneous();
    }
    if let [x, y, z] = numbers("scale")[..] {
        transform *= Matrix4::new_nonuniform_scaling(&Vector3::new(x, y, z));
    }
    transform
}
