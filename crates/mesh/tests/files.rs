//! Mesh files: what was written comes back, what others write is understood, what is broken is told.

use std::path::{Path, PathBuf};

use mb_job::Error;
use mb_mesh::{TriangleMesh, read_mesh, read_mesh_lenient, read_ply, write_mesh};
use nalgebra::Point3;
use proptest::prelude::*;

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary folder")
}

fn file(dir: &tempfile::TempDir, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
    let path = dir.path().join(name);
    std::fs::write(&path, bytes).expect("a writable temporary folder");
    path
}

/// The sentence of the input error that reading gives.
fn complaint(path: &Path) -> String {
    match read_mesh_lenient(path) {
        Err(Error::Input(e)) => e.to_string(),
        other => panic!("{} was read as {other:?}", path.display()),
    }
}

/// Two coloured triangles of two parts; positions are exact in `f32`.
fn sample() -> TriangleMesh {
    TriangleMesh {
        vertices: [[0., 0., 0.], [0.5, 0., 0.], [0., 0.25, 0.], [0., 0., -0.125]].map(Point3::from).to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        vertex_colors: Some(vec![[255, 0, 0], [0, 128, 0], [3, 2, 1], [9, 200, 77]]),
        triangle_colors: Some(vec![[201, 26, 9], [0, 85, 191]]),
        triangle_parts: Some(vec![0, 1]),
    }
}

/// Corner positions and the attributes of each triangle, whatever the order of vertices and triangles.
fn triangles(mesh: &TriangleMesh) -> Vec<String> {
    let mut all: Vec<String> = (0..mesh.triangles.len())
        .map(|t| {
            let at = |colors: &Option<Vec<[u8; 3]>>, i: usize| colors.as_ref().map(|c| c[i]);
            let corners: Vec<_> =
                mesh.triangles[t].map(|v| (mesh.vertices[v as usize], at(&mesh.vertex_colors, v as usize))).to_vec();
            let part = mesh.triangle_parts.as_ref().map(|p| p[t]);
            format!("{corners:?} {:?} {part:?}", at(&mesh.triangle_colors, t))
        })
        .collect();
    all.sort();
    all
}

#[test]
fn ply_round_trip_is_exact() {
    let dir = folder();
    let path = dir.path().join("mesh.ply");
    let mut mesh = sample();
    mesh.vertices[1].x = 0.1 + 1e-17;
    write_mesh(&path, &mesh).unwrap();
    assert_eq!(read_mesh(&path).unwrap(), mesh);
    let plain = TriangleMesh::new(mesh.vertices, mesh.triangles);
    write_mesh(&path, &plain).unwrap();
    assert_eq!(read_ply(&path).unwrap(), plain);
    let cloud = TriangleMesh::new(plain.vertices, Vec::new());
    write_mesh(&path, &cloud).unwrap();
    assert_eq!(read_mesh(&path).unwrap(), cloud);
}

#[test]
fn every_format_brings_back_what_it_can_hold() {
    let dir = folder();
    for (name, keeps_colors) in [("mesh.ply", true), ("mesh.obj", true), ("mesh.glb", true), ("mesh.stl", false)] {
        let path = dir.path().join(name);
        let mut mesh = sample();
        write_mesh(&path, &mesh).unwrap();
        if !keeps_colors {
            (mesh.vertex_colors, mesh.triangle_colors, mesh.triangle_parts) = (None, None, None);
        }
        assert_eq!(triangles(&read_mesh(&path).unwrap()), triangles(&mesh), "{name}");
    }
}

#[test]
fn an_empty_mesh_can_be_written_and_read() {
    let dir = folder();
    for name in ["mesh.ply", "mesh.obj", "mesh.glb", "mesh.stl"] {
        let path = dir.path().join(name);
        write_mesh(&path, &TriangleMesh::default()).unwrap();
        assert_eq!(read_mesh(&path).unwrap(), TriangleMesh::default(), "{name}");
    }
}

const TEXT: &str = "ply\r\nformat ascii 1.0\r\ncomment by hand\r\nelement junk 2\r\nproperty list uchar float numbers\r\n\
    element vertex 5\r\nproperty float nx\r\nproperty double x\r\nproperty float y\r\nproperty short z\r\n\
    property uchar red\r\nproperty uchar green\r\nproperty uchar blue\r\n\
    element face 2\r\nproperty uchar flags\r\nproperty list uint8 int32 vertex_index\r\nend_header\r\n\
    0\r\n3 1.5 2.5 3.5\r\n\
    0 0 0 0 1 2 3\r\n0 1 0 0 1 2 3\r\n0 1 1 0 1 2 3\r\n0 0 1 0 1 2 3\r\n0 0.5 2 -1 1 2 3\r\n\
    7 4 0 1 2 3\r\n7 3 3 2 4\r\n";

