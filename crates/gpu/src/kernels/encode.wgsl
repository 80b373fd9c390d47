// The multi-resolution hash encoding, its gradient and its scatter. Twin: `HashGrid`, whose module has the formulas.
// One thread for each sample and level, but for `normals`: one for each sample.

struct Sizes {
    samples: u32,
    levels: u32,
    features: u32,
    // Row length of the features, and the encoding's first column. Where that is 3, the position in -1..1 comes first.
    stride: u32,
    first: u32,
    // Levels in use; the others give zero.
    active_levels: u32,
    // `scatter`: units of the sums in 1.
    units: f32,
}

@group(0) @binding(0) var<uniform> sizes: Sizes;
// [levels]: cells a side, offset of the first feature, entries, 1 where each corner has an entry of its own.
@group(0) @binding(1) var<storage, read> levels: array<vec4<u32>>;
// [samples, 3]: position in the unit cube.
@group(0) @binding(2) var<storage, read> positions: array<f32>;
@group(0) @binding(3) var<storage, read> table: array<f32>;
// [samples, stride]: `forward` and `tangent` write features, the scatters read their derivatives, `normals` reads g.
@group(0) @binding(4) var<storage, read_write> features: array<f32>;
// Derivatives of the table as whole numbers of 64 bits: low and high word of each.
@group(0) @binding(5) var<storage, read_write> sums: array<atomic<u32>>;
// [samples, 3]: `normals` writes n, `tangent` and `scatter_both` read dn; by the position in -1..1.
@group(0) @binding(6) var<storage, read_write> normals: array<f32>;
// [samples, stride]: g.
@group(0) @binding(7) var<storage, read> gradient: array<f32>;

struct Cell {
    base: vec3<u32>,
    t: vec3<f32>,
}

fn cell_of(sample: u32, cells: u32) -> Cell {
    let p = vec3(positions[3u * sample], positions[3u * sample + 1u], positions[3u * sample + 2u]);
    let at = clamp(p * f32(cells), vec3(0.0), vec3(f32(cells)));
    let base = min(vec3<u32>(at), vec3(cells - 1u));
    return Cell(base, at - vec3<f32>(base));
}

// Where the features of a corner begin in the table.
fn entry(level: vec4<u32>, cell: Cell, corner: u32) -> u32 {
    let c = cell.base + vec3(corner & 1u, (corner >> 1u) & 1u, corner >> 2u);
    let side = level.x + 1u;
    let dense = (c.z * side + c.y) * side + c.x;
    let hashed = (c.x ^ (c.y * 2654435761u) ^ (c.z * 805459861u)) & (level.z - 1u);
    return level.y + select(hashed, dense, level.w == 1u) * sizes.features;
}

fn weight(cell: Cell, corner: u32) -> f32 {
    let upper = vec3((corner & 1u) == 1u, ((corner >> 1u) & 1u) == 1u, (corner >> 2u) == 1u);
    let w = select(1.0 - cell.t, cell.t, upper);
    return w.x * w.y * w.z;
}

@compute @workgroup_size(64)
fn forward(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread >= sizes.samples * sizes.levels {
        return;
    }
    let l = thread % sizes.levels;
    let sample = thread / sizes.levels;
    let level = levels[l];
    let cell = cell_of(sample, level.x);
    let to = sample * sizes.stride + sizes.first + l * sizes.features;
    for (var f = 0u; f < sizes.features; f += 1u) {
        var sum = 0.0;
        for (var c = 0u; c < 8u && l < sizes.active_levels; c += 1u) {
            sum += weight(cell, c) * table[entry(level, cell, c) + f];
        }
        features[to + f] = sum;
    }
    if l == 0u && sizes.first == 3u {
        for (var d = 0u; d < 3u; d += 1u) {
            features[sample * sizes.stride + d] = 2.0 * positions[3u * sample + d] - 1.0;
        }
    }
}

// dw_c/dt.
fn weight_gradient(cell: Cell, corner: u32) -> vec3<f32> {
    let upper = vec3((corner & 1u) == 1u, ((corner >> 1u) & 1u) == 1u, (corner >> 2u) == 1u);
    let w = select(1.0 - cell.t, cell.t, upper);
    let sign = select(vec3(-1.0), vec3(1.0), upper);
    return sign * vec3(w.y * w.z, w.x * w.z, w.x * w.y);
}

