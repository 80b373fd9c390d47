// Where the original NeuS samples a ray: even starts of sections, rounds that add where the surface seems to be, and sections
// behind the ball. Twins: `NeusOriginal::depths`, `round_weights`, `importance` and `NeusOriginal::place`.
// One thread for each ray, but for `points` and `first`: one for each number.

struct Sizes {
    rays: u32,
    // Starts of a ray before the round, and those that it adds. `count` and `place`: inside and outside.
    starts: u32,
    more: u32,
    // `draw`: sharpness of the round.
    sharpness: f32,
    // `first` and `merge`: row length of the geometry network's output, whose first number is the distance.
    stride: u32,
    // `count` and `place`: 1 where there is no background; length of the last section.
    with_masks: u32,
    last: f32,
    // Reach of the eikonal loss.
    relaxed: f32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// [rays, starts]: distance along the ray; distance from the surface.
@group(0) @binding(2) var<storage, read> depths: array<f32>;
@group(0) @binding(3) var<storage, read_write> sdf: array<f32>;
// [rays, starts - 1]: work space.
@group(0) @binding(4) var<storage, read_write> weights: array<f32>;
// [rays, more]: what a round adds. Of `count` and `place`: starts outside.
@group(0) @binding(5) var<storage, read_write> added: array<f32>;
// [rays * starts or rays * more, stride]
@group(0) @binding(6) var<storage, read> geometry: array<f32>;
// [rays, starts + more]
@group(0) @binding(7) var<storage, read_write> merged: array<f32>;
@group(0) @binding(8) var<storage, read_write> merged_sdf: array<f32>;
// `points` writes [rays * starts, 3]; `place` writes the samples inside.
@group(0) @binding(9) var<storage, read_write> positions: array<f32>;
// `count` writes [rays]: sections inside and outside, and those within reach of the eikonal loss. `place` reads [rays + 1]:
// where those inside and outside begin.
@group(0) @binding(10) var<storage, read_write> places: array<vec4<u32>>;
// Samples: distance and length, negative where a section is shown by the background; the ray. Outside, positions have four
// coordinates: a unit direction and an inverse distance.
@group(0) @binding(11) var<storage, read_write> inner_steps: array<vec2<f32>>;
@group(0) @binding(12) var<storage, read_write> inner_ray_of: array<u32>;
@group(0) @binding(13) var<storage, read_write> outer_positions: array<vec4<f32>>;
@group(0) @binding(14) var<storage, read_write> outer_steps: array<vec2<f32>>;
@group(0) @binding(15) var<storage, read_write> outer_ray_of: array<u32>;

fn point(ray: u32, t: f32) -> vec3<f32> {
    let at = ray * 20u;
    return vec3(rays[at], rays[at + 1u], rays[at + 2u]) + t * vec3(rays[at + 3u], rays[at + 4u], rays[at + 5u]);
}

// Positions of `depths`.
@compute @workgroup_size(64)
fn points(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.rays * sizes.starts {
        let p = point(i / sizes.starts, depths[i]);
        positions[3u * i] = p.x;
        positions[3u * i + 1u] = p.y;
        positions[3u * i + 2u] = p.z;
    }
}

// The distances of the even starts.
@compute @workgroup_size(64)
fn first(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = id.y * groups.x * 64u + id.x;
    if i < sizes.rays * sizes.starts {
        sdf[i] = geometry[sizes.stride * i];
    }
}

fn logistic(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-clamp(x, -80.0, 80.0)));
}

fn is_inside(ray: u32, t: f32) -> bool {
    let p = point(ray, t);
    return dot(p, p) < 1.0;
}

