//! Drawings for building instructions: adding part after part gives the picture that all of them at once give, and each
//! look does what it says.

use mb_geometry::{Aabb, ImageSize, Object};
use mb_mesh::TriangleMesh;
use mb_render::{Drawing, DrawingOptions, LineArt, Look, RgbaImage, SharpEdge, View};
use nalgebra::{Point3, Vector3};

const OPTIONS: DrawingOptions =
    DrawingOptions { samples: 3, line_px: 1.3, highlight_px: 3.0, highlight: [255, 96, 0], jump: 0.002 };
const PLAIN: Look = Look { line: [20, 20, 20], fade: 0.0, highlighted: false };

/// A box of one colour with its edges, as one part.
struct Block {
    mesh: TriangleMesh,
    normals: Vec<[Vector3<f32>; 3]>,
    opacity: Vec<u8>,
    edges: Vec<SharpEdge>,
}

impl Block {
    fn new(min: [f64; 3], max: [f64; 3], rgb: [u8; 3], opacity: u8) -> Self {
        let corners = Aabb { min: min.into(), max: max.into() }.corners();
        let sides = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let triangles: Vec<[u32; 3]> = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        let mut mesh = TriangleMesh::new(corners.to_vec(), triangles);
        let normal = |t: usize| {
            let [a, b, c] = mesh.triangle(t);
            [(b - a).cross(&(c - a)).normalize().cast(); 3]
        };
        let normals = (0..12).map(normal).collect();
        mesh.triangle_colors = Some(vec![rgb; 12]);
        mesh.triangle_parts = Some(vec![0; 12]);
        let ends = (0..8).flat_map(|a| [1, 2, 4].map(move |bit| (a, a ^ bit))).filter(|(a, b)| a < b);
        let edges = ends.map(|(a, b)| SharpEdge { ends: [corners[a], corners[b]], part: 0 }).collect();
        Self { mesh, normals, opacity: vec![opacity; 12], edges }
    }

    fn add_to(&self, drawing: &mut Drawing<Object>, look: Look) -> u32 {
        drawing.add(&LineArt {
            mesh: &self.mesh,
            corner_normals: &self.normals,
            opacity: &self.opacity,
            edges: &self.edges,
            looks: &[look],
        })
    }
}

fn view() -> View<Object> {
    let (middle, forward) = (Point3::new(0.0, 0.05, 0.0), Vector3::new(0.5, -0.6, -0.7));
    View::from_afar(&middle, &forward, &Vector3::y(), ImageSize::new(300, 260), 0.001, 0.2)
}

/// A pile of blocks that hide each other, some of them clear.
fn blocks() -> Vec<Block> {
    let block =
        |x: f64, y: f64, z: f64, rgb, opacity| Block::new([x, y, z], [x + 0.083, y + 0.031, z + 0.047], rgb, opacity);
    vec![
        block(-0.1, 0.0, -0.06, [200, 30, 20], 255),
        block(0.001, 0.0, -0.05, [240, 240, 240], 255),
        block(-0.07, 0.0, 0.02, [30, 60, 180], 120),
        block(-0.05, 0.032, -0.03, [20, 120, 40], 255),
        block(0.021, 0.033, 0.011, [250, 200, 20], 120),
        block(-0.03, 0.065, -0.05, [90, 90, 90], 255),
    ]
}

fn drawn(blocks: &[Block], look: impl Fn(usize) -> Look) -> RgbaImage {
    let mut drawing = Drawing::new(&view(), &OPTIONS);
    for (index, block) in blocks.iter().enumerate() {
        block.add_to(&mut drawing, look(index));
    }
    drawing.into_picture()
}

fn pixel_at(picture: &RgbaImage, p: [f64; 3]) -> [u8; 4] {
    let view = view();
    let pixel = view.intrinsics.img_from_cam(&(view.cam_from_frame * Point3::from(p))).expect("in front");
    picture[(pixel.x.round() as usize, pixel.y.round() as usize)]
}

