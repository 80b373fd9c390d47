// Samples at given distances of rays, and further ones where those weigh most. Twins: `NerfOriginal::place`, `importance`. One
// thread for each ray.

struct Sizes {
    rays: u32,
    // Samples of a ray: coarse ones, and those that are drawn from their weights.
    coarse: u32,
    fine: u32,
    // 1 where the networks see positions as they are, 0 where they see contracted ones.
    inside_ball: u32,
}

var<immediate> sizes: Sizes;
// [rays, 20], see march.wgsl; the ball ends where the last sample does.
@group(0) @binding(1) var<storage, read> rays: array<f32>;
// `place`: [rays, coarse], ascending distances. `draw`: [rays, fine], random numbers in 0..1.
@group(0) @binding(2) var<storage, read> numbers: array<f32>;
// `draw`: [rays, coarse], distance and length, and their weights.
@group(0) @binding(3) var<storage, read> coarse_steps: array<vec2<f32>>;
@group(0) @binding(4) var<storage, read> weights: array<f32>;
// [samples, 3]: what the networks see. [samples]: distance and length; the ray.
@group(0) @binding(5) var<storage, read_write> positions: array<f32>;
@group(0) @binding(6) var<storage, read_write> steps: array<vec2<f32>>;
@group(0) @binding(7) var<storage, read_write> ray_of: array<u32>;

fn contract(p: vec3<f32>) -> vec3<f32> {
    let norm = max(abs(p.x), max(abs(p.y), abs(p.z)));
    return p * select((2.0 - 1.0 / norm) / norm, 1.0, norm <= 1.0);
}

// From distances in `steps`: lengths, positions and rays of the samples of a ray.
fn finish(ray: u32, first: u32, last: u32) {
    let at = ray * 20u;
    let origin = vec3(rays[at], rays[at + 1u], rays[at + 2u]);
    let direction = vec3(rays[at + 3u], rays[at + 4u], rays[at + 5u]);
    var end = rays[at + 15u];
    for (var i = last; i > first; i -= 1u) {
        let k = i - 1u;
        let t = steps[k].x;
        steps[k].y = max(end - t, 0.0);
        end = t;
        var p = origin + t * direction;
        if sizes.inside_ball == 0u {
            p = contract(p);
        }
        positions[3u * k] = p.x;
        positions[3u * k + 1u] = p.y;
        positions[3u * k + 2u] = p.z;
        ray_of[k] = ray;
    }
}

@compute @workgroup_size(64)
fn place(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    let first = ray * sizes.coarse;
    for (var i = first; i < first + sizes.coarse; i += 1u) {
        steps[i].x = numbers[i];
    }
    finish(ray, first, first + sizes.coarse);
}

// The middle between a coarse sample and the next.
fn middle(i: u32) -> f32 {
    return 0.5 * (coarse_steps[i].x + coarse_steps[i + 1u].x);
}

@compute @workgroup_size(64)
fn draw(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let ray = id.y * groups.x * 64u + id.x;
    if ray >= sizes.rays {
        return;
    }
    // Interval k lies between the middles k and k + 1, around coarse sample k + 1; the two samples at the ends have none.
    let from_coarse = ray * sizes.coarse;
    let intervals = sizes.coarse - 2u;
    var total = 0.0;
    for (var k = 0u; k < intervals; k += 1u) {
        total += weights[from_coarse + k + 1u] + 1e-5;
    }
    let first = ray * (sizes.coarse + sizes.fine);
    var next = first;
    var coarse = 0u;
    var k = 0u;
    var before = 0.0;
    var mass = (weights[from_coarse + 1u] + 1e-5) / total;
    for (var i = 0u; i < sizes.fine; i += 1u) {
        let u = (f32(i) + numbers[ray * sizes.fine + i]) / f32(sizes.fine);
        while u > before + mass && k + 1u < intervals {
            before += mass;
            k += 1u;
            mass = (weights[from_coarse + k + 1u] + 1e-5) / total;
        }
        let low = middle(from_coarse + k);
        let t = low + clamp((u - before) / mass, 0.0, 1.0) * (middle(from_coarse + k + 1u) - low);
        // Both sequences ascend.
        while coarse < sizes.coarse && coarse_steps[from_coarse + coarse].x <= t {
            steps[next].x = coarse_steps[from_coarse + coarse].x;
            coarse += 1u;
            next += 1u;
        }
        steps[next].x = t;
        next += 1u;
    }
    for (; coarse < sizes.coarse; coarse += 1u) {
        steps[next].x = coarse_steps[from_coarse + coarse].x;
        next += 1u;
    }
    finish(ray, first, next);
}
