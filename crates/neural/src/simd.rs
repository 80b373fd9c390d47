//! Vector arithmetic with run-time dispatch: one matrix product, and element-wise functions.
//!
//! Each kernel is written once, generic over `Vector` or as a plain loop, and compiled three times: for any
//! processor, for AVX2 with FMA, and for AVX-512. The choice is made at run time. Sums are formed in the same order by
//! any number of threads, so a result depends on the machine's instruction set but on nothing else.
//!
//! All `unsafe` code of the crate is in this module.

use serde::Serialize;

/// An instruction set that the kernels are compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Isa {
    /// What every processor of the target has.
    Portable,
    /// 256-bit vectors with fused multiply-add.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 512-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Isa {
    /// The best one that this processor has.
    pub fn detected() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if std::is_x86_feature_detected!("avx512f")
                && std::is_x86_feature_detected!("avx512vl")
                && std::is_x86_feature_detected!("avx512dq")
                && Self::has_avx2()
            {
                return Self::Avx512;
            }
            if Self::has_avx2() {
                return Self::Avx2;
            }
        }
        Self::Portable
    }

    /// All that this processor has, the simplest first.
    pub fn available() -> Vec<Self> {
        let mut all = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            if Self::has_avx2() {
                all.push(Self::Avx2);
            }
            if Self::detected() == Self::Avx512 {
                all.push(Self::Avx512);
            }
        }
        all
    }

    #[cfg(target_arch = "x86_64")]
    fn has_avx2() -> bool {
        std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma")
    }
}

/// Rounds a row length up to a whole number of the narrowest vectors (8).
pub const fn padded(columns: usize) -> usize {
    columns.next_multiple_of(8)
}

/// What a product is added to.
#[derive(Debug, Clone, Copy)]
pub enum Init<'a> {
    /// Zero: the product replaces C.
    Zero,
    /// C itself.
    Accumulate,
    /// The same row (a bias, `[n]`) everywhere.
    Row(&'a [f32]),
}

/// A matrix `[m, k]` with any strides, so that a transpose costs nothing.
#[derive(Debug, Clone, Copy)]
pub struct Left<'a> {
    /// The entries; (row, col) is `data[row * row_stride + col * col_stride]`.
    pub data: &'a [f32],
    /// Distance between rows.
    pub row_stride: usize,
    /// Distance between columns.
    pub col_stride: usize,
}

/// The sizes of a product: `[m, k] x [k, n]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dims {
    /// Rows of the result.
    pub m: usize,
    /// Columns of the result, a multiple of 8.
    pub n: usize,
    /// Inner size.
    pub k: usize,
}

/// `C = init + A * B`, with A `[m, k]`, B `[k, n]` in rows `b_stride` apart, C `[m, n]` in rows `c_stride` apart.
///
/// Terms are added in the order of k. The three products of a fully connected layer are all of this form: with
/// activations and weights stored row by row (`x: [samples, in]`, `w: [in, out]`, `dz: [samples, out]`) they are
/// `z = x w`, `dw += x^T dz` and `dx = dz w^T` (with `w^T` copied once a step).
///
/// # Panics
/// A slice is too short for the sizes, or `n` is no multiple of 8.
pub fn gemm(dims: Dims, a: Left<'_>, b: &[f32], b_stride: usize, c: &mut [f32], c_stride: usize, init: Init<'_>) {
    gemm_on(Isa::detected(), dims, a, b, b_stride, c, c_stride, init);
}

/// Inner blocks of the product: a panel of B of this many rows stays in the first-level cache.
const K_BLOCK: usize = 256;

