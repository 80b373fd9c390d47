// One layer of a network, h = act(x W + b), and its derivatives, as one matrix product C = A B in tiles. Twins: `simd::gemm`,
// `Mlp::forward` and `Mlp::backward`; `mlp.rs` has the formulas.

// 0: h = act(x W + b), for tangents u = q W. 1: dx = (dz W^T) act'. 2: dW = x^T dz and db = 1^T dz, of tangents dW = q^T r,
// added to sums over pieces of the rows.
override product: u32;
// Tiles of 128 x 16 in place of 64 x 64.
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
// Height and width of a tile of C, by fours, and threads across it.
override HEIGHT = select(16u, 32u, narrow);
override WIDTH = select(16u, 4u, narrow);
override ACROSS = select(8u, 4u, narrow);

// [DEPTH, height] of A, transposed, and [DEPTH, width] of B.
var<workgroup> a_tile: array<vec4<f32>, 256>;
var<workgroup> b_tile: array<vec4<f32>, 128>;

// The first numbers of four, which are the `at`-th and so on; those from `end` on are zero.
fn before(v: vec4<f32>, at: u32, end: u32) -> vec4<f32> {
    return select(vec4(0.0), v, vec4(at, at + 1u, at + 2u, at + 3u) < vec4(end));
}

// The i-th four numbers of A from column k0 on, or of B from row k0 on; zero outside. Of products 0 and 1 A lies along its
// rows, and of product 1 B along its columns. No branch: what is outside is read from the edge and dropped, so that loads
// need not wait for each other.
fn left(i: u32, m_tile: u32, k0: u32, end: u32) -> vec4<f32> {
    if product == 2u {
        let m = m_tile + 4u * (i % HEIGHT);
        let k = k0 + i / HEIGHT;
        let v = x[(min(k, sizes.rows - 1u) * sizes.in_stride + min(m, sizes.in_stride - 4u)) / 4u];
        return select(vec4(0.0), v, m < sizes.inputs && k < end);
    }
    let m = m_tile + i % (4u * HEIGHT);
    let k = k0 + 4u * (i / (4u * HEIGHT));
    let row = min(m, sizes.rows - 1u);
    if product == 0u {
        return before(x[(row * sizes.in_stride + k) / 4u], k, select(0u, sizes.inputs, m < sizes.rows));
    }
    // Behind the outputs a skip layer has other numbers.
    return before(z[(row * sizes.out_stride + k) / 4u], k, select(0u, sizes.outputs, m < sizes.rows));
}

fn right(i: u32, n_tile: u32, k0: u32, end: u32) -> vec4<f32> {
    if product == 1u {
        let n = n_tile + i % (4u * WIDTH);
        let k = k0 + 4u * (i / (4u * WIDTH));
        let row = sizes.weights + min(n, sizes.inputs - 1u) * sizes.weight_stride;
        return before(parameters[(row + k) / 4u], k, select(0u, sizes.outputs, n < sizes.inputs));
    }
    let n = n_tile + 4u * (i % WIDTH);
    let k = k0 + i / WIDTH;
    if product == 0u {
        // The bias follows the rows.
        let row = sizes.weights + min(k, sizes.inputs) * sizes.weight_stride;
        let v = parameters[(row + min(n, sizes.weight_stride - 4u)) / 4u];
        return select(vec4(0.0), v, n < sizes.weight_stride && k < end);
    }
    if sizes.unit == 1u {
        return vec4(select(0.0, 1.0, n == 0u && k < end), 0.0, 0.0, 0.0);
    }
    let v = z[(min(k, sizes.rows - 1u) * sizes.out_stride + min(n, sizes.out_stride - 4u)) / 4u];
    return before(v, n, select(0u, sizes.outputs, k < end));
}

// Puts four numbers into their tile. Neighbouring threads write neighbouring numbers.
fn put_left(i: u32, v: vec4<f32>) {
    if product == 2u {
        a_tile[i] = v;
    } else {
        let m = i % (4u * HEIGHT);
        let at = 4u * (i / (4u * HEIGHT)) * HEIGHT + m / 4u;
        a_tile[at][m % 4u] = v.x;
        a_tile[at + HEIGHT][m % 4u] = v.y;
        a_tile[at + 2u * HEIGHT][m % 4u] = v.z;
        a_tile[at + 3u * HEIGHT][m % 4u] = v.w;
    }
}

