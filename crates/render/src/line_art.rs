//! Pictures as in building instructions: even shading, dark edges, no shadows.
//!
//! The mesh is rasterised at several samples a pixel. Each sample takes its triangle's colour under a fixed light that
//! stands above the viewer's left shoulder, whatever the view. Over it come three kinds of lines, each tested against
//! the depth of the samples: the sharp edges that the caller gives, outlines where one part ends before another or
//! before itself (found in the samples, so that round surfaces have outlines too), and a coloured band around the parts
//! that are highlighted. The mean of a pixel's samples is its colour and opacity.

use mb_geometry::ImageSize;
use mb_image::Image;
use mb_mesh::TriangleMesh;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

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

/// What to draw.
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
pub struct LineArtOptions {
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

/// Draws the picture, transparent where there is nothing.
///
/// # Panics
/// Where the mesh lacks colours or parts, or arrays have another length than the mesh says.
pub fn line_art<F: Sync>(art: &LineArt, view: &View<F>, options: &LineArtOptions) -> RgbaImage {
    let samples = options.samples.max(1);
    let fine_size = ImageSize::new(view.size.width * samples, view.size.height * samples);
    let fine = View::<F> {
        intrinsics: view.intrinsics.resized(view.size, fine_size),
        size: fine_size,
        cam_from_frame: view.cam_from_frame,
    };
    let mut canvas = Canvas::new(art, &fine);
    canvas.layer(|opacity| opacity == 255, samples, options);
    if art.opacity.iter().any(|&o| o < 255) {
        canvas.layer(|opacity| opacity < 255, samples, options);
    }
    canvas.highlight(options.highlight_px * samples as f64, options.highlight);
    canvas.reduced(view.size, samples)
}

/// The picture at full sampling.
struct Canvas<'a, F> {
    art: &'a LineArt<'a>,
    colors: &'a [[u8; 3]],
    parts: &'a [u32],
    view: &'a View<F>,
    /// Colour of each sample and its opacity, 0 or 255.
    pixels: Vec<[u8; 4]>,
    /// Depth of the nearest layer so far; infinite where there is nothing.
    depth: Vec<f32>,
    /// Whether the nearest surface belongs to a highlighted part.
    highlighted: Vec<bool>,
}

impl<'a, F: Sync> Canvas<'a, F> {
    fn new(art: &'a LineArt<'a>, view: &'a View<F>) -> Self {
        let mesh = art.mesh;
        let (Some(colors), Some(parts)) = (&mesh.triangle_colors, &mesh.triangle_parts) else {
            panic!("line art needs the colour and the part of each triangle")
        };
        let triangles = mesh.triangles.len();
        assert!(
            [colors.len(), parts.len(), art.corner_normals.len(), art.opacity.len()].iter().all(|&n| n == triangles),
            "one colour, part, opacity and three normals a triangle"
        );
        let samples = view.size.pixels();
        Self {
            art,
            colors,
            parts,
            view,
            pixels: vec![[0; 4]; samples],
            depth: vec![f32::INFINITY; samples],
            highlighted: vec![false; samples],
        }
    }

    /// Draws the triangles whose opacity is wanted, with their lines, over what is there.
    fn layer(&mut self, wanted: impl Fn(u8) -> bool, samples: usize, options: &LineArtOptions) {
        let mesh = self.art.mesh;
        let chosen: Vec<u32> =
            (0..mesh.triangles.len() as u32).filter(|&t| wanted(self.art.opacity[t as usize])).collect();
        let triangles = chosen.iter().map(|&t| mesh.triangles[t as usize]).collect();
        let scene = Scene::new(&TriangleMesh::new(mesh.vertices.clone(), triangles));
        let Raster { depth, triangle } = scene.render(self.view);
        let triangle = triangle.map(|&t| if t == NO_TRIANGLE { t } else { chosen[t as usize] });
        let width = self.view.size.width;
        let flat: Vec<Option<[u8; 3]>> = (0..mesh.triangles.len()).into_par_iter().map(|t| self.flat(t)).collect();

        let (art, view) = (self.art, self.view);
        let (parts, colors) = (self.parts, self.colors);
        let frame_from_cam = view.cam_from_frame.inverse();
        // Where the surface of the layer is the nearest so far.
        let seen: Vec<u32> = triangle
            .data()
            .par_iter()
            .zip(depth.data())
            .zip(&self.depth)
            .map(|((&t, &z), &before)| if t != NO_TRIANGLE && z <= before { t } else { NO_TRIANGLE })
            .collect();
        self.pixels.par_iter_mut().zip(&seen).enumerate().for_each(|(i, (pixel, &t))| {
            if t == NO_TRIANGLE {
                return;
            }
            let triangle = t as usize;
            let color = flat[triangle].unwrap_or_else(|| {
                let ray = view.intrinsics.ray(&[(i % width) as f64, (i / width) as f64].into(), &frame_from_cam);
                let p = ray.at(f64::from(depth.data()[i]));
                lit(
                    colors[triangle],
                    facing(&round_normal(art, triangle, &p), view),
                    art.looks[parts[triangle] as usize].fade,
                )
            });
            *pixel = over(color, art.opacity[triangle], *pixel);
        });
        for ((before, &z), &t) in self.depth.iter_mut().zip(depth.data()).zip(&seen) {
            if t != NO_TRIANGLE {
                *before = z;
            }
        }
        for (mark, &t) in self.highlighted.iter_mut().zip(&seen) {
            if t != NO_TRIANGLE {
                *mark = art.looks[parts[t as usize] as usize].highlighted;
            }
        }
        self.outlines(&seen, 0.5 * options.line_px * samples as f64, options.jump as f32);
        self.edges(&wanted, 0.5 * options.line_px * samples as f64);
    }

