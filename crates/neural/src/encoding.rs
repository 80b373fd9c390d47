//! Fixed encodings: frequencies of a position (Mildenhall et al. 2020) and spherical harmonics of a direction.
//!
//! `gamma(x) = (x, sin(2^0 x), cos(2^0 x), ..., sin(2^(L-1) x), cos(2^(L-1) x))`, D numbers each. Its derivative is
//! diagonal per axis: `d sin(2^k x) = 2^k cos(2^k x) dx`, `d cos(2^k x) = -2^k sin(2^k x) dx`.

/// The frequency encoding of a position with L octaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frequencies(pub usize);

impl Frequencies {
    /// Numbers per position of three coordinates: 3 + 6 L.
    pub const fn width(self) -> usize {
        self.width_of(3)
    }

    /// Numbers per position of so many coordinates.
    pub const fn width_of(self, coordinates: usize) -> usize {
        coordinates * (1 + 2 * self.0)
    }

    /// Writes the encoding to the rows of `out`: `[samples, stride]`, from column `first`.
    pub fn forward<const D: usize>(self, positions: &[[f32; D]], out: &mut [f32], stride: usize, first: usize) {
        for (p, row) in positions.iter().zip(out.chunks_exact_mut(stride)) {
            let row = &mut row[first..first + self.width_of(D)];
            for d in 0..D {
                row[d] = p[d];
                for k in 0..self.0 {
                    let (sin, cos) = (p[d] * (1u64 << k) as f32).sin_cos();
                    row[D * (2 * k + 1) + d] = sin;
                    row[D * (2 * k + 2) + d] = cos;
                }
            }
        }
    }

    /// Adds `J^T g` to `normals`: the gradient of `g . gamma(x)`. `encoded` is what [`Self::forward`] wrote, `g` is laid
    /// out like it.
    pub fn input_gradient<const D: usize>(
        self,
        encoded: &[f32],
        g: &[f32],
        stride: usize,
        first: usize,
        normals: &mut [[f32; D]],
    ) {
        for ((e, g), n) in encoded.chunks_exact(stride).zip(g.chunks_exact(stride)).zip(normals) {
            let (e, g) = (&e[first..], &g[first..]);
            for d in 0..D {
                let mut sum = g[d];
                for k in 0..self.0 {
                    let (sin, cos) = (D * (2 * k + 1) + d, D * (2 * k + 2) + d);
                    sum += (1u64 << k) as f32 * (g[sin] * e[cos] - g[cos] * e[sin]);
                }
                n[d] += sum;
            }
        }
    }

    /// Adds `sum_d v_d d/dx n_d` to `to`, with `n = J^T g`: the second derivative that a loss on the gradient sends back
    /// to the position.
    pub fn second_gradient(
        self,
        encoded: &[f32],
        g: &[f32],
        v: &[[f32; 3]],
        stride: usize,
        first: usize,
        to: &mut [[f32; 3]],
    ) {
        let rows = encoded.chunks_exact(stride).zip(g.chunks_exact(stride));
        for (((e, g), v), to) in rows.zip(v).zip(to) {
            let (e, g) = (&e[first..], &g[first..]);
            for d in 0..3 {
                for k in 0..self.0 {
                    let (sin, cos) = (3 + 6 * k + d, 6 + 6 * k + d);
                    let scale = (1u64 << (2 * k)) as f32;
                    to[d] -= v[d] * scale * (g[sin] * e[sin] + g[cos] * e[cos]);
                }
            }
        }
    }

    /// Writes `J v` to `out`, laid out like the encoding.
    pub fn tangent(self, encoded: &[f32], v: &[[f32; 3]], out: &mut [f32], stride: usize, first: usize) {
        for ((e, to), v) in encoded.chunks_exact(stride).zip(out.chunks_exact_mut(stride)).zip(v) {
            let (e, to) = (&e[first..], &mut to[first..]);
            for d in 0..3 {
                to[d] = v[d];
                for k in 0..self.0 {
                    let (sin, cos) = (3 + 6 * k + d, 6 + 6 * k + d);
                    let scale = (1u64 << k) as f32 * v[d];
                    to[sin] = scale * e[cos];
                    to[cos] = -scale * e[sin];
                }
            }
        }
    }
}

/// Numbers of [`spherical_harmonics`].
pub const HARMONICS: usize = 16;

/// Real spherical harmonics of degree 0 to 3 of a unit direction, orthonormal over the sphere.
pub fn spherical_harmonics([x, y, z]: [f32; 3]) -> [f32; HARMONICS] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        0.282_094_8,
        -0.488_602_5 * y,
        0.488_602_5 * z,
        -0.488_602_5 * x,
        1.092_548_4 * x * y,
        -1.092_548_4 * y * z,
        0.946_174_7 * zz - 0.315_391_57,
        -1.092_548_4 * x * z,
        0.546_274_2 * (xx - yy),
        0.590_043_6 * y * (yy - 3.0 * xx),
        2.890_611_4 * x * y * z,
        0.457_045_8 * y * (1.0 - 5.0 * zz),
        0.373_176_33 * z * (5.0 * zz - 3.0),
        0.457_045_8 * x * (1.0 - 5.0 * zz),
        1.445_305_7 * z * (xx - yy),
        0.590_043_6 * x * (3.0 * yy - xx),
    ]
}

