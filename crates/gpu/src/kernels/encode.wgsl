// Tables of numbers at the corners of grids, sampled trilinearly: the multi-resolution hash encoding and dense voxels; their
// gradient and their scatter. Twins: `HashGrid`, whose module has the formulas, and `DenseGrid`.
// One thread for each sample, level and four of its features, but for `normals_of` and `position_gradient`: one for each
// sample.

const PART = 4u;

struct Sizes {
    samples: u32,
    levels: u32,
    // Of a level.
    features: u32,
    // Row length of the features, and the encoding's first column. Where that is 3, the position in -1..1 comes first.
    stride: u32,
    first: u32,
    // Levels in use; the others give zero.
    active_levels: u32,
    // `scatter`: units of the sums in 1.
    units: f32,
    // `normals_of`: 1 where it adds to what is there.
    adds: u32,
}

struct Level {
    // Along x, y and z; a hash grid has equally many.
    cells: vec3<u32>,
    // 1 where each corner has an entry of its own.
    dense: u32,
    // Where its features begin in the table.
    offset: u32,
    entries: u32,
}

var<immediate> sizes: Sizes;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
// [samples, 3]: position in the unit cube.
@group(0) @binding(2) var<storage, read> positions: array<f32>;
@group(0) @binding(3) var<storage, read> table: array<f32>;
// [samples, stride]: `forward` and `tangent` write features, the scatters and `position_gradient` read their derivatives,
// `normals_of` reads g.
@group(0) @binding(4) var<storage, read_write> features: array<f32>;
// Derivatives of the table as whole numbers of 64 bits: low and high word of each.
@group(0) @binding(5) var<storage, read_write> sums: array<atomic<u32>>;
// [samples, 3]: `normals_of` writes n, the others read dn; by the position in -1..1.
@group(0) @binding(6) var<storage, read_write> normals: array<f32>;
// [samples, stride]: g.
@group(0) @binding(7) var<storage, read> gradient: array<f32>;
// [samples, 3]: derivatives by the position in -1..1.
@group(0) @binding(8) var<storage, read_write> d_positions: array<f32>;

struct Cell {
    base: vec3<u32>,
    t: vec3<f32>,
}

fn cell_of(sample: u32, cells: vec3<u32>) -> Cell {
    let p = vec3(positions[3u * sample], positions[3u * sample + 1u], positions[3u * sample + 2u]);
    let at = clamp(p * vec3<f32>(cells), vec3(0.0), vec3<f32>(cells));
    let base = min(vec3<u32>(at), cells - 1u);
    return Cell(base, at - vec3<f32>(base));
}

// Where the features of a corner begin in the table.
fn entry(level: Level, cell: Cell, corner: u32) -> u32 {
    let c = cell.base + vec3(corner & 1u, (corner >> 1u) & 1u, corner >> 2u);
    let dense = (c.z * (level.cells.y + 1u) + c.y) * (level.cells.x + 1u) + c.x;
    let hashed = (c.x ^ (c.y * 2654435761u) ^ (c.z * 805459861u)) & (level.entries - 1u);
    return level.offset + select(hashed, dense, level.dense == 1u) * sizes.features;
}

// A sample's cell in a level, and where the level's features begin in the sample's row.
struct Place {
    level: Level,
    cell: Cell,
    row: u32,
}

fn place_of(sample: u32, l: u32) -> Place {
    let level = levels[l];
    return Place(level, cell_of(sample, level.cells), sample * sizes.stride + sizes.first + l * sizes.features);
}

// What a thread works on: the features `first..last` of a sample's level.
struct Part {
    sample: u32,
    l: u32,
    first: u32,
    last: u32,
}

fn part_of(thread: u32) -> Part {
    let parts = (sizes.features + PART - 1u) / PART;
    let first = thread % parts * PART;
    let l = thread / parts % sizes.levels;
    return Part(thread / parts / sizes.levels, l, first, min(first + PART, sizes.features));
}

fn weight(cell: Cell, corner: u32) -> f32 {
    let upper = vec3((corner & 1u) == 1u, ((corner >> 1u) & 1u) == 1u, (corner >> 2u) == 1u);
    let w = select(1.0 - cell.t, cell.t, upper);
    return w.x * w.y * w.z;
}