#[test]
fn a_text_file_with_quads_and_properties_of_its_own_is_understood() {
    let dir = folder();
    let mesh = read_mesh(file(&dir, "mesh.ply", TEXT)).unwrap();
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [3, 2, 4]]);
    assert_eq!(mesh.vertices[4], Point3::new(0.5, 2.0, -1.0));
    assert_eq!(mesh.vertex_colors, Some(vec![[1, 2, 3]; 5]));
}

/// The same content in the three encodings of the format.
#[test]
fn encodings_agree() {
    let dir = folder();
    let expected = read_mesh(file(&dir, "text.ply", TEXT)).unwrap();
    for big in [false, true] {
        let endian = if big { "big" } else { "little" };
        let mut bytes =
            TEXT.split("end_header\r\n").next().unwrap().replace("ascii", &format!("binary_{endian}_endian"));
        bytes.push_str("end_header\r\n");
        let mut bytes = bytes.into_bytes();
        let mut put = |le: &[u8]| {
            let mut le = le.to_vec();
            if big {
                le.reverse();
            }
            bytes.extend(le);
        };
        put(&[0]);
        put(&[3]);
        [1.5f32, 2.5, 3.5].iter().for_each(|v| put(&v.to_le_bytes()));
        for p in &expected.vertices {
            put(&0f32.to_le_bytes());
            put(&p.x.to_le_bytes());
            put(&(p.y as f32).to_le_bytes());
            put(&(p.z as i16).to_le_bytes());
            [1, 2, 3].iter().for_each(|&c: &u8| put(&[c]));
        }
        for face in [&[0, 1, 2, 3][..], &[3, 2, 4]] {
            put(&[7]);
            put(&[face.len() as u8]);
            face.iter().for_each(|v: &i32| put(&v.to_le_bytes()));
        }
        assert_eq!(read_mesh(file(&dir, "binary.ply", &bytes)).unwrap(), expected, "{endian}");
        for cut in [1, 30, 60] {
            let found = complaint(&file(&dir, "cut.ply", &bytes[..bytes.len() - cut]));
            assert!(
                found.contains("cut.ply") && found.contains("truncated") || found.contains("ends before"),
                "{found}"
            );
        }
    }
}

#[test]
fn faults_in_ply_files_are_told_with_their_place() {
    let dir = folder();
    let vertices = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
    let faces = "element face 1\nproperty list uchar int vertex_indices\n";
    let whole = |body: &str| format!("ply\nformat ascii 1.0\n{vertices}{faces}end_header\n{body}");
    let cases = [
        (whole("0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n"), "line 13", "vertex 3, but there are 3"),
        (whole("0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n"), "line 13", "vertex -1"),
        (whole("0 0 0\n1 0 0\n0 1 0\n3 0 1 0.5\n"), "line 13", "\"0.5\""),
        (whole("0 0 0\n1 zero 0\n0 1 0\n3 0 1 2\n"), "line 11", "property y is \"zero\""),
        (whole("0 0 0\n1 0 0\n0 1 0\n3 0 1"), "face 0", "ends before"),
        (whole("0 0 0\n1 0 0\n0 1 0\n-3 0 1 2"), "face 0", "-3 items"),
        (whole(""), "element vertex", "truncated"),
        (whole("0 0 0\n").replace("vertex 3", "vertex 9000000000000000000"), "element vertex", "truncated"),
        (whole("").replace("vertex 3", "vertex -3"), "line 3", "\"-3\""),
        (whole("").replace("float y", "floaty y"), "line 5", "unknown property type \"floaty\""),
        (whole("").replace("list uchar", "list float"), "line 8", "not an integer type"),
        (whole("").replace("ascii", "latin"), "line 2", "unknown format"),
        (whole("0 0 0 0 0 0 0").replace("property float z\n", ""), "element vertex", "no property z"),
        (whole("0 0 0 0 0 0 0 0 0 1").replace("list uchar int", "int"), "element face", "not a list"),
        ("ply\nformat ascii 1.0\nproperty float x\nend_header\n".to_owned(), "line 3", "before any element"),
        ("ply\nformat ascii 1.0\nelement vertex 1\n".to_owned(), "line 4", "no end_header"),
        ("ply\nend_header\n".to_owned(), "mesh.ply", "no format"),
        ("hello\n".to_owned(), "line 1", "not \"ply\""),
        (String::new(), "line 1", "no end_header"),
    ];
    for (content, place, fault) in cases {
        let found = complaint(&file(&dir, "mesh.ply", &content));
        assert!(found.contains(place) && found.contains(fault), "{found:?} lacks {place:?} or {fault:?}\n{content}");
    }
    assert!(complaint(&dir.path().join("none.ply")).contains("no such file"));
}