    /// The colour of a flat triangle; `None` for one that should look round.
    fn flat(&self, triangle: usize) -> Option<[u8; 3]> {
        let [a, b, c] = self.art.corner_normals[triangle];
        let round = a.dot(&b) < 0.9998 || a.dot(&c) < 0.9998;
        let fade = self.art.looks[self.parts[triangle] as usize].fade;
        (!round).then(|| lit(self.colors[triangle], facing(&a.cast(), self.view), fade))
    }

    /// Lines where neighbouring samples see different parts, or the same part at very different depths.
    fn outlines(&mut self, seen: &[u32], radius: f64, jump: f32) {
        let (width, height) = (self.view.size.width, self.view.size.height);
        let depth = &self.depth;
        let part = |i: usize| if seen[i] == NO_TRIANGLE { None } else { Some(self.parts[seen[i] as usize]) };
        let found: Vec<(usize, u32)> = (0..height)
            .into_par_iter()
            .flat_map_iter(|y| {
                (0..width).flat_map(move |x| {
                    let i = y * width + x;
                    let right = (x + 1 < width).then_some(i + 1);
                    let below = (y + 1 < height).then_some(i + width);
                    [right, below].into_iter().flatten().filter_map(move |j| {
                        let (a, b) = (part(i), part(j));
                        if a == b && (a.is_none() || (depth[i] - depth[j]).abs() < jump) {
                            return None;
                        }
                        // The nearer surface owns the line.
                        let i_is_nearer = a.is_some() && (b.is_none() || depth[i] <= depth[j]);
                        if i_is_nearer { a.map(|part| (i, part)) } else { b.map(|part| (j, part)) }
                    })
                })
            })
            .collect();
        let brush = disc(radius);
        for (i, part) in found {
            let color = self.line_color(part);
            self.stamp(i, &brush, color, |_| true);
        }
    }

    /// The sharp edges that are not hidden.
    fn edges(&mut self, wanted: &impl Fn(u8) -> bool, radius: f64) {
        let (width, height) = (self.view.size.width as i64, self.view.size.height as i64);
        // Parts with nothing in this layer have no lines in it either.
        let mut in_layer = vec![false; self.art.looks.len()];
        for (triangle, &part) in self.parts.iter().enumerate() {
            in_layer[part as usize] |= wanted(self.art.opacity[triangle]);
        }
        let unit_px = 1.0 / self.view.intrinsics.fx;
        let visible: Vec<Vec<usize>> = self
            .art
            .edges
            .par_iter()
            .map(|edge| {
                let mut samples = vec![];
                if !in_layer[edge.part as usize] {
                    return samples;
                }
                let ends = edge.ends.map(|p| self.view.cam_from_frame * p);
                let [Some(start), Some(end)] = ends.map(|p| self.view.intrinsics.img_from_cam(&p)) else {
                    return samples;
                };
                let steps = (end - start).amax().ceil().clamp(1.0, 1e5) as usize;
                let mut last = usize::MAX;
                for step in 0..=steps {
                    let t = step as f64 / steps as f64;
                    let p = start + (end - start) * t;
                    let (x, y) = (p.x.round() as i64, p.y.round() as i64);
                    if x < 1 || y < 1 || x + 1 >= width || y + 1 >= height {
                        continue;
                    }
                    let i = (y * width + x) as usize;
                    let z = ends[0].z + (ends[1].z - ends[0].z) * t;
                    // The surface under a line is sampled up to a pixel beside it.
                    let reach = [0, 1, width, -1, -width].map(|d| self.depth[(i as i64 + d) as usize]);
                    let behind = reach.iter().fold(f32::MIN, |a, &b| a.max(b));
                    if i != last && z <= f64::from(behind) + 1.5 * z * unit_px {
                        samples.push(i);
                        last = i;
                    }
                }
                samples
            })
            .collect();
        let brush = disc(radius);
        for (edge, samples) in self.art.edges.iter().zip(visible) {
            let color = self.line_color(edge.part);
            for i in samples {
                self.stamp(i, &brush, color, |_| true);
            }
        }
    }

