// What comes before each of a workgroup's 64 threads. Other files of this folder are read with this one before them.

// Two lines, of which a scan reads one and writes the other.
var<workgroup> line: array<vec2<f32>, 128>;

// What comes before a thread's own, and all together.
struct Scan {
    before: vec2<f32>,
    all: vec2<f32>,
}

// Sums, or products, of what the threads give; `place` says where in the line a thread stands.
fn scan(place: u32, own: vec2<f32>, multiply: bool) -> Scan {
    line[place] = own;
    workgroupBarrier();
    var half = 0u;
    for (var reach = 1u; reach < 64u; reach *= 2u) {
        var found = line[half + place];
        if place >= reach {
            let other = line[half + place - reach];
            found = select(found + other, found * other, multiply);
        }
        half = 64u - half;
        line[half + place] = found;
        workgroupBarrier();
    }
    let nothing = select(vec2(0.0), vec2(1.0), multiply);
    let found = Scan(select(nothing, line[half + max(place, 1u) - 1u], place > 0u), line[half + 63u]);
    workgroupBarrier();
    return found;
}

fn sums(place: u32, own: vec2<f32>) -> Scan {
    return scan(place, own, false);
}

fn products(place: u32, own: f32) -> Scan {
    return scan(place, vec2(own), true);
}