@compute @workgroup_size(64)
fn draw(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let at = ray * sizes.starts;
    let intervals = sizes.starts - 1u;
    let to = ray * intervals;
    var light = 1.0;
    var before = 0.0;
    var total = 0.0;
    for (var i = 0u; i < intervals; i += 1u) {
        let t = depths[at + i];
        let dt = depths[at + i + 1u] - t;
        var slope = (sdf[at + i + 1u] - sdf[at + i]) / (dt + 1e-5);
        let steeper = clamp(min(slope, before), -1e3, 0.0);
        before = slope;
        slope = select(0.0, steeper, is_inside(ray, t) || is_inside(ray, depths[at + i + 1u]));
        let middle = 0.5 * (sdf[at + i] + sdf[at + i + 1u]);
        let p = logistic(sizes.sharpness * (middle - 0.5 * slope * dt));
        let q = logistic(sizes.sharpness * (middle + 0.5 * slope * dt));
        let alpha = (p - q + 1e-5) / (p + 1e-5);
        weights[to + i] = light * alpha + 1e-5;
        total += light * alpha + 1e-5;
        light *= 1.0 - alpha + 1e-7;
    }
    var k = 0u;
    var share = 0.0;
    var mass = weights[to] / total;
    for (var i = 0u; i < sizes.more; i += 1u) {
        let u = (f32(i) + 0.5) / f32(sizes.more);
        while u > share + mass && k + 1u < intervals {
            share += mass;
            k += 1u;
            mass = weights[to + k] / total;
        }
        let low = depths[at + k];
        added[ray * sizes.more + i] = low + clamp((u - share) / mass, 0.0, 1.0) * (depths[at + k + 1u] - low);
    }
}

// Both sequences ascend.
@compute @workgroup_size(64)
fn merge(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let at = ray * sizes.starts;
    var next = ray * (sizes.starts + sizes.more);
    var i = 0u;
    for (var k = 0u; k < sizes.more; k += 1u) {
        let more = ray * sizes.more + k;
        let t = added[more];
        while i < sizes.starts && depths[at + i] <= t {
            merged[next] = depths[at + i];
            merged_sdf[next] = sdf[at + i];
            i += 1u;
            next += 1u;
        }
        merged[next] = t;
        merged_sdf[next] = geometry[sizes.stride * more];
        next += 1u;
    }
    for (; i < sizes.starts; i += 1u) {
        merged[next] = depths[at + i];
        merged_sdf[next] = sdf[at + i];
        next += 1u;
    }
}

// Start of a section.
fn start(ray: u32, i: u32) -> f32 {
    if i < sizes.starts {
        return depths[ray * sizes.starts + i];
    }
    return added[ray * sizes.more + i - sizes.starts];
}

struct Section {
    p: vec3<f32>,
    t: f32,
    dt: f32,
    norm: f32,
    // Whether the surface is asked for it, and whether it shows it.
    inner: bool,
    shown: bool,
}

fn section(ray: u32, i: u32) -> Section {
    let begin = start(ray, i);
    var dt = sizes.last;
    if i + 1u < sizes.starts + sizes.more {
        dt = start(ray, i + 1u) - begin;
    }
    let t = begin + 0.5 * dt;
    let p = point(ray, t);
    let norm = length(p);
    let with_masks = sizes.with_masks == 1u;
    let inner = i < sizes.starts && (with_masks || norm < sizes.relaxed);
    return Section(p, t, dt, norm, inner, i < sizes.starts && (with_masks || norm < 1.0));
}

@compute @workgroup_size(64)
fn count(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    var sums = vec4(0u);
    for (var i = 0u; i < sizes.starts + sizes.more; i += 1u) {
        let s = section(ray, i);
        sums += vec4(select(0u, 1u, s.inner), select(1u, 0u, s.shown), select(0u, 1u, s.inner && s.norm < sizes.relaxed), 0u);
    }
    places[ray] = sums;
}

@compute @workgroup_size(64)
fn place(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    var inner = places[ray].x;
    var outer = places[ray].y;
    let last = places[ray + 1u];
    for (var i = 0u; i < sizes.starts + sizes.more; i += 1u) {
        let s = section(ray, i);
        if s.inner && inner < last.x {
            positions[3u * inner] = s.p.x;
            positions[3u * inner + 1u] = s.p.y;
            positions[3u * inner + 2u] = s.p.z;
            inner_steps[inner] = vec2(s.t, select(-max(s.dt, 1e-9), s.dt, s.shown));
            inner_ray_of[inner] = ray;
            inner += 1u;
        }
        if !s.shown && outer < last.y {
            let m = max(s.norm, 1.0);
            outer_positions[outer] = vec4(s.p / m, 1.0 / m);
            outer_steps[outer] = vec2(s.t, s.dt);
            outer_ray_of[outer] = ray;
            outer += 1u;
        }
    }
}
