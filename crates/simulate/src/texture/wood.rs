//! Wood: strips of bamboo glued to a board, and planks of oak.

use glam::Vec3;

use super::{Finish, kept, mix, smoothstep};
use crate::random::{fractal, hash, noise, unit};

/// Wood in strips along x: each strip has its tone, is pieced together from lengths, and carries fibres, pores, stains and
/// (bamboo) nodes.
struct Wood {
    strip_m: f32,
    length_m: f32,
    light: Vec3,
    dark: Vec3,
    /// How much strips differ in tone, 0 to 1 from light to dark.
    tones: f32,
    /// Strength of fibres and pores.
    grain: f32,
    /// Distance of fibres.
    fibre_m: f32,
    nodes: bool,
}

impl Wood {
    /// Albedo, and the slope across the fibres.
    fn at(&self, x: f32, y: f32, pixel_m: f32, salt: u32) -> (Vec3, f32) {
        let strip = (y / self.strip_m).floor();
        let shift = unit(hash(strip as i32, 11, salt)) * self.length_m;
        let piece = ((x + shift) / self.length_m).floor();
        let own = hash(strip as i32, piece as i32, salt ^ 0x77);
        // Fibres of a piece run at a small angle to it, and wander.
        let lean = 0.05 * (unit(own ^ 0x1F) - 0.5);
        let wander = 0.0012 * noise(x * 12.0, y * 20.0, own ^ 0x2E);
        let across = y + lean * x + wander;
        let mut shade = self.tones * (unit(own ^ 0x33) - 0.5);
        let mut slope = 0.0;
        // Fibres at three widths.
        let mut strength = 0.34;
        for (octave, scale) in [(1u32, 4.0f32), (2, 1.6), (3, 0.7)] {
            let lattice_m = self.fibre_m * scale;
            let seen = kept(lattice_m, pixel_m);
            if seen > 0.0 {
                let v = noise(x * (0.028 / lattice_m), across / lattice_m, own ^ octave) - 0.5;
                shade += self.grain * seen * strength * v;
                slope += 0.10 * self.grain * seen * v;
            }
            strength *= 1.15;
        }
        // Pores: dark strokes, some deep.
        let pore_m = 0.8 * self.fibre_m;
        let seen = kept(pore_m, pixel_m);
        if seen > 0.0 {
            let stroke = noise(x * 120.0, across / pore_m, own ^ 5) * (0.6 + 0.4 * noise(x * 30.0, y * 60.0, own ^ 6));
            shade += self.grain * seen * 0.9 * smoothstep(0.52, 0.75, stroke);
        }
        // The figure of the wood, and what has been spilt on it.
        let figure = fractal(x * 6.0 + 2.0 * noise(x * 4.0, y * 40.0, own), across * 110.0, 3, 0.6, own ^ 2);
        shade += 0.35 * (figure - 0.5) + 0.30 * (noise(x * 70.0, across * 420.0, own ^ 12) - 0.5);
        let stain = fractal(x * 9.0 + 0.7 * y, y * 30.0, 4, 0.55, salt ^ 3);
        shade += 0.34 * smoothstep(0.52, 0.72, stain) + 0.12 * (noise(x * 3.0, y * 4.0, salt ^ 4) - 0.5);
        if self.nodes {
            // A node: dark dabs in a band across the strip, and a stain that fans out behind it.
            let at = (unit(own ^ 0xABC) * 0.8 + 0.1) * self.length_m + 0.006 * (noise(y * 250.0, 0.0, own) - 0.5);
            let along = (x + shift) - piece * self.length_m - at;
            let band = smoothstep(0.006, 0.001, along.abs());
            if band > 0.0 {
                let dabs = smoothstep(0.42, 0.72, noise(x * 500.0, y * 1100.0, own ^ 4));
                shade += band * (0.22 + 0.5 * dabs);
            }
            if along > 0.0 && along < 0.04 {
                let reach = 0.006 + 0.03 * noise(y * 700.0, 5.0, own).powi(2);
                shade += 0.22 * smoothstep(reach, 0.2 * reach, along);
            }
        }
        let mut color = mix(self.light, self.dark, shade + 0.2);
        // Fibres that stand up catch light.
        if seen > 0.0 {
            let bright = noise(x * 80.0, across / (1.1 * self.fibre_m), own ^ 9);
            color *= 1.0 + 0.22 * self.grain * seen * smoothstep(0.62, 0.85, bright);
        }
        // The glue line between strips.
        let edge = ((y / self.strip_m) - strip - 0.5).abs();
        color *= 1.0 - 0.22 * smoothstep(0.5 - 0.0006 / self.strip_m, 0.5, edge);
        (color, slope)
    }
}

