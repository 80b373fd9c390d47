// What lies between the two networks of a radiance field, of a field of distance and of a field of frequencies. Twins:
// `RadianceField`, `SdfField` and `FrequencyField`.

struct Sizes {
    samples: u32,
    // Cells a side of the occupancy grid.
    resolution: u32,
    // Of a distance field: samples that have a colour. Of both others: the features that a colour gets, and row lengths of the
    // geometry network's output, of its input and of the colour network's input.
    colored: u32,
    features: u32,
    geometry_stride: u32,
    encoded_stride: u32,
    color_stride: u32,
    // Of a distance field: columns of the encoded direction, and 1 where they are harmonics, else the host writes them.
    directions: u32,
    harmonics: u32,
    // Of a field of frequencies, as composite.wgsl numbers it: the density is 1 max(o, 0), 2 ln(1 + exp(o)).
    activation: u32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
@group(0) @binding(2) var<storage, read> ray_of: array<u32>;
// [samples, 3]
@group(0) @binding(3) var<storage, read> positions: array<f32>;
// [samples, 16]: what the density network gives; `join` writes its derivative. Of a distance field: [samples, geometry_stride].
@group(0) @binding(4) var<storage, read_write> geometry: array<f32>;
// [samples, 32]: what the colour network takes; `join` reads its derivative. Of a distance field: [colored, color_stride].
@group(0) @binding(5) var<storage, read_write> color_in: array<f32>;
// [samples]: density; `join` reads the derivative of output 0.
@group(0) @binding(6) var<storage, read_write> sigma: array<f32>;
// [cells]: bits of the largest density that a step found in each cell of the occupancy grid.
@group(0) @binding(7) var<storage, read_write> seen: array<atomic<u32>>;
// [samples, encoded_stride]: what the geometry network takes, the position in -1..1 first.
@group(0) @binding(8) var<storage, read> encoded: array<f32>;
// [samples, 3]: normals; `join_sdf` adds what the colour network asks of them.
@group(0) @binding(9) var<storage, read_write> normals: array<f32>;

@compute @workgroup_size(64)
fn density(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.samples {
        sigma[i] = exp(clamp(geometry[16u * i] - 1.0, -15.0, 15.0));
    }
}

@compute @workgroup_size(64)
fn note(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.samples {
        let r = sizes.resolution;
        let u = vec3(positions[3u * i], positions[3u * i + 1u], positions[3u * i + 2u]);
        let c = min(vec3<u32>(max(u * f32(r), vec3(0.0))), vec3(r - 1u));
        // Positive numbers are ordered as their bits are.
        atomicMax(&seen[(c.z * r + c.y) * r + c.x], bitcast<u32>(sigma[i]));
    }
}

// Real spherical harmonics of degree 0 to 3 of a sample's direction: four of sixteen, see `spherical_harmonics`.
fn harmonics(i: u32, part: u32) -> vec4<f32> {
    let at = ray_of[i] * 20u + 3u;
    let x = rays[at];
    let y = rays[at + 1u];
    let z = rays[at + 2u];
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    switch part {
        case 0u: {
            return vec4(0.2820948, -0.4886025 * y, 0.4886025 * z, -0.4886025 * x);
        }
        case 1u: {
            return vec4(1.0925484 * x * y, -1.0925484 * y * z, 0.9461747 * zz - 0.31539157, -1.0925484 * x * z);
        }
        case 2u: {
            let edge = 0.5900436 * y * (yy - 3.0 * xx);
            return vec4(0.5462742 * (xx - yy), edge, 2.8906114 * x * y * z, 0.4570458 * y * (1.0 - 5.0 * zz));
        }
        default: {
            let middle = 0.37317633 * z * (5.0 * zz - 3.0);
            let side = 0.4570458 * x * (1.0 - 5.0 * zz);
            return vec4(middle, side, 1.4453057 * z * (xx - yy), 0.5900436 * x * (3.0 * yy - xx));
        }
    }
}

// Eight threads for each sample, which write four numbers each: the density network's output, and the harmonics.
@compute @workgroup_size(64)
fn split(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    let i = thread / 8u;
    let part = thread % 8u;
    if i >= sizes.samples {
        return;
    }
    var four = vec4(0.0);
    if part < 4u {
        let at = 16u * i + 4u * part;
        four = vec4(geometry[at], geometry[at + 1u], geometry[at + 2u], geometry[at + 3u]);
    } else {
        four = harmonics(i, part - 4u);
    }
    for (var k = 0u; k < 4u; k += 1u) {
        color_in[4u * thread + k] = four[k];
    }
}

// One thread for each number of the density network's output.
@compute @workgroup_size(64)
fn join(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    let i = thread / 16u;
    let k = thread % 16u;
    if i < sizes.samples {
        geometry[thread] = color_in[32u * i + k] + select(0.0, sigma[i], k == 0u);
    }
}

// Position, normal, direction, features.
@compute @workgroup_size(64)
fn split_sdf(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i >= sizes.colored {
        return;
    }
    let to = sizes.color_stride * i;
    for (var d = 0u; d < 3u; d += 1u) {
        color_in[to + d] = encoded[sizes.encoded_stride * i + d];
        color_in[to + 3u + d] = normals[3u * i + d];
    }
    for (var part = 0u; part < 4u && sizes.harmonics == 1u; part += 1u) {
        let four = harmonics(i, part);
        for (var k = 0u; k < 4u; k += 1u) {
            color_in[to + 6u + 4u * part + k] = four[k];
        }
    }
    for (var k = 0u; k < sizes.features; k += 1u) {
        color_in[to + 6u + sizes.directions + k] = geometry[sizes.geometry_stride * i + 1u + k];
    }
}

// `sigma` holds the derivative of the distance.
@compute @workgroup_size(64)
fn join_sdf(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i >= sizes.samples {
        return;
    }
    let to = sizes.geometry_stride * i;
    let has_color = i < sizes.colored;
    for (var k = 0u; k < sizes.geometry_stride; k += 1u) {
        var d = 0.0;
        if has_color && k == 0u {
            d = sigma[i];
        } else if has_color && k <= sizes.features {
            d = color_in[sizes.color_stride * i + 5u + sizes.directions + k];
        }
        geometry[to + k] = d;
    }
    for (var d = 0u; d < 3u && has_color; d += 1u) {
        normals[3u * i + d] += color_in[sizes.color_stride * i + 3u + d];
    }
}

@compute @workgroup_size(64)
fn density_of_frequencies(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.samples {
        let o = geometry[sizes.geometry_stride * i];
        let e = exp(-abs(o));
        let rest = select(log(1.0 + e), e * (1.0 - e * (0.5 - e / 3.0)), e < 0.01);
        sigma[i] = max(o, 0.0) + select(0.0, rest, sizes.activation == 2u);
    }
}

// One thread for each sample and feature.
@compute @workgroup_size(64)
fn split_frequencies(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    let i = thread / sizes.features;
    let k = thread % sizes.features;
    if i < sizes.samples {
        color_in[sizes.color_stride * i + k] = geometry[sizes.geometry_stride * i + 1u + k];
    }
}

// One thread for each sample and number of its row.
@compute @workgroup_size(64)
fn join_frequencies(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let thread = id.y * groups.x * 64u + id.x;
    let i = thread / sizes.geometry_stride;
    let k = thread % sizes.geometry_stride;
    if i < sizes.samples {
        var d = 0.0;
        if k == 0u {
            d = sigma[i];
        } else if k <= sizes.features {
            d = color_in[sizes.color_stride * i + k - 1u];
        }
        geometry[thread] = d;
    }
}