/// [`gemm`] with a chosen instruction set, which must be [`Isa::available`].
#[allow(clippy::too_many_arguments)]
pub(crate) fn gemm_on(
    isa: Isa,
    dims: Dims,
    a: Left<'_>,
    b: &[f32],
    b_stride: usize,
    c: &mut [f32],
    c_stride: usize,
    init: Init<'_>,
) {
    let Dims { m, n, k } = dims;
    assert!(n.is_multiple_of(8), "{n} columns are no multiple of 8");
    if m == 0 || n == 0 {
        return;
    }
    assert!(c.len() >= (m - 1) * c_stride + n && c_stride >= n, "the result is too small");
    if k > 0 {
        assert!(a.data.len() > (m - 1) * a.row_stride + (k - 1) * a.col_stride, "the left matrix is too small");
        assert!(b.len() >= (k - 1) * b_stride + n, "the right matrix is too small");
    }
    if let Init::Row(row) = init {
        assert!(row.len() >= n, "the bias is too short");
    }
    let mut k0 = 0;
    loop {
        let k_len = (k - k0).min(K_BLOCK);
        let product = Product {
            m,
            n,
            k: k_len,
            a: a.data.as_ptr().wrapping_add(k0 * a.col_stride),
            a_rows: a.row_stride,
            a_cols: a.col_stride,
            b: b.as_ptr().wrapping_add(k0 * b_stride),
            b_rows: b_stride,
            c: c.as_mut_ptr(),
            c_rows: c_stride,
            init: if k0 > 0 { Init::Accumulate } else { init },
        };
        // SAFETY: the lengths were checked above, and the caller vouches for the instruction set.
        unsafe {
            match isa {
                Isa::Portable => product_portable(&product),
                #[cfg(target_arch = "x86_64")]
                Isa::Avx2 => product_avx2(&product),
                #[cfg(target_arch = "x86_64")]
                Isa::Avx512 => product_avx512(&product),
            }
        }
        k0 += k_len;
        if k0 >= k {
            return;
        }
    }
}

/// One block of a product, as pointers whose extents [`gemm_on`] has checked.
struct Product<'a> {
    m: usize,
    n: usize,
    k: usize,
    a: *const f32,
    a_rows: usize,
    a_cols: usize,
    b: *const f32,
    b_rows: usize,
    c: *mut f32,
    c_rows: usize,
    init: Init<'a>,
}

/// A register of [`Vector::LANES`] numbers.
trait Vector: Copy {
    const LANES: usize;
    fn splat(value: f32) -> Self;
    /// # Safety
    /// `LANES` numbers are readable at `from`.
    unsafe fn load(from: *const f32) -> Self;
    /// # Safety
    /// `LANES` numbers are writable at `to`.
    unsafe fn store(self, to: *mut f32);
    /// `self * factor + sum`.
    fn mul_add(self, factor: Self, sum: Self) -> Self;
}

#[derive(Clone, Copy)]
struct F32x4([f32; 4]);

