// What the losses ask of rays, from what they ask of the samples: a sample's distance t stays, and its point o + t d moves
// with the ray. Twins: `RayGradient::add_point` and the methods' `ray_gradients`. A workgroup for each ray.

struct Sizes {
    rays: u32,
    // Of what the positions are coordinates: 0 the scene, 1 contracted space, whose cube is -2..2, 2 what is outside the ball, as
    // (p / |p|, 1 / |p|). How fast they grow with those.
    space: u32,
    scale_x: f32,
    scale_y: f32,
    scale_z: f32,
    // Of `d_color`: row length; 1 where the position comes first; first column of the encoded direction, and how many columns
    // it has; 1 where they are harmonics, 0 where they are frequencies.
    stride: u32,
    with_position: u32,
    first: u32,
    directions: u32,
    harmonics: u32,
    // Where the rays' sums begin.
    to: u32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// [rays + 1]
@group(0) @binding(2) var<storage, read> starts: array<u32>;
// [samples]: distance and length.
@group(0) @binding(3) var<storage, read> steps: array<vec2<f32>>;
// [samples, 3], or 4 outside the ball: derivatives by the position.
@group(0) @binding(4) var<storage, read> d_positions: array<f32>;
// [samples, stride]: derivatives by what the colour network takes.
@group(0) @binding(5) var<storage, read> d_color: array<f32>;
// [rays, 2]: derivatives by origin and direction, to which this adds.
@group(0) @binding(6) var<storage, read_write> sums: array<vec4<f32>>;

// J^T g of the contraction.
fn contract_gradient(p: vec3<f32>, g: vec3<f32>) -> vec3<f32> {
    let a = abs(p);
    let norm = max(a.x, max(a.y, a.z));
    if norm <= 1.0 {
        return g;
    }
    var widest = vec3(0.0, 0.0, 1.0);
    if a.z < norm {
        widest = select(vec3(1.0, 0.0, 0.0), vec3(0.0, 1.0, 0.0), a.y == norm);
    }
    // p (2 / m - 1 / m^2) with m = |p_widest|.
    let slope = (2.0 / norm - 2.0) / (norm * norm);
    return (2.0 - 1.0 / norm) / norm * g + slope * dot(g, p) * sign(p) * widest;
}

// J^T g of p -> (p / m, 1 / m), m = max(|p|, 1).
fn invert_gradient(p: vec3<f32>, g: vec4<f32>) -> vec3<f32> {
    let m = length(p);
    if m <= 1.0 {
        return g.xyz;
    }
    let along = dot(p, g.xyz) / (m * m);
    return (g.xyz - along * p) / m - g.w / (m * m * m) * p;
}

// The derivative by the scene's point.
fn scene_gradient(i: u32, p: vec3<f32>) -> vec3<f32> {
    let at = select(3u, 4u, sizes.space == 2u) * i;
    var g = vec3(d_positions[at], d_positions[at + 1u], d_positions[at + 2u]);
    g *= vec3(sizes.scale_x, sizes.scale_y, sizes.scale_z);
    if sizes.space == 1u {
        g = contract_gradient(p, g);
    }
    if sizes.space == 2u {
        g = invert_gradient(p, vec4(g, d_positions[at + 3u]));
    }
    if sizes.with_position == 1u {
        let row = sizes.stride * i;
        g += vec3(d_color[row], d_color[row + 1u], d_color[row + 2u]);
    }
    return g;
}

// x less whole turns, as in frequencies.wgsl.
fn turned(x: f32) -> f32 {
    let turns = round(x * 0.15915494);
    return (x - turns * 6.28125) - turns * 0.0019353072;
}

// The gradient of number c of the frequencies of a direction.
fn frequency_gradient(c: u32, d: vec3<f32>) -> vec3<f32> {
    let axis = c % 3u;
    let part = c / 3u;
    var slope = 1.0;
    if part > 0u {
        let octave = f32(1u << ((part - 1u) / 2u));
        let angle = turned(octave * d[axis]);
        slope = octave * select(-sin(angle), cos(angle), part % 2u == 1u);
    }
    return select(vec3(0.0), vec3(slope), vec3(axis) == vec3(0u, 1u, 2u));
}

// The gradient of one of the sixteen spherical harmonics, see `spherical_harmonics`.
fn harmonic_gradient(c: u32, d: vec3<f32>) -> vec3<f32> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let edge = 3.0 * 0.5900436 * (y * y - x * x);
    let side = 0.4570458 * (1.0 - 5.0 * z * z);
    switch c {
        case 1u: { return vec3(0.0, -0.4886025, 0.0); }
        case 2u: { return vec3(0.0, 0.0, 0.4886025); }
        case 3u: { return vec3(-0.4886025, 0.0, 0.0); }
        case 4u: { return 1.0925484 * vec3(y, x, 0.0); }
        case 5u: { return -1.0925484 * vec3(0.0, z, y); }
        case 6u: { return vec3(0.0, 0.0, 2.0 * 0.9461747 * z); }
        case 7u: { return -1.0925484 * vec3(z, 0.0, x); }
        case 8u: { return 2.0 * 0.5462742 * vec3(x, -y, 0.0); }
        case 9u: { return vec3(-6.0 * 0.5900436 * x * y, edge, 0.0); }
        case 10u: { return 2.8906114 * vec3(y * z, x * z, x * y); }
        case 11u: { return vec3(0.0, side, -10.0 * 0.4570458 * y * z); }
        case 12u: { return vec3(0.0, 0.0, 0.37317633 * (15.0 * z * z - 3.0)); }
        case 13u: { return vec3(side, 0.0, -10.0 * 0.4570458 * x * z); }
        case 14u: { return 1.4453057 * vec3(2.0 * x * z, -2.0 * y * z, x * x - y * y); }
        case 15u: { return vec3(edge, 6.0 * 0.5900436 * x * y, 0.0); }
        default: { return vec3(0.0); }
    }
}

