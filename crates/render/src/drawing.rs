//! Pictures as in building instructions: even shading, dark edges, no shadows.
//!
//! A [`Drawing`] keeps, at several samples a pixel, what is nearest to the viewer: depth, colour, part and sharp edge.
//! Parts are added as they are built, and each costs what it covers, however much is there already. Each sample takes
//! its triangle's colour under a fixed light that stands above the viewer's left shoulder, whatever the view. A picture
//! is composed from the samples: over the colours come sharp edges, outlines where one part ends before another or
//! before itself (found in the samples, so that round surfaces have outlines too), and a coloured band around the parts
//! that are highlighted. The mean of a pixel's samples is its colour and opacity. The picture is made of tiles, and only
//! those in which something changed are composed again.

use mb_geometry::ImageSize;
use mb_image::Image;
use mb_mesh::TriangleMesh;
use nalgebra::{Point2, Point3, Vector3};
use rayon::prelude::*;

use crate::compose::{self, Brushes};
use crate::view::Window;
use crate::{NO_TRIANGLE, Raster, RgbaImage, Scene, View};

/// A line on the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SharpEdge {
    /// Ends, in the mesh's frame.
    pub ends: [Point3<f64>; 2],
    /// The part it belongs to: a value of the mesh's `triangle_parts`.
    pub part: u32,
}

/// How a part is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Look {
    /// 8-bit sRGB of its edges and outlines.
    pub line: [u8; 3],
    /// From 0 (its own colours) to 1 (white).
    pub fade: f32,
    /// Whether a coloured band runs around it.
    pub highlighted: bool,
}

/// What to add to a drawing.
#[derive(Debug, Clone, Copy)]
pub struct LineArt<'a> {
    /// The surface, with `triangle_colors` and `triangle_parts`.
    pub mesh: &'a TriangleMesh,
    /// `[T]` unit normals at the three corners of each triangle, for surfaces that should look round.
    pub corner_normals: &'a [[Vector3<f32>; 3]],
    /// `[T]` opacity of each triangle; below 255, what is behind shines through.
    pub opacity: &'a [u8],
    /// Sharp edges.
    pub edges: &'a [SharpEdge],
    /// How the parts look, by the values of `triangle_parts`.
    pub looks: &'a [Look],
}

/// How lines are drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrawingOptions {
    /// Samples along each side of a pixel, at least 1.
    pub samples: usize,
    /// Width of edges and outlines, pixels.
    pub line_px: f64,
    /// Width of the band around highlighted parts, pixels.
    pub highlight_px: f64,
    /// 8-bit sRGB of that band.
    pub highlight: [u8; 3],
    /// A jump of depth within one part that shows as an outline, in the mesh's unit.
    pub jump: f64,
}

/// Pixels along a tile's side.
const TILE: usize = 64;

/// A picture to which parts are added.
pub struct Drawing<F> {
    /// The view at full sampling.
    fine: View<F>,
    samples: usize,
    brushes: Brushes,
    /// What is opaque.
    solid: Layer,
    /// What is clear; hidden where it lies behind what is opaque.
    clear: Layer,
    looks: Vec<Look>,
    /// The samples that each part covers.
    windows: Vec<Option<Window>>,
    picture: RgbaImage,
    /// Row-major; tiles to be composed again.
    is_stale: Vec<bool>,
}

/// What is nearest of one kind at each sample. Memory that stays 0 costs nothing.
pub(crate) struct Layer {
    /// Depth along z; 0 where there is nothing.
    pub depth: Vec<f32>,
    /// Colour under the light, and opacity.
    pub color: Vec<[u8; 4]>,
    /// Number of the part; of meaning where there is something.
    pub part: Vec<u32>,
    /// Depth of the nearest sharp edge that goes through the sample; 0 where none does.
    pub edge_depth: Vec<f32>,
    /// Number of the part whose edge it is.
    pub edge_part: Vec<u32>,
    /// Whether anything was drawn.
    pub is_used: bool,
}

impl Layer {
    fn new(samples: usize) -> Self {
        Self {
            depth: vec![0.0; samples],
            color: vec![[0; 4]; samples],
            part: vec![0; samples],
            edge_depth: vec![0.0; samples],
            edge_part: vec![0; samples],
            is_used: false,
        }
    }
}

