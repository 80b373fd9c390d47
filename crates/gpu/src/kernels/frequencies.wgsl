// The frequency encoding, gamma(x) = (x, sin(2^k x), cos(2^k x), ...), and its derivatives. Twin: `Frequencies`. One thread for
// each sample and coordinate.

struct Sizes {
    samples: u32,
    // Of a position; directions, tangents and second derivatives have three.
    coordinates: u32,
    octaves: u32,
    // Row length, and the encoding's first column.
    stride: u32,
    first: u32,
    // Of positions: what is encoded is `scale x + shift`.
    scale: f32,
    shift: f32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// [samples]
@group(0) @binding(2) var<storage, read> ray_of: array<u32>;
// [samples, coordinates]
@group(0) @binding(3) var<storage, read> positions: array<f32>;
// [samples, stride]
@group(0) @binding(4) var<storage, read_write> encoded: array<f32>;
// [samples, stride]: `tangent` writes the tangent, the others read derivatives by the encoding.
@group(0) @binding(5) var<storage, read_write> gradient: array<f32>;
// [samples, coordinates]: `normals_of` writes them, `tangent` reads the vectors, `position_gradient` the normals' derivatives.
@group(0) @binding(6) var<storage, read_write> normals: array<f32>;
// [samples, stride]: g, of which J^T g are the normals.
@group(0) @binding(7) var<storage, read> g: array<f32>;
// [samples, 3]
@group(0) @binding(8) var<storage, read_write> d_positions: array<f32>;

// x less whole turns. A device's own sine may lose all digits far from zero; the first part of a turn has few enough of them
// for its multiples to be exact.
fn turned(x: f32) -> f32 {
    let turns = round(x * 0.15915494);
    return (x - turns * 6.28125) - turns * 0.0019353072;
}

fn write(sample: u32, d: u32, coordinates: u32, x: f32) {
    let row = sample * sizes.stride + sizes.first + d;
    encoded[row] = x;
    for (var k = 0u; k < sizes.octaves; k += 1u) {
        let angle = turned(x * f32(1u << k));
        encoded[row + coordinates * (2u * k + 1u)] = sin(angle);
        encoded[row + coordinates * (2u * k + 2u)] = cos(angle);
    }
}

@compute @workgroup_size(64)
fn of_positions(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread < sizes.samples * sizes.coordinates {
        let x = sizes.scale * positions[thread] + sizes.shift;
        write(thread / sizes.coordinates, thread % sizes.coordinates, sizes.coordinates, x);
    }
}

@compute @workgroup_size(64)
fn of_directions(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread < sizes.samples * 3u {
        let sample = thread / 3u;
        write(sample, thread % 3u, 3u, rays[ray_of[sample] * 20u + 3u + thread % 3u]);
    }
}

// A number of J^T g, with g in `gradient`.
fn transposed(row: u32) -> f32 {
    var sum = gradient[row];
    for (var k = 0u; k < sizes.octaves; k += 1u) {
        let sine = row + sizes.coordinates * (2u * k + 1u);
        let cosine = sine + sizes.coordinates;
        sum += f32(1u << k) * (gradient[sine] * encoded[cosine] - gradient[cosine] * encoded[sine]);
    }
    return sum;
}

@compute @workgroup_size(64)
fn normals_of(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread < sizes.samples * sizes.coordinates {
        let row = thread / sizes.coordinates * sizes.stride + sizes.first;
        normals[thread] = transposed(row + thread % sizes.coordinates);
    }
}

// What a loss asks of the positions, through the encoding and through the normals.
@compute @workgroup_size(64)
fn position_gradient(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread < sizes.samples * 3u {
        let row = thread / 3u * sizes.stride + sizes.first + thread % 3u;
        var second = 0.0;
        for (var k = 0u; k < sizes.octaves; k += 1u) {
            let sine = row + 3u * (2u * k + 1u);
            let cosine = sine + 3u;
            second += f32(1u << (2u * k)) * (g[sine] * encoded[sine] + g[cosine] * encoded[cosine]);
        }
        d_positions[thread] = transposed(row) - normals[thread] * second;
    }
}

// J v.
@compute @workgroup_size(64)
fn tangent(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    if thread < sizes.samples * 3u {
        let row = thread / 3u * sizes.stride + sizes.first + thread % 3u;
        let v = normals[thread];
        gradient[row] = v;
        for (var k = 0u; k < sizes.octaves; k += 1u) {
            let sine = row + 3u * (2u * k + 1u);
            let cosine = sine + 3u;
            gradient[sine] = f32(1u << k) * v * encoded[cosine];
            gradient[cosine] = -f32(1u << k) * v * encoded[sine];
        }
    }
}
