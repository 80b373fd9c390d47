// One layer of a network, h = act(x W + b), and its derivatives, as one matrix product C = A B in tiles of 32 x 32. Twins:
// `simd::gemm`, `Mlp::forward` and `Mlp::backward`; `mlp.rs` has the formulas.

// 0: h = act(x W + b), for tangents u = q W. 1: dx = (dz W^T) act'. 2: dW = x^T dz and db = 1^T dz, of tangents dW = q^T r,
// added to sums over pieces of the rows.
override product: u32;

struct Sizes {
    rows: u32,
    inputs: u32,
    in_stride: u32,
    outputs: u32,
    weight_stride: u32,
    // Where the layer's weights begin, [inputs, weight_stride], followed by the bias, [weight_stride].
    weights: u32,
    // What z goes through in product 0, and what x came from in product 1: 0 nothing, 1 ReLU, 2 softplus.
    activation: u32,
    // Product 2: length of the parameter buffer, and rows of one partial sum.
    parameters: u32,
    piece: u32,
    // Sharpness of the softplus.
    beta: f32,
    // Products 0 and 2: rows are tangents, which have no bias.
    tangent: u32,
    // Product 2: dz is the unit vector of output 0.
    unit: u32,
    out_stride: u32,
    // Inputs that the layer before gives, behind which a skip layer has the network's, and the scale of both.
    own: u32,
    in_scale: f32,
    // Product 0: what h is scaled by.
    out_scale: f32,
}

@group(0) @binding(0) var<uniform> sizes: Sizes;
@group(0) @binding(1) var<storage, read> parameters: array<f32>;
// [rows, in_stride]
@group(0) @binding(2) var<storage, read> x: array<f32>;
// [rows, out_stride]: product 0 writes h, the others read dz.
@group(0) @binding(3) var<storage, read_write> z: array<f32>;
// [rows, in_stride]
@group(0) @binding(4) var<storage, read_write> dx: array<f32>;
// [pieces, parameters]
@group(0) @binding(5) var<storage, read_write> partial_sums: array<f32>;

const TILE = 32u;
const DEPTH = 16u;

// [DEPTH, TILE] of A, transposed, and of B.
var<workgroup> a_tile: array<f32, 512>;
var<workgroup> b_tile: array<f32, 512>;

// A[m, k].
fn left(m: u32, k: u32) -> f32 {
    if product == 0u {
        return x[m * sizes.in_stride + k];
    }
    if product == 1u {
        return z[m * sizes.out_stride + k];
    }
    // The bias has an input of its own, always one.
    if m == sizes.inputs {
        return 1.0;
    }
    return x[k * sizes.in_stride + m];
}

// B[k, n].
fn right(k: u32, n: u32) -> f32 {
    if product == 0u {
        return parameters[sizes.weights + k * sizes.weight_stride + n];
    }
    if product == 1u {
        return parameters[sizes.weights + n * sizes.weight_stride + k];
    }
    if sizes.unit == 1u {
        return select(0.0, 1.0, n == 0u);
    }
    // Behind the outputs a skip layer has other numbers.
    return select(0.0, z[k * sizes.out_stride + n], n < sizes.outputs);
}

fn activated(v: f32) -> f32 {
    if sizes.activation == 1u {
        return max(v, 0.0);
    }
    if sizes.activation == 2u {
        return max(v, 0.0) + log(1.0 + exp(-sizes.beta * abs(v))) / sizes.beta;
    }
    return v;
}

// act'(z) where act(z) = h: softplus has exp(beta h) = 1 + exp(beta z).
fn slope(h: f32) -> f32 {
    if sizes.activation == 1u {
        return select(0.0, 1.0, h > 0.0);
    }
    if sizes.activation == 2u {
        return 1.0 - exp(-sizes.beta * h);
    }
    return 1.0;
}

fn store(m: u32, n: u32, piece: u32, sum: f32) {
    if product == 0u {
        let bias = sizes.weights + sizes.inputs * sizes.weight_stride + n;
        // Padding stays zero, which softplus would not keep.
        let h = select(0.0, activated(sum + parameters[bias]) * sizes.out_scale, n < sizes.outputs);
        z[m * sizes.out_stride + n] = select(h, sum, sizes.tangent == 1u);
    } else if product == 1u {
        let at = m * sizes.in_stride + n;
        dx[at] = sum * sizes.in_scale * select(1.0, slope(x[at] / sizes.in_scale), n < sizes.own);
    } else {
        let at = piece * sizes.parameters + sizes.weights + m * sizes.weight_stride + n;
        partial_sums[at] += sum;
    }
}

@compute @workgroup_size(64)
fn multiply(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    // C is [height, width], and the sum runs over first..last.
    var height = sizes.rows;
    var width = sizes.weight_stride;
    var first = 0u;
    var last = sizes.inputs;
    if product == 1u {
        width = sizes.inputs;
        last = sizes.outputs;
    }
    if product == 2u {
        height = sizes.inputs + 1u - sizes.tangent;
    }
    let across = (width + TILE - 1u) / TILE;
    let tiles = across * ((height + TILE - 1u) / TILE);
    let number = group.y * groups.x + group.x;
    let piece = number / tiles;
    if product == 2u {
        first = piece * sizes.piece;
        last = min(first + sizes.piece, sizes.rows);
    }
    let m_tile = (number % tiles) / across * TILE;
    let n_tile = (number % tiles) % across * TILE;

    // Each thread sums 4 x 4 numbers.
    let m0 = 4u * (thread / 8u);
    let n0 = 4u * (thread % 8u);
    var s0 = vec4(0.0);
    var s1 = vec4(0.0);
    var s2 = vec4(0.0);
    var s3 = vec4(0.0);
    for (var k0 = first; k0 < last; k0 += DEPTH) {
        for (var i = thread; i < DEPTH * TILE; i += 64u) {
            // Neighbouring threads read neighbouring numbers.
            var k = i % DEPTH;
            var m = i / DEPTH;
            if product == 2u {
                k = i / TILE;
                m = i % TILE;
            }
            var value = 0.0;
            if m_tile + m < height && k0 + k < last {
                value = left(m_tile + m, k0 + k);
            }
            a_tile[k * TILE + m] = value;
            k = i / TILE;
            var n = i % TILE;
            if product == 1u {
                k = i % DEPTH;
                n = i / DEPTH;
            }
            value = 0.0;
            if n_tile + n < width && k0 + k < last {
                value = right(k0 + k, n_tile + n);
            }
            b_tile[k * TILE + n] = value;
        }
        workgroupBarrier();
        for (var k = 0u; k < DEPTH; k += 1u) {
            let a = k * TILE + m0;
            let b = k * TILE + n0;
            let row = vec4(b_tile[b], b_tile[b + 1u], b_tile[b + 2u], b_tile[b + 3u]);
            s0 += a_tile[a] * row;
            s1 += a_tile[a + 1u] * row;
            s2 += a_tile[a + 2u] * row;
            s3 += a_tile[a + 3u] * row;
        }
        workgroupBarrier();
    }
    var sums = array(s0, s1, s2, s3);
    for (var i = 0u; i < 4u; i += 1u) {
        for (var j = 0u; j < 4u; j += 1u) {
            let m = m_tile + m0 + i;
            let n = n_tile + n0 + j;
            if m < height && n < width && first < last {
                store(m, n, piece, sums[i][j]);
            }
        }
    }
}