impl<F: Sync> Drawing<F> {
    /// An empty drawing.
    pub fn new(view: &View<F>, options: &DrawingOptions) -> Self {
        let samples = options.samples.max(1);
        let size = ImageSize::new(view.size.width * samples, view.size.height * samples);
        let intrinsics = view.intrinsics.resized(view.size, size);
        let tiles = view.size.width.div_ceil(TILE) * view.size.height.div_ceil(TILE);
        Self {
            fine: View { intrinsics, size, cam_from_frame: view.cam_from_frame },
            samples,
            brushes: Brushes::of(options, samples),
            solid: Layer::new(size.pixels()),
            clear: Layer::new(size.pixels()),
            looks: vec![],
            windows: vec![],
            picture: Image::filled(view.size, [0; 4]),
            is_stale: vec![false; tiles],
        }
    }

    /// Adds parts; returns the number of the first, the others follow it.
    ///
    /// # Panics
    /// Where the mesh lacks colours or parts, or arrays have another length than the mesh says.
    pub fn add(&mut self, art: &LineArt) -> u32 {
        let first = self.looks.len() as u32;
        let mesh = art.mesh;
        let (Some(colors), Some(parts)) = (&mesh.triangle_colors, &mesh.triangle_parts) else {
            panic!("a drawing needs the colour and the part of each triangle")
        };
        assert!(
            [colors.len(), parts.len(), art.corner_normals.len(), art.opacity.len()]
                .iter()
                .all(|&n| n == mesh.triangles.len()),
            "one colour, part, opacity and three normals a triangle"
        );
        self.looks.extend(art.looks);
        self.windows.extend(windows(art, parts, &self.fine));
        for part in first as usize..self.looks.len() {
            self.spoil(part);
        }
        for is_clear in [false, true] {
            let chosen: Vec<u32> =
                (0..mesh.triangles.len() as u32).filter(|&t| (art.opacity[t as usize] < 255) == is_clear).collect();
            if chosen.is_empty() {
                continue;
            }
            let mut in_layer = vec![false; art.looks.len()];
            chosen.iter().for_each(|&t| in_layer[parts[t as usize] as usize] = true);
            let fine = &self.fine;
            let triangles = chosen.iter().map(|&t| mesh.triangles[t as usize]).collect();
            let scene = Scene::new(&TriangleMesh::new(mesh.vertices.clone(), triangles));
            if let Some((window, raster)) = scene.render_where_seen(fine) {
                let layer = if is_clear { &mut self.clear } else { &mut self.solid };
                layer.is_used = true;
                merge(layer, fine, art, (colors, parts), &chosen, (window, &raster), first);
            }
            self.add_edges(art, &in_layer, is_clear, first);
        }
        first
    }

    /// Changes how a part looks; says whether it looked otherwise.
    pub fn set_look(&mut self, part: u32, look: Look) -> bool {
        let changes = self.looks[part as usize] != look;
        if changes {
            self.looks[part as usize] = look;
            self.spoil(part as usize);
        }
        changes
    }

    /// The picture, transparent where there is nothing.
    pub fn picture(&mut self) -> &RgbaImage {
        let columns = self.picture.width().div_ceil(TILE);
        let stale: Vec<usize> = (0..self.is_stale.len()).filter(|&tile| self.is_stale[tile]).collect();
        let size = self.picture.size();
        let window_of = |tile: usize| {
            let (x, y) = (tile % columns * TILE, tile / columns * TILE);
            Window { x, y, size: ImageSize::new(TILE.min(size.width - x), TILE.min(size.height - y)) }
        };
        // A few at a time: what waits to be copied stays small.
        for some in stale.chunks(256) {
            let composed: Vec<Vec<[u8; 4]>> =
                some.par_iter().map(|&tile| compose::tile(self, &window_of(tile))).collect();
            for (&tile, pixels) in some.iter().zip(composed) {
                let Window { x, y, size: tile_size } = window_of(tile);
                for (row, pixels) in pixels.chunks(tile_size.width).enumerate() {
                    let start = (y + row) * size.width + x;
                    self.picture.data_mut()[start..start + tile_size.width].copy_from_slice(pixels);
                }
                self.is_stale[tile] = false;
            }
        }
        &self.picture
    }

