// One layer of a network, h = act(x W + b), and its derivatives, as one matrix product C = A B in tiles. Twins: `simd::gemm`,
// `Mlp::forward` and `Mlp::backward`; `mlp.rs` has the formulas.

// 0: h = act(x W + b), for tangents u = q W. 1: dx = (dz W^T) act'. 2: dW = x^T dz and db = 1^T dz, of tangents dW = q^T r,
// added to sums over pieces of the rows.
override product: u32;
// Tiles of 256 x 16 in place of 64 x 64.
override narrow: bool;

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

var<immediate> sizes: Sizes;
// Rows are multiples of eight numbers, and are read and written by fours.
@group(0) @binding(1) var<storage, read> parameters: array<vec4<f32>>;
// [rows, in_stride]
@group(0) @binding(2) var<storage, read> x: array<vec4<f32>>;
// [rows, out_stride]: product 0 writes h, the others read dz.
@group(0) @binding(3) var<storage, read_write> z: array<vec4<f32>>;
// [rows, in_stride]
@group(0) @binding(4) var<storage, read_write> dx: array<vec4<f32>>;
// [pieces, parameters]
@group(0) @binding(5) var<storage, read_write> partial_sums: array<vec4<f32>>;

const DEPTH = 8u;
// Height and width of a tile of C, by fours.
override HEIGHT = select(16u, 64u, narrow);
override WIDTH = select(16u, 4u, narrow);

// [DEPTH, height] of A, transposed, and [DEPTH, width] of B.
var<workgroup> a_tile: array<vec4<f32>, 512>;
var<workgroup> b_tile: array<vec4<f32>, 128>;

// The first numbers of four, which are the `at`-th and so on; those from `end` on are zero.
fn before(v: vec4<f32>, at: u32, end: u32) -> vec4<f32> {
    return select(vec4(0.0), v, vec4(at, at + 1u, at + 2u, at + 3u) < vec4(end));
}

// A[m, k..k + 4] of products 0 and 1.
fn left_row(m: u32, k: u32) -> vec4<f32> {
    if m >= sizes.rows {
        return vec4(0.0);
    }
    if product == 0u {
        return before(x[(m * sizes.in_stride + k) / 4u], k, sizes.inputs);
    }
    // Behind the outputs a skip layer has other numbers.
    return before(z[(m * sizes.out_stride + k) / 4u], k, sizes.outputs);
}

// A[m..m + 4, k] of product 2.
fn left_column(m: u32, k: u32, end: u32) -> vec4<f32> {
    if m >= sizes.inputs || k >= end {
        return vec4(0.0);
    }
    return x[(k * sizes.in_stride + m) / 4u];
}

// B[k..k + 4, n] of product 1.
fn right_column(k: u32, n: u32) -> vec4<f32> {
    if n >= sizes.inputs || k >= sizes.outputs {
        return vec4(0.0);
    }
    return parameters[(sizes.weights + n * sizes.weight_stride + k) / 4u];
}

// B[k, n..n + 4] of products 0 and 2.
fn right_row(k: u32, n: u32, end: u32) -> vec4<f32> {
    if n >= sizes.weight_stride || k >= end {
        return vec4(0.0);
    }
    if product == 0u {
        return parameters[(sizes.weights + k * sizes.weight_stride + n) / 4u];
    }
    if sizes.unit == 1u {
        return vec4(select(0.0, 1.0, n == 0u), 0.0, 0.0, 0.0);
    }
    return before(z[(k * sizes.out_stride + n) / 4u], n, sizes.outputs);
}

// The next DEPTH numbers of the sums, into the tiles. Neighbouring threads write neighbouring numbers.
fn load(thread: u32, m_tile: u32, n_tile: u32, k0: u32, end: u32) {
    if product == 2u {
        for (var i = thread; i < DEPTH * HEIGHT; i += 64u) {
            a_tile[i] = left_column(m_tile + 4u * (i % HEIGHT), k0 + i / HEIGHT, end);
        }
    } else {
        for (var i = thread; i < 4u * HEIGHT * (DEPTH / 4u); i += 64u) {
            let m = i % (4u * HEIGHT);
            let k = 4u * (i / (4u * HEIGHT));
            let row = left_row(m_tile + m, k0 + k);
            let at = k * HEIGHT + m / 4u;
            a_tile[at][m % 4u] = row.x;
            a_tile[at + HEIGHT][m % 4u] = row.y;
            a_tile[at + 2u * HEIGHT][m % 4u] = row.z;
            a_tile[at + 3u * HEIGHT][m % 4u] = row.w;
        }
    }
    if product == 1u {
        for (var i = thread; i < 4u * WIDTH * (DEPTH / 4u); i += 64u) {
            let n = i % (4u * WIDTH);
            let k = 4u * (i / (4u * WIDTH));
            let column = right_column(k0 + k, n_tile + n);
            let at = k * WIDTH + n / 4u;
            b_tile[at][n % 4u] = column.x;
            b_tile[at + WIDTH][n % 4u] = column.y;
            b_tile[at + 2u * WIDTH][n % 4u] = column.z;
            b_tile[at + 3u * WIDTH][n % 4u] = column.w;
        }
    } else {
        for (var i = thread; i < DEPTH * WIDTH; i += 64u) {
            b_tile[i] = right_row(k0 + i / WIDTH, n_tile + 4u * (i % WIDTH), end);
        }
    }
}

fn activated(v: vec4<f32>) -> vec4<f32> {
    if sizes.activation == 1u {
        return max(v, vec4(0.0));
    }
    if sizes.activation == 2u {
        return max(v, vec4(0.0)) + log(1.0 + exp(-sizes.beta * abs(v))) / sizes.beta;
    }
    return v;
}