    fn line_color(&self, part: u32) -> [u8; 3] {
        let look = &self.art.looks[part as usize];
        faded(look.line, look.fade)
    }

    /// The band around highlighted parts, outside of them.
    fn highlight(&mut self, radius: f64, color: [u8; 3]) {
        let (width, height) = (self.view.size.width, self.view.size.height);
        let marks = &self.highlighted;
        let border: Vec<usize> = (0..width * height)
            .into_par_iter()
            .filter(|&i| {
                let (x, y) = (i % width, i / width);
                let other = |inside: bool, j: usize| inside && !marks[j];
                marks[i]
                    && (other(x > 0, i.wrapping_sub(1))
                        || other(x + 1 < width, i + 1)
                        || other(y > 0, i.wrapping_sub(width))
                        || other(y + 1 < height, i + width))
            })
            .collect();
        let brush = disc(radius);
        for i in border {
            self.stamp(i, &brush, color, |canvas_mark| !canvas_mark);
        }
    }

    /// Paints the samples around `i` whose highlight mark pleases.
    fn stamp(&mut self, i: usize, brush: &[(i64, i64)], color: [u8; 3], pleases: impl Fn(bool) -> bool) {
        let (width, height) = (self.view.size.width as i64, self.view.size.height as i64);
        let (x, y) = (i as i64 % width, i as i64 / width);
        for (dx, dy) in brush {
            let (x, y) = (x + dx, y + dy);
            if x >= 0 && y >= 0 && x < width && y < height {
                let j = (y * width + x) as usize;
                if pleases(self.highlighted[j]) {
                    self.pixels[j] = [color[0], color[1], color[2], 255];
                }
            }
        }
    }

    /// The mean of each pixel's samples.
    fn reduced(&self, size: ImageSize, samples: usize) -> RgbaImage {
        let width = self.view.size.width;
        let data = (0..size.pixels())
            .into_par_iter()
            .map(|i| {
                let (x, y) = (i % size.width * samples, i / size.width * samples);
                let mut sum = [0u32; 4];
                for sub in 0..samples * samples {
                    let [r, g, b, a] = self.pixels[(y + sub / samples) * width + x + sub % samples].map(u32::from);
                    sum = [sum[0] + r * a, sum[1] + g * a, sum[2] + b * a, sum[3] + a];
                }
                let [r, g, b, a] = sum;
                if a == 0 {
                    return [0; 4];
                }
                let mean = |v: u32| ((v + a / 2) / a) as u8;
                let count = (samples * samples) as u32;
                [mean(r), mean(g), mean(b), ((a + count / 2) / count) as u8]
            })
            .collect();
        Image::from_data(size, data).expect("one value a pixel")
    }
}

/// The samples within `radius` of a sample.
fn disc(radius: f64) -> Vec<(i64, i64)> {
    let reach = radius.ceil() as i64;
    let near = |&(x, y): &(i64, i64)| (x * x + y * y) as f64 <= radius * radius;
    (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| (x, y))).filter(near).collect()
}

/// A normal in camera axes, turned towards the viewer.
fn facing<F>(normal: &Vector3<f64>, view: &View<F>) -> Vector3<f64> {
    let n = view.cam_from_frame.rotate(normal);
    if n.z > 0.0 { -n } else { n }
}

/// The colour of a surface whose normal is given in camera axes.
fn lit(rgb: [u8; 3], normal: Vector3<f64>, fade: f32) -> [u8; 3] {
    // Tops are lightest, left sides in the middle, right sides darkest.
    let light = Vector3::new(-0.42, -0.77, -0.48);
    let shade = 0.60 + 0.42 * normal.dot(&light).max(0.0) + 0.06 * normal.dot(&Vector3::new(0.8, 0.1, -0.59)).max(0.0);
    let shade = shade as f32;
    faded(rgb.map(|v| (f32::from(v) * shade + 14.0 * (1.0 - shade)).round().min(255.0) as u8), fade)
}

fn faded(rgb: [u8; 3], fade: f32) -> [u8; 3] {
    rgb.map(|v| (f32::from(v) + (255.0 - f32::from(v)) * fade).round() as u8)
}

/// One colour over another; what was empty becomes opaque where the upper is.
fn over(color: [u8; 3], opacity: u8, below: [u8; 4]) -> [u8; 4] {
    let [r, g, b, a] = below;
    // Clear bricks on nothing are drawn on white: paper shines through them.
    let ground = if a == 0 { [255; 3] } else { [r, g, b] };
    let mix = |c: usize| {
        let (upper, lower) = (u32::from(color[c]), u32::from(ground[c]));
        ((upper * u32::from(opacity) + lower * (255 - u32::from(opacity)) + 127) / 255) as u8
    };
    [mix(0), mix(1), mix(2), 255]
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