/// Adds to `to` the gradient of `g . spherical_harmonics(d)`, the polynomials taken as functions of all of space.
pub fn harmonics_gradient([x, y, z]: [f32; 3], g: &[f32], to: &mut [f32; 3]) {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let (a, b, c, d, e) = (1.092_548_4, 0.546_274_2, 0.590_043_6, 0.457_045_8, 1.445_305_7);
    to[0] += -0.488_602_5 * g[3] + a * (y * g[4] - z * g[7]) + 2.0 * b * x * g[8] - 6.0 * c * x * y * g[9]
        + 2.890_611_4 * y * z * g[10]
        + d * (1.0 - 5.0 * zz) * g[13]
        + 2.0 * e * x * z * g[14]
        + 3.0 * c * (yy - xx) * g[15];
    to[1] += -0.488_602_5 * g[1] + a * (x * g[4] - z * g[5]) - 2.0 * b * y * g[8]
        + 3.0 * c * (yy - xx) * g[9]
        + 2.890_611_4 * x * z * g[10]
        + d * (1.0 - 5.0 * zz) * g[11]
        - 2.0 * e * y * z * g[14]
        + 6.0 * c * x * y * g[15];
    to[2] +=
        0.488_602_5 * g[2] - a * (y * g[5] + x * g[7]) + 2.0 * 0.946_174_7 * z * g[6] + 2.890_611_4 * x * y * g[10]
            - 10.0 * d * z * (y * g[11] + x * g[13])
            + 0.373_176_33 * (15.0 * zz - 3.0) * g[12]
            + e * (xx - yy) * g[14];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frequencies_have_the_derivative_of_finite_differences() {
        let (encoding, stride) = (Frequencies(4), 32);
        let p = [0.3, -0.7, 0.9];
        let encode = |p: [f32; 3]| {
            let mut row = vec![0.0; stride];
            encoding.forward(&[p], &mut row, stride, 2);
            row
        };
        let e = encode(p);
        assert_eq!(&e[2..5], &p);
        let g: Vec<f32> = (0..stride).map(|i| (i as f32 * 0.37).sin()).collect();
        let mut n = [[0.0; 3]];
        encoding.input_gradient(&e, &g, stride, 2, &mut n);
        for d in 0..3 {
            let mut unit = [[0.0; 3]];
            unit[0][d] = 1.0;
            let mut tangent = vec![0.0; stride];
            encoding.tangent(&e, &unit, &mut tangent, stride, 2);
            let at = |h: f32| {
                let mut p = p;
                p[d] += h;
                encode(p)
            };
            let (above, below) = (at(1e-3), at(-1e-3));
            let mut dot = 0.0;
            for i in 2..2 + encoding.width() {
                let expected = (above[i] - below[i]) / 2e-3;
                assert!((tangent[i] - expected).abs() < 2e-3, "{} is not {expected}", tangent[i]);
                dot += g[i] * expected;
            }
            assert!((n[0][d] - dot).abs() < 1e-2, "{} is not {dot}", n[0][d]);
        }
    }

    #[test]
    fn second_derivatives_and_harmonics_agree_with_finite_differences() {
        let (encoding, stride) = (Frequencies(3), 24);
        let (p, v) = ([0.3, -0.7, 0.9], [0.4, -1.1, 0.6]);
        let g: Vec<f32> = (0..stride).map(|i| (i as f32 * 0.37).sin()).collect();
        let along = |p: [f32; 3]| {
            let (mut row, mut n) = (vec![0.0; stride], [[0.0; 3]]);
            encoding.forward(&[p], &mut row, stride, 0);
            encoding.input_gradient(&row, &g, stride, 0, &mut n);
            (0..3).map(|d| f64::from(n[0][d] * v[d])).sum::<f64>()
        };
        let mut row = vec![0.0; stride];
        encoding.forward(&[p], &mut row, stride, 0);
        let (mut second, mut first) = ([[0.0; 3]], [0.0; 3]);
        encoding.second_gradient(&row, &g, &[v], stride, 0, &mut second);
        harmonics_gradient(p, &g, &mut first);
        let weighted = |p| spherical_harmonics(p).iter().zip(&g).map(|(a, b)| f64::from(a * b)).sum::<f64>();
        for d in 0..3 {
            let moved = |h: f32| std::array::from_fn(|i| p[i] + if i == d { h } else { 0.0 });
            let expected = (along(moved(1e-3)) - along(moved(-1e-3))) / 2e-3;
            assert!((f64::from(second[0][d]) - expected).abs() < 5e-3, "{} is not {expected}", second[0][d]);
            let expected = (weighted(moved(1e-2)) - weighted(moved(-1e-2))) / 2e-2;
            assert!((f64::from(first[d]) - expected).abs() < 2e-3, "{} is not {expected}", first[d]);
        }
    }

    #[test]
    fn harmonics_are_orthonormal_over_the_sphere() {
        // Midpoints in z and longitude: exact enough for polynomials of degree six.
        let (rings, around) = (200, 32);
        let mut product = [[0.0f64; HARMONICS]; HARMONICS];
        for i in 0..rings * around {
            let z = ((i / around) as f64 + 0.5) / rings as f64 * 2.0 - 1.0;
            let (sin, cos) = ((i % around) as f64 / around as f64 * std::f64::consts::TAU).sin_cos();
            let r = (1.0 - z * z).sqrt();
            let h = spherical_harmonics([(r * cos) as f32, (r * sin) as f32, z as f32]);
            for a in 0..HARMONICS {
                for b in 0..HARMONICS {
                    product[a][b] +=
                        f64::from(h[a]) * f64::from(h[b]) * 4.0 * std::f64::consts::PI / (rings * around) as f64;
                }
            }
        }
        for (a, row) in product.iter().enumerate() {
            for (b, value) in row.iter().enumerate() {
                let expected = if a == b { 1.0 } else { 0.0 };
                assert!((value - expected).abs() < 2e-3, "<{a}, {b}> = {value}");
            }
        }
    }
}