@compute @workgroup_size(64)
fn forward(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let part = part_of(id.y * groups.x * 64u + id.x);
    if part.sample >= sizes.samples {
        return;
    }
    let at = place_of(part.sample, part.l);
    var sums = array<f32, PART>();
    for (var c = 0u; c < 8u && part.l < sizes.active_levels; c += 1u) {
        let w = weight(at.cell, c);
        let from_entry = entry(at.level, at.cell, c);
        for (var f = part.first; f < part.last; f += 1u) {
            sums[f - part.first] += w * table[from_entry + f];
        }
    }
    for (var f = part.first; f < part.last; f += 1u) {
        features[at.row + f] = sums[f - part.first];
    }
    if part.l == 0u && part.first == 0u && sizes.first == 3u {
        for (var d = 0u; d < 3u; d += 1u) {
            features[part.sample * sizes.stride + d] = 2.0 * positions[3u * part.sample + d] - 1.0;
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

// What the columns before the encoding have of a derivative by the position: all of it, where they are the position.
fn own_column(sample: u32, d: u32) -> f32 {
    return select(0.0, features[sample * sizes.stride + d], sizes.first == 3u);
}

// The positions of the unit cube are half as long as those in -1..1.
@compute @workgroup_size(64)
fn normals_of(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let sample = id.y * groups.x * 64u + id.x;
    if sample >= sizes.samples {
        return;
    }
    var n = vec3(0.0);
    for (var l = 0u; l < sizes.active_levels; l += 1u) {
        let at = place_of(sample, l);
        for (var c = 0u; c < 8u; c += 1u) {
            let from_entry = entry(at.level, at.cell, c);
            var dot_g = 0.0;
            for (var f = 0u; f < sizes.features; f += 1u) {
                dot_g += features[at.row + f] * table[from_entry + f];
            }
            n += 0.5 * vec3<f32>(at.level.cells) * dot_g * weight_gradient(at.cell, c);
        }
    }
    for (var d = 0u; d < 3u; d += 1u) {
        let before = select(0.0, normals[3u * sample + d], sizes.adds == 1u);
        normals[3u * sample + d] = before + own_column(sample, d) + n[d];
    }
}

// sum_d v_d d/dt dw_c/dt_d: trilinear weights have no pure second derivatives.
fn weight_second(cell: Cell, corner: u32, v: vec3<f32>) -> vec3<f32> {
    let upper = vec3((corner & 1u) == 1u, ((corner >> 1u) & 1u) == 1u, (corner >> 2u) == 1u);
    let w = select(1.0 - cell.t, cell.t, upper);
    let sign = select(vec3(-1.0), vec3(1.0), upper);
    let along = sign * v;
    return sign * vec3(along.y * w.z + w.y * along.z, along.x * w.z + w.x * along.z, along.x * w.y + w.x * along.y);
}

// What a loss asks of the positions, through the features and through the normals.
@compute @workgroup_size(64)
fn position_gradient(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let sample = id.y * groups.x * 64u + id.x;
    if sample >= sizes.samples {
        return;
    }
    let d_n = normal_of(sample);
    var sum = vec3(0.0);
    for (var l = 0u; l < sizes.active_levels; l += 1u) {
        let at = place_of(sample, l);
        let scale = 0.5 * vec3<f32>(at.level.cells);
        for (var c = 0u; c < 8u; c += 1u) {
            let from_entry = entry(at.level, at.cell, c);
            var dot_d = 0.0;
            var dot_g = 0.0;
            for (var f = 0u; f < sizes.features; f += 1u) {
                let theta = table[from_entry + f];
                dot_d += features[at.row + f] * theta;
                dot_g += gradient[at.row + f] * theta;
            }
            sum += scale * (dot_d * weight_gradient(at.cell, c) + dot_g * weight_second(at.cell, c, scale * d_n));
        }
    }
    for (var d = 0u; d < 3u; d += 1u) {
        d_positions[3u * sample + d] = own_column(sample, d) + sum[d];
    }
}

// dg = J dn.
@compute @workgroup_size(64)
fn tangent(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let part = part_of(id.y * groups.x * 64u + id.x);
    if part.sample >= sizes.samples {
        return;
    }
    let at = place_of(part.sample, part.l);
    let d_n = normal_of(part.sample);
    var sums = array<f32, PART>();
    for (var c = 0u; c < 8u && part.l < sizes.active_levels; c += 1u) {
        let w = dot(0.5 * vec3<f32>(at.level.cells) * weight_gradient(at.cell, c), d_n);
        let from_entry = entry(at.level, at.cell, c);
        for (var f = part.first; f < part.last; f += 1u) {
            sums[f - part.first] += w * table[from_entry + f];
        }
    }
    for (var f = part.first; f < part.last; f += 1u) {
        features[at.row + f] = sums[f - part.first];
    }
    if part.l == 0u && part.first == 0u {
        for (var d = 0u; d < 3u; d += 1u) {
            features[part.sample * sizes.stride + d] = d_n[d];
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
    let part = part_of(id.y * groups.x * 64u + id.x);
    if part.sample >= sizes.samples || part.l >= sizes.active_levels {
        return;
    }
    let at = place_of(part.sample, part.l);
    for (var c = 0u; c < 8u; c += 1u) {
        let w = weight(at.cell, c);
        let to = entry(at.level, at.cell, c);
        for (var f = part.first; f < part.last; f += 1u) {
            add(to + f, w * features[at.row + f]);
        }
    }
}

// With the part that a loss on normals asks for.
@compute @workgroup_size(64)
fn scatter_both(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let part = part_of(id.y * groups.x * 64u + id.x);
    if part.sample >= sizes.samples || part.l >= sizes.active_levels {
        return;
    }
    let at = place_of(part.sample, part.l);
    let d_n = normal_of(part.sample);
    for (var c = 0u; c < 8u; c += 1u) {
        let w = weight(at.cell, c);
        let w_n = dot(0.5 * vec3<f32>(at.level.cells) * weight_gradient(at.cell, c), d_n);
        let to = entry(at.level, at.cell, c);
        for (var f = part.first; f < part.last; f += 1u) {
            add(to + f, w * features[at.row + f] + w_n * gradient[at.row + f]);
        }
    }
}
