// The gradient of a network's weights, added up; and weight normalisation: column o of a layer's weights is
// w_o = g_o v_o / |v_o|. Twin: `Network::add_gradient` and `Network::refresh` of mb-neural, whose module has the formulas.

struct Sizes {
    columns: u32,
    // `sum_up`: length of the parameters, and partial sums.
    parameters: u32,
    pieces: u32,
}

var<immediate> sizes: Sizes;
// [columns]: where the column begins, row length, rows; the bias is the row behind them.
@group(0) @binding(1) var<storage, read> columns: array<vec4<u32>>;
// v, and g.
@group(0) @binding(2) var<storage, read> directions: array<f32>;
@group(0) @binding(3) var<storage, read> lengths: array<f32>;
// [pieces, parameters]; cleared.
@group(0) @binding(4) var<storage, read_write> partial_sums: array<f32>;
// dw; `send` turns it into dv, and writes dg.
@group(0) @binding(5) var<storage, read_write> d_weights: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_lengths: array<f32>;
@group(0) @binding(7) var<storage, read_write> weights: array<f32>;

// A workgroup for eight parameters, whose eight threads each add up every eighth piece.
var<workgroup> eighths: array<f32, 64>;

@compute @workgroup_size(64)
fn sum_up(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = (group.y * groups.x + group.x) * 8u + thread % 8u;
    var sum = 0.0;
    for (var piece = thread / 8u; piece < sizes.pieces && i < sizes.parameters; piece += 8u) {
        sum += partial_sums[piece * sizes.parameters + i];
    }
    // Not in the same loop, where each load would wait for the store before it.
    for (var piece = thread / 8u; piece < sizes.pieces && i < sizes.parameters; piece += 8u) {
        partial_sums[piece * sizes.parameters + i] = 0.0;
    }
    eighths[thread] = sum;
    workgroupBarrier();
    if thread < 8u && i < sizes.parameters {
        for (var k = 1u; k < 8u; k += 1u) {
            sum += eighths[8u * k + thread];
        }
        d_weights[i] = sum;
    }
}

fn norm(column: vec4<u32>) -> f32 {
    var sum = 0.0;
    for (var row = 0u; row < column.z; row += 1u) {
        let v = directions[column.x + row * column.y];
        sum += v * v;
    }
    return max(sqrt(sum), 1e-12);
}

// One thread for each column.
@compute @workgroup_size(64)
fn send(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.columns {
        let column = columns[i];
        let n = norm(column);
        var dg = 0.0;
        for (var row = 0u; row < column.z; row += 1u) {
            let at = column.x + row * column.y;
            dg += d_weights[at] * directions[at];
        }
        dg /= n;
        for (var row = 0u; row < column.z; row += 1u) {
            let at = column.x + row * column.y;
            d_weights[at] = lengths[i] / n * (d_weights[at] - dg * directions[at] / n);
        }
        d_lengths[i] = dg;
    }
}

// One thread for each column.
@compute @workgroup_size(64)
fn normalise(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.columns {
        let column = columns[i];
        let factor = lengths[i] / norm(column);
        for (var row = 0u; row < column.z; row += 1u) {
            let at = column.x + row * column.y;
            weights[at] = directions[at] * factor;
        }
        let bias = column.x + column.z * column.y;
        weights[bias] = directions[bias];
    }
}