// act'(z) where act(z) = h: softplus has exp(beta h) = 1 + exp(beta z).
fn slope(h: vec4<f32>) -> vec4<f32> {
    if sizes.activation == 1u {
        return select(vec4(0.0), vec4(1.0), h > vec4(0.0));
    }
    if sizes.activation == 2u {
        return 1.0 - exp(-sizes.beta * h);
    }
    return vec4(1.0);
}

// C[m, n..n + 4].
fn store(m: u32, n: u32, sum: vec4<f32>) {
    if product == 0u && m < sizes.rows && n < sizes.weight_stride {
        let bias = parameters[(sizes.weights + sizes.inputs * sizes.weight_stride + n) / 4u];
        // Padding stays zero, which softplus would not keep.
        let h = before(activated(sum + bias) * sizes.out_scale, n, sizes.outputs);
        z[(m * sizes.out_stride + n) / 4u] = select(h, sum, sizes.tangent == 1u);
    }
    if product == 1u && m < sizes.rows && n < sizes.inputs {
        let at = (m * sizes.in_stride + n) / 4u;
        let own = vec4(n, n + 1u, n + 2u, n + 3u) < vec4(sizes.own);
        dx[at] = sum * sizes.in_scale * select(vec4(1.0), slope(x[at] / sizes.in_scale), own);
    }
    if product == 2u && m < sizes.inputs && n < sizes.weight_stride {
        add(m, n, sum);
    }
}

// To the partial sums: a derivative of the weights, or of the bias, in the row behind them.
var<private> piece_of_group: u32;

fn add(m: u32, n: u32, sum: vec4<f32>) {
    partial_sums[(piece_of_group * sizes.parameters + sizes.weights + m * sizes.weight_stride + n) / 4u] += sum;
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
        height = sizes.inputs;
    }
    let across = (width + 4u * WIDTH - 1u) / (4u * WIDTH);
    let tiles = across * ((height + 4u * HEIGHT - 1u) / (4u * HEIGHT));
    let number = group.y * groups.x + group.x;
    let piece = number / tiles;
    if product == 2u {
        first = piece * sizes.piece;
        last = min(first + sizes.piece, sizes.rows);
        piece_of_group = piece;
    }
    let m_tile = (number % tiles) / across * (4u * HEIGHT);
    let n_tile = (number % tiles) % across * (4u * WIDTH);

    // Each thread sums 8 x 8 numbers: four rows and columns in each half of the tile.
    let m0 = thread / (WIDTH / 2u);
    let n0 = thread % (WIDTH / 2u);
    var low0 = vec4(0.0);
    var low1 = vec4(0.0);
    var low2 = vec4(0.0);
    var low3 = vec4(0.0);
    var low4 = vec4(0.0);
    var low5 = vec4(0.0);
    var low6 = vec4(0.0);
    var low7 = vec4(0.0);
    var high0 = vec4(0.0);
    var high1 = vec4(0.0);
    var high2 = vec4(0.0);
    var high3 = vec4(0.0);
    var high4 = vec4(0.0);
    var high5 = vec4(0.0);
    var high6 = vec4(0.0);
    var high7 = vec4(0.0);
    var bias_low = vec4(0.0);
    var bias_high = vec4(0.0);
    for (var k0 = first; k0 < last; k0 += DEPTH) {
        load(thread, m_tile, n_tile, k0, last);
        workgroupBarrier();
        for (var k = 0u; k < DEPTH; k += 1u) {
            let top = a_tile[k * HEIGHT + m0];
            let bottom = a_tile[k * HEIGHT + HEIGHT / 2u + m0];
            let low = b_tile[k * WIDTH + n0];
            let high = b_tile[k * WIDTH + WIDTH / 2u + n0];
            low0 += top.x * low;
            low1 += top.y * low;
            low2 += top.z * low;
            low3 += top.w * low;
            low4 += bottom.x * low;
            low5 += bottom.y * low;
            low6 += bottom.z * low;
            low7 += bottom.w * low;
            high0 += top.x * high;
            high1 += top.y * high;
            high2 += top.z * high;
            high3 += top.w * high;
            high4 += bottom.x * high;
            high5 += bottom.y * high;
            high6 += bottom.z * high;
            high7 += bottom.w * high;
            if product == 2u {
                bias_low += low;
                bias_high += high;
            }
        }
        workgroupBarrier();
    }
    if first >= last {
        return;
    }
    let m = m_tile + 4u * m0;
    let lower = m + 2u * HEIGHT;
    let n = n_tile + 4u * n0;
    let right = n + 2u * WIDTH;
    store(m, n, low0);
    store(m, right, high0);
    store(m + 1u, n, low1);
    store(m + 1u, right, high1);
    store(m + 2u, n, low2);
    store(m + 2u, right, high2);
    store(m + 3u, n, low3);
    store(m + 3u, right, high3);
    store(lower, n, low4);
    store(lower, right, high4);
    store(lower + 1u, n, low5);
    store(lower + 1u, right, high5);
    store(lower + 2u, n, low6);
    store(lower + 2u, right, high6);
    store(lower + 3u, n, low7);
    store(lower + 3u, right, high7);
    if product == 2u && sizes.tangent == 0u && m == 0u {
        if n < sizes.weight_stride {
            add(sizes.inputs, n, bias_low);
        }
        if right < sizes.weight_stride {
            add(sizes.inputs, right, bias_high);
        }
    }
}