/// How deep (0 to 1) and how steep (in its direction) a groove is: round-bottomed, of this half width, at a signed
/// distance from its middle.
fn groove(distance_m: f32, half_width_m: f32) -> (f32, f32) {
    let t = distance_m / half_width_m;
    if t.abs() >= 1.0 { (0.0, 0.0) } else { (1.0 - t * t, 0.9 * (std::f32::consts::PI * t).sin()) }
}

/// Signed distance to a rectangle with rounded corners, and its gradient.
fn rounded_rectangle(x: f32, y: f32, half: (f32, f32), radius_m: f32) -> (f32, (f32, f32)) {
    let (qx, qy) = (x.abs() - half.0 + radius_m, y.abs() - half.1 + radius_m);
    let (ox, oy) = (qx.max(0.0), qy.max(0.0));
    let outside = ox.hypot(oy);
    let gradient = if qx > 0.0 && qy > 0.0 {
        (ox / outside * x.signum(), oy / outside * y.signum())
    } else if qx > qy {
        (x.signum(), 0.0)
    } else {
        (0.0, y.signum())
    };
    (outside + qx.max(qy).min(0.0) - radius_m, gradient)
}

/// Two bamboo boards side by side, each with a groove round its border and slots for the hands.
pub(super) fn bamboo((x, y): (f32, f32), pixel_m: f32, half_extent_m: (f32, f32), salt: u32) -> Finish {
    let wood = Wood {
        strip_m: 0.021,
        length_m: 0.31,
        light: Vec3::new(0.80, 0.685, 0.535),
        dark: Vec3::new(0.44, 0.29, 0.16),
        tones: 0.30,
        grain: 1.45,
        fibre_m: 0.000_30,
        nodes: true,
    };
    // The boards meet at x = 0.
    let board = if x < 0.0 { 1 } else { 2 };
    let half = (0.5 * half_extent_m.0, half_extent_m.1);
    let (u, v) = (x - half.0 * x.signum(), y);
    let salt = salt ^ hash(board, 1, 0x4B);
    let (mut albedo, across) = wood.at(u, v, pixel_m, salt);
    let mut slope = (0.0, across);
    let (distance_m, gradient) = rounded_rectangle(u, v, (half.0 - 0.035, half.1 - 0.035), 0.03);
    let (mut depth, mut steep) = groove(distance_m, 0.0045);
    let mut towards = gradient;
    // The slot for the hand, near the outer end.
    let side = u * x.signum() - (half.0 - 0.075);
    if side.hypot((v.abs() - 0.06).max(0.0)) < 0.011 {
        (depth, steep) = (0.8, 0.9 * (side / 0.011));
        towards = (x.signum(), 0.0);
    }
    albedo *= 1.0 - 0.16 * depth;
    slope.0 += steep * towards.0;
    slope.1 += steep * towards.1;
    // The joint, and the rounded rims beside it.
    let joint = x.abs();
    if joint < 0.004 {
        slope.0 -= 0.5 * (1.0 - joint / 0.004) * x.signum();
        albedo *= 1.0 - 0.85 * smoothstep(0.0009, 0.0003, joint);
    }
    Finish { albedo, roughness: 0.5, coat: 0.55, slope }
}

/// A desk of oiled oak planks.
pub(super) fn oak((x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    let wood = Wood {
        strip_m: 0.09,
        length_m: 0.9,
        light: Vec3::new(0.47, 0.29, 0.15),
        dark: Vec3::new(0.10, 0.05, 0.024),
        tones: 0.35,
        grain: 1.25,
        fibre_m: 0.000_42,
        nodes: false,
    };
    let (albedo, across) = wood.at(x, y, pixel_m, salt);
    Finish { albedo, roughness: 0.38, coat: 0.8, slope: (0.0, across) }
}

/// The sawn edge of a board.
pub(super) fn edge((x, y): (f32, f32), salt: u32) -> Finish {
    let shade = 0.7 + 0.5 * fractal(x * 15.0, y * 600.0, 3, 0.6, salt);
    Finish { albedo: Vec3::new(0.40, 0.27, 0.15) * shade, roughness: 0.6, coat: 0.3, slope: (0.0, 0.0) }
}