    /// The picture, without a copy.
    pub fn into_picture(mut self) -> RgbaImage {
        self.picture();
        self.picture
    }

    /// Marks the tiles that a part's samples, lines and band may reach.
    fn spoil(&mut self, part: usize) {
        let Some(window) = self.windows[part] else { return };
        let columns = self.picture.width().div_ceil(TILE);
        let reach = self.brushes.reach();
        let tiles = |first: usize, count: usize, limit: usize| {
            let last = (first + count + reach).min(limit * self.samples) - 1;
            first.saturating_sub(reach) / (TILE * self.samples)..=last / (TILE * self.samples)
        };
        let x = tiles(window.x, window.size.width, self.picture.width());
        for y in tiles(window.y, window.size.height, self.picture.height()) {
            x.clone().for_each(|x| self.is_stale[y * columns + x] = true);
        }
    }

    /// Notes the sharp edges that are not hidden. What is hidden now stays hidden, whatever is added.
    fn add_edges(&mut self, art: &LineArt, in_layer: &[bool], is_clear: bool, first: u32) {
        let fine = &self.fine;
        let (width, height) = (fine.size.width, fine.size.height);
        let (solid, clear) = (&self.solid, &self.clear);
        let visible: Vec<Vec<(usize, f32)>> = art
            .edges
            .par_iter()
            .with_min_len(64)
            .map(|edge| {
                let mut samples = vec![];
                if !in_layer[edge.part as usize] {
                    return samples;
                }
                let ends = edge.ends.map(|p| fine.cam_from_frame * p);
                let [Some(start), Some(end)] = ends.map(|p| fine.intrinsics.img_from_cam(&p)) else {
                    return samples;
                };
                let steps = (end - start).amax().ceil().clamp(1.0, 1e5) as usize;
                let mut last = usize::MAX;
                for step in 0..=steps {
                    let t = step as f64 / steps as f64;
                    let p: Point2<f64> = start + (end - start) * t;
                    let (x, y) = (p.x.round(), p.y.round());
                    if x < 1.0 || y < 1.0 || x + 1.0 >= width as f64 || y + 1.0 >= height as f64 {
                        continue;
                    }
                    let i = y as usize * width + x as usize;
                    let z = (ends[0].z + (ends[1].z - ends[0].z) * t) as f32;
                    let behind = compose::behind(i, width, |j| match is_clear {
                        true => compose::nearer(solid.depth[j], clear.depth[j]),
                        false => solid.depth[j],
                    });
                    if i != last && compose::shows(z, behind, fine) {
                        samples.push((i, z));
                        last = i;
                    }
                }
                samples
            })
            .collect();
        let layer = if is_clear { &mut self.clear } else { &mut self.solid };
        for (edge, samples) in art.edges.iter().zip(visible) {
            for (i, z) in samples {
                if layer.edge_depth[i] == 0.0 || z < layer.edge_depth[i] {
                    (layer.edge_depth[i], layer.edge_part[i]) = (z, first + edge.part);
                }
            }
        }
    }

    pub(crate) fn fine(&self) -> &View<F> {
        &self.fine
    }

    pub(crate) fn samples(&self) -> usize {
        self.samples
    }

    pub(crate) fn brushes(&self) -> &Brushes {
        &self.brushes
    }

    pub(crate) fn layers(&self) -> [&Layer; 2] {
        [&self.solid, &self.clear]
    }

    pub(crate) fn look(&self, part: u32) -> &Look {
        &self.looks[part as usize]
    }
}

/// The samples that each part may cover; `None` where none.
fn windows<F>(art: &LineArt, parts: &[u32], fine: &View<F>) -> Vec<Option<Window>> {
    let mut corners: Vec<Vec<[f64; 2]>> = vec![vec![]; art.looks.len()];
    let seen = |p: &Point3<f64>| fine.intrinsics.img_from_cam(&(fine.cam_from_frame * *p)).map(|p| [p.x, p.y]);
    let at: Vec<Option<[f64; 2]>> = art.mesh.vertices.iter().map(seen).collect();
    for (triangle, &part) in art.mesh.triangles.iter().zip(parts) {
        corners[part as usize].extend(triangle.iter().filter_map(|&v| at[v as usize]));
    }
    for edge in art.edges {
        corners[edge.part as usize].extend(edge.ends.iter().filter_map(seen));
    }
    corners.into_iter().map(|corners| Window::around(corners, fine.size)).collect()
}