#[test]
fn step_after_step_gives_the_picture_that_all_at_once_gives() {
    let blocks = blocks();
    let faded = Look { fade: 0.5, ..PLAIN };
    let new = Look { highlighted: true, ..PLAIN };
    let mut growing = Drawing::new(&view(), &OPTIONS);
    for count in 1..=blocks.len() {
        // The last one is new, what was there before is faded: as the steps of a booklet are drawn.
        let part = blocks[count - 1].add_to(&mut growing, new);
        assert_eq!(part as usize, count - 1);
        if count > 1 {
            assert!(growing.set_look(part - 1, faded));
            assert!(!growing.set_look(part - 1, faded));
        }
        let fresh = drawn(&blocks[..count], |index| if index + 1 == count { new } else { faded });
        let differing = growing.picture().data().iter().zip(fresh.data()).filter(|(a, b)| a != b).count();
        assert_eq!(differing, 0, "after {count} blocks");
    }
    // The order of what is opaque and of what is clear does not show.
    let backwards: Vec<Block> = self::blocks().into_iter().rev().collect();
    let (there, back) = (drawn(&blocks, |_| PLAIN), drawn(&backwards, |_| PLAIN));
    let differing = there.data().iter().zip(back.data()).filter(|(a, b)| a != b).count();
    assert_eq!(differing, 0);
}

#[test]
fn each_look_does_what_it_says() {
    let red = Block::new([-0.05, 0.0, -0.05], [0.05, 0.06, 0.05], [200, 30, 20], 255);
    let top = [0.0, 0.06, 0.0];
    let plain = drawn(std::slice::from_ref(&red), |_| PLAIN);
    assert_eq!(plain[(0, 0)], [0; 4], "nothing is transparent");
    let [r, g, b, a] = pixel_at(&plain, top);
    assert!(a == 255 && r > 150 && g < 60 && b < 60, "{:?}", [r, g, b, a]);
    // Edges are dark, also the one between two sides of the same colour.
    let [edge_r, ..] = pixel_at(&plain, [-0.05, 0.06, 0.0]);
    assert!(edge_r < 110, "{edge_r}");
    let faded = drawn(std::slice::from_ref(&red), |_| Look { fade: 0.5, ..PLAIN });
    let [faded_r, faded_g, ..] = pixel_at(&faded, top);
    assert!(faded_g > 120 && faded_r > r, "{faded_r} {faded_g}");
    // The band is around the block and not on it.
    let marked = drawn(std::slice::from_ref(&red), |_| Look { highlighted: true, ..PLAIN });
    assert_eq!(pixel_at(&marked, top), pixel_at(&plain, top));
    let orange = |picture: &RgbaImage| picture.data().iter().filter(|p| **p == [255, 96, 0, 255]).count();
    assert_eq!(orange(&plain), 0);
    assert!(orange(&marked) > 300, "{}", orange(&marked));
}

#[test]
fn what_is_hidden_is_not_drawn_and_what_is_behind_glass_shines_through() {
    let wall = |opacity| Block::new([-0.08, 0.0, 0.02], [0.08, 0.16, 0.04], [255, 255, 255], opacity);
    let behind = Block::new([0.0, 0.02, -0.06], [0.05, 0.05, -0.03], [0, 0, 255], 255);
    // The place on the wall's front before the block's middle.
    let forward = Vector3::new(0.5, -0.6, -0.7);
    let middle = Vector3::new(0.025, 0.035, -0.03);
    let on_wall: [f64; 3] = (middle - forward * ((middle.z - 0.04) / forward.z)).into();
    let alone = drawn(&[wall(255)], |_| PLAIN);
    let hidden = drawn(&[behind, wall(255)], |_| PLAIN);
    assert!(hidden == alone);
    let behind = Block::new([0.0, 0.02, -0.06], [0.05, 0.05, -0.03], [0, 0, 255], 255);
    let [r, _, b, _] = pixel_at(&drawn(&[behind, wall(100)], |_| PLAIN), on_wall);
    assert!(b > r + 40, "{r} {b}");
}