/// A list that claims two billion items, in a file of a hundred bytes.
#[test]
fn declared_sizes_do_not_claim_memory() {
    let dir = folder();
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nproperty float y\n\
        property float z\nelement face 1\nproperty list uint int vertex_indices\nend_header\n";
    let mut bytes = header.as_bytes().to_vec();
    bytes.extend(u32::MAX.to_le_bytes());
    assert!(complaint(&file(&dir, "mesh.ply", &bytes)).contains("ends before"));
    let nothing = "ply\nformat ascii 1.0\nelement nothing 18446744073709551615\nend_header\n";
    assert!(complaint(&file(&dir, "mesh.ply", nothing)).contains("truncated"));
}

#[test]
fn vertices_that_are_no_numbers_are_dropped_and_counted_or_refused() {
    let dir = folder();
    let text = |vertices: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
             element face 3\nproperty list uchar int vertex_indices\nend_header\n{vertices}3 1 2 3\n3 0 1 2\n2 1 2\n"
        )
    };
    let path = file(&dir, "some.ply", text("nan 0 0\n0 0 0\n1 0 0\n0 1 0\n"));
    let (mesh, dropped) = read_mesh_lenient(&path).unwrap();
    assert_eq!((dropped.vertices, dropped.triangles, dropped.faces), (1, 1, 1));
    assert_eq!(mesh.triangles, [[0, 1, 2]]);
    assert_eq!(mesh.vertices[2], Point3::new(0.0, 1.0, 0.0));
    let strict = read_mesh(&path).unwrap_err().to_string();
    assert!(strict.contains("1 vertex that is not finite, 1 triangle at such a vertex, 1 face with fewer"), "{strict}");
    let path = file(&dir, "all.ply", text("nan 0 0\n0 inf 0\n1 0 -inf\n0 nan 0\n"));
    assert!(complaint(&path).contains("no vertex has finite coordinates"));
}

#[test]
fn obj_files_of_others_are_understood() {
    let dir = folder();
    file(&dir, "colors.mtl", "newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n");
    let text = "# comment\nmtllib colors.mtl\nv 0 0 0\nv 1 0 0 # right\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n\
        o first thing\nusemtl red\nf 1/1/1 2//1 3/1 \\\n 4\no second\nusemtl blue\nf -4 -3 -2\nl 1 2\n";
    let mesh = read_mesh(file(&dir, "mesh.obj", text)).unwrap();
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
    assert_eq!(mesh.triangle_parts, Some(vec![0, 0, 1]));
    assert_eq!(mesh.triangle_colors, Some(vec![[255, 0, 0], [255, 0, 0], [0, 0, 255]]));
    for (text, place) in [
        ("v 0 0\n", "line 1"),
        ("v 0 0 0\nf 1 2 x\n", "line 2"),
        ("v 0 0 0\n\nf 1 1 2\n", "line 3"),
        ("f 0 0 0\n", "line 1"),
    ] {
        let found = complaint(&file(&dir, "bad.obj", text));
        assert!(found.contains(place), "{found}");
    }
}