fn normal_of(sample: u32) -> vec3<f32> {
    return vec3(normals[3u * sample], normals[3u * sample + 1u], normals[3u * sample + 2u]);
}

// The positions of the unit cube are half as long as those in -1..1.
@compute @workgroup_size(64)
fn normals_of(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let sample = id.y * groups.x * 64u + id.x;
    if sample >= sizes.samples {
        return;
    }
    let row = sample * sizes.stride;
    var n = vec3(0.0);
    for (var l = 0u; l < sizes.active_levels; l += 1u) {
        let level = levels[l];
        let cell = cell_of(sample, level.x);
        for (var c = 0u; c < 8u; c += 1u) {
            let from_entry = entry(level, cell, c);
            var dot_g = 0.0;
            for (var f = 0u; f < sizes.features; f += 1u) {
                dot_g += features[row + sizes.first + l * sizes.features + f] * table[from_entry + f];
            }
            n += 0.5 * f32(level.x) * dot_g * weight_gradient(cell, c);
        }
    }
    for (var d = 0u; d < 3u; d += 1u) {
        normals[3u * sample + d] = features[row + d] + n[d];
    }
}

// dg = J dn.
@compute @workgroup_size(64)
fn tangent(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread >= sizes.samples * sizes.levels {
        return;
    }
    let l = thread % sizes.levels;
    let sample = thread / sizes.levels;
    let level = levels[l];
    let cell = cell_of(sample, level.x);
    let d_n = normal_of(sample);
    let to = sample * sizes.stride + sizes.first + l * sizes.features;
    for (var f = 0u; f < sizes.features; f += 1u) {
        var sum = 0.0;
        for (var c = 0u; c < 8u && l < sizes.active_levels; c += 1u) {
            sum += dot(weight_gradient(cell, c), d_n) * table[entry(level, cell, c) + f];
        }
        features[to + f] = 0.5 * f32(level.x) * sum;
    }
    if l == 0u {
        for (var d = 0u; d < 3u; d += 1u) {
            features[sample * sizes.stride + d] = d_n[d];
        }
    }
}

// Whole numbers add up to the same sum in any order. Of two additions to the low word that run over together exactly one sees
// the low word pass zero, and carries.
fn add(parameter: u32, share: f32) {
    let units = round(clamp(share * sizes.units, -1152921504606846976.0, 1152921504606846976.0));
    var low = bitcast<u32>(i32(units));
    var high = select(0, -1, units < 0.0);
    if abs(units) >= 1073741824.0 {
        let upper = floor(units / 4294967296.0);
        low = u32(units - 4294967296.0 * upper);
        high = i32(upper);
    }
    if low != 0u {
        let before = atomicAdd(&sums[2u * parameter], low);
        high += select(0, 1, before + low < before);
    }
    if high != 0 {
        atomicAdd(&sums[2u * parameter + 1u], bitcast<u32>(high));
    }
}

@compute @workgroup_size(64)
fn scatter(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    let l = thread % sizes.levels;
    let sample = thread / sizes.levels;
    if sample >= sizes.samples || l >= sizes.active_levels {
        return;
    }
    let level = levels[l];
    let cell = cell_of(sample, level.x);
    let from_row = sample * sizes.stride + sizes.first + l * sizes.features;
    for (var c = 0u; c < 8u; c += 1u) {
        let w = weight(cell, c);
        let to = entry(level, cell, c);
        for (var f = 0u; f < sizes.features; f += 1u) {
            add(to + f, w * features[from_row + f]);
        }
    }
}

// With the part that a loss on normals asks for.
@compute @workgroup_size(64)
fn scatter_both(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    let l = thread % sizes.levels;
    let sample = thread / sizes.levels;
    if sample >= sizes.samples || l >= sizes.active_levels {
        return;
    }
    let level = levels[l];
    let cell = cell_of(sample, level.x);
    let d_n = normal_of(sample);
    let from_row = sample * sizes.stride + sizes.first + l * sizes.features;
    for (var c = 0u; c < 8u; c += 1u) {
        let w = weight(cell, c);
        let w_n = 0.5 * f32(level.x) * dot(weight_gradient(cell, c), d_n);
        let to = entry(level, cell, c);
        for (var f = 0u; f < sizes.features; f += 1u) {
            add(to + f, w * features[from_row + f] + w_n * gradient[from_row + f]);
        }
    }
}