var<workgroup> by_origin: array<vec3<f32>, 64>;
var<workgroup> by_direction: array<vec3<f32>, 64>;

@compute @workgroup_size(64)
fn add(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let ray = group.y * groups.x + group.x;
    if ray >= sizes.rays {
        return;
    }
    let at = ray * 20u;
    let origin = vec3(rays[at], rays[at + 1u], rays[at + 2u]);
    let direction = vec3(rays[at + 3u], rays[at + 4u], rays[at + 5u]);
    let first = starts[ray];
    let last = starts[ray + 1u];
    var d_origin = vec3(0.0);
    var d_direction = vec3(0.0);
    for (var i = first + thread; i < last; i += 64u) {
        let t = steps[i].x;
        let g = scene_gradient(i, origin + t * direction);
        d_origin += g;
        d_direction += t * g;
    }
    // The encoding of the direction is that of all samples: its columns are added up first.
    for (var c = thread; c < sizes.directions; c += 64u) {
        var sum = 0.0;
        for (var i = first; i < last; i += 1u) {
            sum += d_color[sizes.stride * i + sizes.first + c];
        }
        if sizes.harmonics == 1u {
            d_direction += sum * harmonic_gradient(c, direction);
        } else {
            d_direction += sum * frequency_gradient(c, direction);
        }
    }
    by_origin[thread] = d_origin;
    by_direction[thread] = d_direction;
    workgroupBarrier();
    for (var half = 32u; half > 0u; half /= 2u) {
        if thread < half {
            by_origin[thread] += by_origin[thread + half];
            by_direction[thread] += by_direction[thread + half];
        }
        workgroupBarrier();
    }
    if thread == 0u {
        sums[sizes.to + 2u * ray] += vec4(by_origin[0], 0.0);
        sums[sizes.to + 2u * ray + 1u] += vec4(by_direction[0], 0.0);
    }
}