impl Vector for F32x4 {
    const LANES: usize = 4;
    #[inline(always)]
    fn splat(value: f32) -> Self {
        Self([value; 4])
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: as the trait demands; an array of f32 needs no more alignment than f32.
        Self(unsafe { *from.cast() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: as the trait demands.
        unsafe { *to.cast() = self.0 }
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, sum: Self) -> Self {
        Self(std::array::from_fn(|i| {
            if cfg!(target_arch = "aarch64") {
                self.0[i].mul_add(factor.0[i], sum.0[i])
            } else {
                self.0[i] * factor.0[i] + sum.0[i]
            }
        }))
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::{
        __m256, __m512, _mm256_fmadd_ps, _mm256_loadu_ps, _mm256_set1_ps, _mm256_storeu_ps, _mm512_fmadd_ps,
        _mm512_loadu_ps, _mm512_set1_ps, _mm512_storeu_ps,
    };

    use super::Vector;

    // SAFETY of both: the types are used only inside functions compiled for, and called on, processors that have
    // the instructions; pointers are as the trait demands.
    macro_rules! vector {
        ($register:ty, $lanes:literal, $splat:ident, $load:ident, $store:ident, $fmadd:ident) => {
            impl Vector for $register {
                const LANES: usize = $lanes;
                #[inline(always)]
                fn splat(value: f32) -> Self {
                    unsafe { $splat(value) }
                }
                #[inline(always)]
                unsafe fn load(from: *const f32) -> Self {
                    unsafe { $load(from) }
                }
                #[inline(always)]
                unsafe fn store(self, to: *mut f32) {
                    unsafe { $store(to, self) }
                }
                #[inline(always)]
                fn mul_add(self, factor: Self, sum: Self) -> Self {
                    unsafe { $fmadd(self, factor, sum) }
                }
            }
        };
    }
    vector!(__m256, 8, _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_fmadd_ps);
    vector!(__m512, 16, _mm512_set1_ps, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_fmadd_ps);
}

unsafe fn product_portable(p: &Product<'_>) {
    // SAFETY: handed on.
    unsafe { product_body::<F32x4, F32x4, 6>(p) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn product_avx2(p: &Product<'_>) {
    // SAFETY: handed on.
    unsafe { product_body::<std::arch::x86_64::__m256, F32x4, 6>(p) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx2,fma")]
unsafe fn product_avx512(p: &Product<'_>) {
    // SAFETY: handed on.
    unsafe { product_body::<std::arch::x86_64::__m512, std::arch::x86_64::__m256, 12>(p) }
}

/// Columns in strips of two registers, then one, then one narrow register; rows in blocks of `MR` whose sums stay in
/// registers over the whole inner loop.
#[inline(always)]
unsafe fn product_body<V: Vector, Narrow: Vector, const MR: usize>(p: &Product<'_>) {
    let mut column = 0;
    // SAFETY: column + strip width <= n in each call.
    unsafe {
        while p.n - column >= 2 * V::LANES {
            strip::<V, MR, 2>(p, column);
            column += 2 * V::LANES;
        }
        while p.n - column >= V::LANES {
            strip::<V, MR, 1>(p, column);
            column += V::LANES;
        }
        while p.n - column >= Narrow::LANES {
            strip::<Narrow, MR, 1>(p, column);
            column += Narrow::LANES;
        }
    }
}

#[inline(always)]
unsafe fn strip<V: Vector, const MR: usize, const NV: usize>(p: &Product<'_>, column: usize) {
    let mut row = 0;
    // SAFETY: row + block height <= m in each call.
    unsafe {
        while p.m - row >= MR {
            block::<V, MR, NV>(p, row, column);
            row += MR;
        }
        while p.m - row >= 4 {
            block::<V, 4, NV>(p, row, column);
            row += 4;
        }
        while row < p.m {
            block::<V, 1, NV>(p, row, column);
            row += 1;
        }
    }
}

#[inline(always)]
unsafe fn block<V: Vector, const MR: usize, const NV: usize>(p: &Product<'_>, row: usize, column: usize) {
    // SAFETY: rows row..row + MR and columns column..column + NV * LANES lie inside the checked extents.
    unsafe {
        let c = p.c.add(row * p.c_rows + column);
        let mut sum = [[V::splat(0.0); NV]; MR];
        match p.init {
            Init::Zero => {}
            Init::Accumulate => {
                for r in 0..MR {
                    for v in 0..NV {
                        sum[r][v] = V::load(c.add(r * p.c_rows + v * V::LANES));
                    }
                }
            }
            Init::Row(bias) => {
                for v in 0..NV {
                    let value = V::load(bias.as_ptr().add(column + v * V::LANES));
                    for row in &mut sum {
                        row[v] = value;
                    }
                }
            }
        }
        let mut a = p.a.wrapping_add(row * p.a_rows);
        let mut b = p.b.wrapping_add(column);
        for _ in 0..p.k {
            let mut right = [V::splat(0.0); NV];
            for v in 0..NV {
                right[v] = V::load(b.add(v * V::LANES));
            }
            for r in 0..MR {
                let left = V::splat(*a.add(r * p.a_rows));
                for v in 0..NV {
                    sum[r][v] = right[v].mul_add(left, sum[r][v]);
                }
            }
            a = a.wrapping_add(p.a_cols);
            b = b.wrapping_add(p.b_rows);
        }
        for r in 0..MR {
            for v in 0..NV {
                sum[r][v].store(c.add(r * p.c_rows + v * V::LANES));
            }
        }
    }
}

/// Compiles a plain loop for each instruction set and calls the best that the processor has. The body is an
/// `#[inline(always)]` function, which the compiler vectorises in each setting.
macro_rules! dispatched {
    ($(#[$meta:meta])* $vis:vis fn $name:ident$(<const $c:ident: usize>)?($($arg:ident: $ty:ty),* $(,)?) = $body:ident) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments)]
        $vis fn $name$(<const $c: usize>)?($($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                #[allow(clippy::too_many_arguments)]
                fn avx2$(<const $c: usize>)?($($arg: $ty),*) { $body$(::<$c>)?($($arg),*) }
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx2,fma")]
                #[allow(clippy::too_many_arguments)]
                fn avx512$(<const $c: usize>)?($($arg: $ty),*) { $body$(::<$c>)?($($arg),*) }
                match $crate::simd::Isa::detected() {
                    // SAFETY: the processor was asked.
                    $crate::simd::Isa::Avx512 => return unsafe { avx512$(::<$c>)?($($arg),*) },
                    // SAFETY: the processor was asked.
                    $crate::simd::Isa::Avx2 => return unsafe { avx2$(::<$c>)?($($arg),*) },
                    $crate::simd::Isa::Portable => {}
                }
            }
            $body$(::<$c>)?($($arg),*);
        }
    };
}
pub(crate) use dispatched;

/// exp(x) to 2 units in the last place between -87 and 88, clamped outside (Cody-Waite reduction, the polynomial of
/// Cephes' `expf`). Unlike `f32::exp` it vectorises.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to an integer in the low bits
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * 0.693_359_4) + n * 2.121_944_4e-4;
    let mut p = 1.987_569_1e-4;
    for c in [1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5] {
        p = p * r + c;
    }
    let y = p * r * r + r + 1.0;
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127);
    y * f32::from_bits(exponent << 23)
}

/// ln(1 + t) for t in 0..=1, to 1e-7 (the series of 2 artanh(t / (2 + t))).
#[inline(always)]
pub fn ln_1p_unit(t: f32) -> f32 {
    let s = t / (2.0 + t);
    let s2 = s * s;
    let mut p = 2.0 / 13.0;
    for c in [2.0 / 11.0, 2.0 / 9.0, 2.0 / 7.0, 2.0 / 5.0, 2.0 / 3.0, 2.0] {
        p = p * s2 + c;
    }
    p * s
}

/// 1 / (1 + exp(-x)).
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn naive(dims: Dims, a: &[f32], transposed: bool, b: &[f32], start: &[f32]) -> Vec<f64> {
        let Dims { m, n, k } = dims;
        (0..m * n)
            .map(|i| {
                let (r, c) = (i / n, i % n);
                let at = |p: usize| if transposed { a[p * m + r] } else { a[r * k + p] };
                f64::from(start[i]) + (0..k).map(|p| f64::from(at(p)) * f64::from(b[p * n + c])).sum::<f64>()
            })
            .collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn every_instruction_set_multiplies_any_shape(m in 0usize..40, blocks in 1usize..10, k in 0usize..300,
                                                      transposed: bool, seed in 0u64..1000) {
            use rand::RngExt;
            let dims = Dims { m, n: blocks * 8, k };
            let mut rng = mb_job::rng(seed, 0);
            let mut numbers = |n: usize| (0..n).map(|_| rng.random_range(-1.0..1.0f32)).collect::<Vec<_>>();
            let (a, b, bias, start) = (numbers(m * k), numbers(k * dims.n), numbers(dims.n), numbers(m * dims.n));
            let (row_stride, col_stride) = if transposed { (1, m) } else { (k, 1) };
            let left = Left { data: &a, row_stride, col_stride };
            let bias_rows: Vec<f32> = (0..m).flat_map(|_| bias.clone()).collect();
            for isa in Isa::available() {
                for (init, first) in [
                    (Init::Zero, vec![0.0; m * dims.n]), (Init::Accumulate, start.clone()), (Init::Row(&bias), bias_rows.clone()),
                ] {
                    let mut c = start.clone();
                    gemm_on(isa, dims, left, &b, dims.n, &mut c, dims.n, init);
                    for (found, expected) in c.iter().zip(naive(dims, &a, transposed, &b, &first)) {
                        prop_assert!((f64::from(*found) - expected).abs() < 1e-4, "{isa:?}: {found} is not {expected}");
                    }
                }
            }
        }

        #[test]
        fn fast_exponentials_agree_with_the_library(x in -80.0..80.0f32, t in 0.0..1.0f32) {
            prop_assert!((exp(x) / x.exp() - 1.0).abs() < 5e-7);
            prop_assert!((ln_1p_unit(t) - t.ln_1p()).abs() < 2e-7);
            prop_assert!((sigmoid(x) - 1.0 / (1.0 + (-x).exp())).abs() < 1e-6);
        }
    }

    #[test]
    fn exponentials_stay_finite_at_the_ends() {
        assert!(exp(1e30).is_finite() && exp(-1e30) >= 0.0 && exp(-1e30) < 1e-37);
        assert_eq!(exp(0.0), 1.0);
        assert_eq!(ln_1p_unit(0.0), 0.0);
    }
}