fn put_right(i: u32, v: vec4<f32>) {
    if product == 1u {
        let n = i % (4u * WIDTH);
        let at = 4u * (i / (4u * WIDTH)) * WIDTH + n / 4u;
        b_tile[at][n % 4u] = v.x;
        b_tile[at + WIDTH][n % 4u] = v.y;
        b_tile[at + 2u * WIDTH][n % 4u] = v.z;
        b_tile[at + 3u * WIDTH][n % 4u] = v.w;
    } else {
        b_tile[i] = v;
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

    // Each thread sums 8 x 8 numbers, four rows and columns in each half of the tile, or 8 x 4 of a narrow one.
    let m0 = thread / ACROSS;
    let n0 = thread % ACROSS;
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
    var a0 = vec4(0.0);
    var a1 = vec4(0.0);
    var a2 = vec4(0.0);
    var a3 = vec4(0.0);
    var b0 = vec4(0.0);
    var b1 = vec4(0.0);
    // One more turn than there are tiles: each loads the next tile while it works on the last one.
    for (var k0 = first; k0 < last + DEPTH; k0 += DEPTH) {
        if k0 > first {
            put_left(thread, a0);
            put_left(thread + 64u, a1);
            if narrow {
                put_left(thread + 128u, a2);
                put_left(thread + 192u, a3);
                if thread < 32u {
                    put_right(thread, b0);
                }
            } else {
                put_right(thread, b0);
                put_right(thread + 64u, b1);
            }
            workgroupBarrier();
        }
        if k0 < last {
            a0 = left(thread, m_tile, k0, last);
            a1 = left(thread + 64u, m_tile, k0, last);
            b0 = right(thread, n_tile, k0, last);
            if narrow {
                a2 = left(thread + 128u, m_tile, k0, last);
                a3 = left(thread + 192u, m_tile, k0, last);
            } else {
                b1 = right(thread + 64u, n_tile, k0, last);
            }
        }
        if k0 > first {
            for (var k = 0u; k < DEPTH; k += 1u) {
                let top = a_tile[k * HEIGHT + m0];
                let bottom = a_tile[k * HEIGHT + HEIGHT / 2u + m0];
                let low = b_tile[k * WIDTH + n0];
                low0 += top.x * low;
                low1 += top.y * low;
                low2 += top.z * low;
                low3 += top.w * low;
                low4 += bottom.x * low;
                low5 += bottom.y * low;
                low6 += bottom.z * low;
                low7 += bottom.w * low;
                if product == 2u {
                    bias_low += low;
                }
                if !narrow {
                    let high = b_tile[k * WIDTH + WIDTH / 2u + n0];
                    high0 += top.x * high;
                    high1 += top.y * high;
                    high2 += top.z * high;
                    high3 += top.w * high;
                    high4 += bottom.x * high;
                    high5 += bottom.y * high;
                    high6 += bottom.z * high;
                    high7 += bottom.w * high;
                    if product == 2u {
                        bias_high += high;
                    }
                }
            }
            workgroupBarrier();
        }
    }
    if first >= last {
        return;
    }
    let m = m_tile + 4u * m0;
    let lower = m + 2u * HEIGHT;
    let n = n_tile + 4u * n0;
    store(m, n, low0);
    store(m + 1u, n, low1);
    store(m + 2u, n, low2);
    store(m + 3u, n, low3);
    store(lower, n, low4);
    store(lower + 1u, n, low5);
    store(lower + 2u, n, low6);
    store(lower + 3u, n, low7);
    let has_bias = product == 2u && sizes.tangent == 0u && m == 0u;
    if has_bias && n < sizes.weight_stride {
        add(sizes.inputs, n, bias_low);
    }
    if narrow {
        return;
    }
    let n_high = n + 2u * WIDTH;
    store(m, n_high, high0);
    store(m + 1u, n_high, high1);
    store(m + 2u, n_high, high2);
    store(m + 3u, n_high, high3);
    store(lower, n_high, high4);
    store(lower + 1u, n_high, high5);
    store(lower + 2u, n_high, high6);
    store(lower + 3u, n_high, high7);
    if has_bias && n_high < sizes.weight_stride {
        add(sizes.inputs, n_high, bias_high);
    }
}