#[test]
fn text_stl_is_understood_and_broken_stl_told() {
    let dir = folder();
    let facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1e0 0\nendloop\nendfacet\n";
    let mesh =
        read_mesh(file(&dir, "mesh.stl", format!("solid a\n{facet}{facet}endsolid a\nsolid b\n{facet}endsolid b\n")))
            .unwrap();
    assert_eq!(mesh.vertices.len(), 3);
    assert_eq!(mesh.triangle_parts, Some(vec![0, 0, 1]));
    assert!(complaint(&file(&dir, "cut.stl", format!("solid a\n{facet}"))).contains("truncated"));
    assert!(complaint(&file(&dir, "bad.stl", "solid a\nvertex 1 2\nendsolid\n")).contains("line 2"));
    let mut binary = vec![0; 84];
    binary[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(complaint(&file(&dir, "binary.stl", &binary)).contains("4294967295 triangles"));
    assert!(complaint(&file(&dir, "short.stl", b"abc")).contains("too short"));
}

#[test]
fn a_file_of_another_kind_is_refused() {
    let dir = folder();
    assert!(complaint(&file(&dir, "mesh.fbx", "Kaydara")).contains("PLY, OBJ, STL or GLB"));
    assert!(write_mesh(dir.path().join("mesh.abc"), &sample()).unwrap_err().to_string().contains("abc"));
    // Known by its content, whatever it is called.
    let dir = folder();
    let path = dir.path().join("mesh.ply");
    write_mesh(&path, &sample()).unwrap();
    let renamed = dir.path().join("mesh.dat");
    std::fs::rename(&path, &renamed).unwrap();
    assert_eq!(read_mesh(&renamed).unwrap(), sample());
}

/// Open3D writes the buffer into the JSON chunk.
#[test]
fn a_glb_file_may_carry_its_buffer_as_text() {
    use base64::prelude::*;
    let dir = folder();
    let positions: Vec<u8> = [[0.0f32, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.5, 0.0]]
        .as_flattened()
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let glb = |uri: &str| {
        let mut json = format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}}],
            "bufferViews":[{{"buffer":0,"byteLength":36}}],"buffers":[{{"byteLength":36,"uri":"{uri}"}}]}}"#
        );
        json.extend(std::iter::repeat_n(' ', json.len().next_multiple_of(4) - json.len()));
        let mut out = b"glTF\x02\0\0\0".to_vec();
        out.extend((20 + json.len() as u32).to_le_bytes());
        out.extend((json.len() as u32).to_le_bytes());
        out.extend(*b"JSON");
        out.extend(json.bytes());
        out
    };
    let text = BASE64_STANDARD.encode(positions);
    let mesh = read_mesh(file(&dir, "text.glb", glb(&format!("data:application/octet-stream;base64,{text}")))).unwrap();
    assert_eq!(mesh.triangle(0), [[0., 0., 0.], [2., 0., 0.], [0., 0.5, 0.]].map(Point3::from));
    let damaged = glb(&format!("data:application/octet-stream;base64,{}*", &text[1..]));
    assert!(complaint(&file(&dir, "damaged.glb", damaged)).contains("damaged"));
    assert!(complaint(&file(&dir, "elsewhere.glb", glb("mesh.bin"))).contains("outside the file"));
}

#[test]
fn glb_nodes_place_their_meshes() {
    let dir = folder();
    let path = dir.path().join("mesh.glb");
    write_mesh(&path, &sample()).unwrap();
    // Move the second node by patching the JSON chunk at its own length.
    let bytes = std::fs::read(&path).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let json = String::from_utf8(bytes[20..20 + length].to_vec()).unwrap();
    let moved = json.replace(r#""name":"part_1","#, r#""name":"part_1","translation":[0,0,5],"rotation":[0,0,1,0],"#);
    let rebuild = |json: String| {
        let mut json = json.into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        let bin = &bytes[20 + length..];
        let mut out = bytes[..8].to_vec();
        out.extend(((20 + json.len() + bin.len()) as u32).to_le_bytes());
        out.extend((json.len() as u32).to_le_bytes());
        out.extend(*b"JSON");
        out.extend(json);
        out.extend(bin);
        out
    };
    let mesh = read_mesh(file(&dir, "moved.glb", rebuild(moved))).unwrap();
    let second = mesh.triangle(1);
    // Half a turn about z, then 5 along z.
    assert_eq!(second[1], Point3::new(0.0, -0.25, 5.0));
    let cycle = json.replace(r#""name":"part_1","#, r#""name":"part_1","children":[0,1],"#);
    assert!(complaint(&file(&dir, "cycle.glb", rebuild(cycle))).contains("two parents"));
    let outside = json.replace(r#""count":3"#, r#""count":4000000000"#);
    assert!(complaint(&file(&dir, "outside.glb", rebuild(outside))).contains("past the end"));
    assert!(complaint(&file(&dir, "cut.glb", &bytes[..bytes.len() - 8])).contains("truncated"));
}

proptest! {
    /// No bytes make a reader panic or ask for more memory than the file justifies.
    #[test]
    fn damaged_files_never_panic(kind in 0usize..4, at in 0.0..1.0f64, noise in prop::collection::vec(any::<u8>(), 1..9), cut in any::<bool>()) {
        let dir = folder();
        let name = ["mesh.ply", "mesh.obj", "mesh.stl", "mesh.glb"][kind];
        let path = dir.path().join(name);
        write_mesh(&path, &sample()).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        let at = (at * bytes.len() as f64) as usize;
        if cut {
            bytes.truncate(at);
        } else {
            for (byte, noise) in bytes[at..].iter_mut().zip(noise) {
                *byte = noise;
            }
        }
        std::fs::write(&path, bytes).unwrap();
        let _ = read_mesh_lenient(&path);
    }
}