/// Takes a raster of new triangles into a layer where they are nearer.
fn merge<F: Sync>(
    layer: &mut Layer,
    fine: &View<F>,
    art: &LineArt,
    (colors, parts): (&[[u8; 3]], &[u32]),
    chosen: &[u32],
    (window, raster): (Window, &Raster),
    first: u32,
) {
    let flat: Vec<Option<[u8; 3]>> = chosen
        .par_iter()
        .with_min_len(1024)
        .map(|&t| {
            let [a, b, c] = art.corner_normals[t as usize];
            let round = a.dot(&b) < 0.9998 || a.dot(&c) < 0.9998;
            (!round).then(|| lit(colors[t as usize], facing(&a.cast(), fine)))
        })
        .collect();
    let frame_from_cam = fine.cam_from_frame.inverse();
    let width = fine.size.width;
    let rows = window.y * width..(window.y + window.size.height) * width;
    let depths = layer.depth[rows.clone()].par_chunks_mut(width);
    let kinds = layer.color[rows.clone()].par_chunks_mut(width).zip(layer.part[rows].par_chunks_mut(width));
    depths.zip(kinds).enumerate().with_min_len(8).for_each(|(row, (depth, (color, part)))| {
        let new = row * window.size.width..(row + 1) * window.size.width;
        let new = raster.depth.data()[new.clone()].iter().zip(&raster.triangle.data()[new]);
        for (x, (&z, &index)) in (window.x..).zip(new) {
            if index == NO_TRIANGLE || (depth[x] != 0.0 && z > depth[x]) {
                continue;
            }
            let triangle = chosen[index as usize] as usize;
            let [r, g, b] = flat[index as usize].unwrap_or_else(|| {
                let at = Point2::new(x as f64, (window.y + row) as f64);
                let p = fine.intrinsics.ray(&at, &frame_from_cam).at(f64::from(z));
                lit(colors[triangle], facing(&round_normal(art, triangle, &p), fine))
            });
            depth[x] = z;
            color[x] = [r, g, b, art.opacity[triangle]];
            part[x] = first + parts[triangle];
        }
    });
}

/// A normal in camera axes, turned towards the viewer.
fn facing<F>(normal: &Vector3<f64>, view: &View<F>) -> Vector3<f64> {
    let n = view.cam_from_frame.rotate(normal);
    if n.z > 0.0 { -n } else { n }
}

/// The colour of a surface whose normal is given in camera axes.
fn lit(rgb: [u8; 3], normal: Vector3<f64>) -> [u8; 3] {
    // Tops are lightest, left sides in the middle, right sides darkest.
    let light = Vector3::new(-0.42, -0.77, -0.48);
    let shade = 0.60 + 0.42 * normal.dot(&light).max(0.0) + 0.06 * normal.dot(&Vector3::new(0.8, 0.1, -0.59)).max(0.0);
    let shade = shade as f32;
    rgb.map(|v| (f32::from(v) * shade + 14.0 * (1.0 - shade)).round().min(255.0) as u8)
}

/// The corner normals of a triangle, blended at a point on it.
fn round_normal(art: &LineArt, triangle: usize, p: &Point3<f64>) -> Vector3<f64> {
    let [a, b, c] = art.mesh.triangle(triangle);
    let scaled = (b - a).cross(&(c - a));
    let area_sq = scaled.norm_squared();
    let corners = art.corner_normals[triangle];
    if area_sq <= 0.0 {
        return corners[0].cast();
    }
    let weight =
        |from: &Point3<f64>, to: &Point3<f64>| ((from - p).cross(&(to - p)).dot(&scaled) / area_sq).clamp(0.0, 1.0);
    let blended = corners[0].cast::<f64>() * weight(&b, &c)
        + corners[1].cast::<f64>() * weight(&c, &a)
        + corners[2].cast::<f64>() * weight(&a, &b);
    blended.try_normalize(0.0).unwrap_or_else(|| corners[0].cast())
}
