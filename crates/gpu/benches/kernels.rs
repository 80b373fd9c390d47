//! Time of each kernel on a device beside its twin on the processor:
//! `cargo bench -p mb-gpu --features wgpu --bench kernels -- [gpu|gpu:N] [SAMPLES]`. Sizes are those of `nerf`, `neus` and
//! `dvgo` with `--preset fast`, but for the published trunk.
//! Device: wall milliseconds, best of five, and CPU milliseconds of this process (which a software device spends, a GPU
//! does not, but for the handing over of work). Twin: CPU milliseconds. Share: of the arithmetic (GFLOP/s) or traffic
//! (GB/s) that the kernel needs at least.

use std::time::Instant;

use cpu_time::ProcessTime;
use mb_gpu::DeviceChoice;
use mb_gpu::context::{Buffer, Context, Work};
use mb_gpu::encoding::{Encoding, Points, unit_of};
use mb_gpu::kernels::Kernels;
use mb_gpu::network::Network;
use mb_gpu::trained::AdamStep;
use mb_neural::adam::{AdamOptions, Parameters};
use mb_neural::dense_grid::DenseGrid;
use mb_neural::dvgo::DvgoOptions;
use mb_neural::frequency_field::{FrequencyField, FrequencyFieldOptions};
use mb_neural::hash_grid::Scatter;
use mb_neural::mlp::{Mlp, MlpCache, Weights};
use mb_neural::nerf::NerfOptions;
use mb_neural::neus::NeusOptions;
use mb_neural::radiance_field::{ADAM, RadianceField};
use mb_neural::sdf_field::SdfField;
use mb_neural::voxel_field;
use rand::RngExt as _;

/// Prints one row.
struct Rows<'a> {
    context: &'a Context,
    probe: &'a Buffer,
}

impl Rows<'_> {
    /// Wall and CPU seconds of what is recorded, the best of five: recorded so often in one submission that the wait for it
    /// counts little.
    fn time(&self, record: impl Fn(&mut Work<'_>)) -> [f64; 2] {
        let run = |times: usize| {
            let (start, spent) = (Instant::now(), ProcessTime::now());
            let mut work = self.context.work();
            for _ in 0..times {
                record(&mut work);
            }
            work.submit();
            self.context.read::<u32>(self.probe, 1).expect("the device works");
            [start.elapsed().as_secs_f64(), spent.elapsed().as_secs_f64()].map(|seconds| seconds / times as f64)
        };
        run(1);
        let times = (0.02 / run(1)[0]).clamp(1.0, 64.0) as usize;
        (0..5).map(|_| run(times)).fold([f64::INFINITY; 2], |best, found| [0, 1].map(|i| best[i].min(found[i])))
    }

    /// [`Self::row`] where something has to happen `before` each run, which is not measured.
    fn row_after(
        &self,
        before: impl Fn(&mut Work<'_>),
        name: &str,
        giga: f64,
        unit: &str,
        record: impl Fn(&mut Work<'_>),
        twin: impl FnOnce(),
    ) {
        let without = self.time(&before);
        let with = self.time(|work| {
            before(work);
            record(work);
        });
        self.print(name, giga, unit, [0, 1].map(|i| with[i] - without[i]), twin);
    }

    fn row(&self, name: &str, giga: f64, unit: &str, record: impl Fn(&mut Work<'_>), twin: impl FnOnce()) {
        self.print(name, giga, unit, self.time(record), twin);
    }

    fn print(&self, name: &str, giga: f64, unit: &str, [wall, cpu]: [f64; 2], twin: impl FnOnce()) {
        let spent = ProcessTime::now();
        twin();
        let twin = spent.elapsed().as_secs_f64();
        println!("| {name} | {:.2} | {:.2} | {:.2} | {:.1} {unit}/s |", 1e3 * wall, 1e3 * cpu, 1e3 * twin, giga / wall);
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    let Some(device) = arguments.next() else {
        println!("nothing to do: give gpu or gpu:N, and perhaps the number of samples");
        return;
    };
    let DeviceChoice::Gpu(number) = device.parse().expect("gpu or gpu:N") else { panic!("gpu or gpu:N") };
    let n: usize = arguments.next().map_or(1 << 16, |n| n.parse().expect("a number of samples"));
    let context = match Context::numbered(number) {
        Ok(context) => context,
        Err(e) => {
            println!("{e}");
            return;
        }
    };
    println!("{} samples on {}\n", n, context.name);
    println!("| kernel | device ms | device CPU ms | twin CPU ms | device |\n|---|---|---|---|---|");

    let k = Kernels::new(&context);
    let probe = context.zeros(4);
    let rows = Rows { context: &context, probe: &probe };
    let field = RadianceField::new(&NerfOptions::default().field);
    let mut rng = mb_job::rng(0, 0);
    let mut p = field.init(&mut rng);
    let (grid, density, color) = field.parts();
    let filled = context.zeros(1 << 27);
    rows.row("filling half a GiB", 0.5 * 1.0737, "GB", |work| work.clear(&filled), || ());
    drop(filled);
    // Samples along rays, as marching gives them.
    let x: Vec<[f32; 3]> = (0..n.div_ceil(32))
        .flat_map(|_| {
            let from: [f32; 3] = std::array::from_fn(|_| rng.random());
            let to: [f32; 3] = std::array::from_fn(|_| rng.random());
            (0..32).map(move |i| std::array::from_fn(|d| from[d] + (to[d] - from[d]) * i as f32 / 32.0))
        })
        .take(n)
        .collect();
    let encoding = Encoding::new(&context, grid, &p.table, 0);
    let stride = encoding.stride();
    let positions = context.upload(x.as_flattened());
    let features = context.zeros(n * stride);
    let mut twin_features = vec![0.0; n * stride];
    let traffic = (n * grid.levels() * 8 * grid.options().features * 4) as f64 / 1e9;
    rows.row(
        "hash encoding",
        traffic,
        "GB",
        |work| encoding.forward(work, &k, Points { positions: &positions, count: n }, &features),
        || grid.forward(&p.table.values, &x, grid.levels(), &mut twin_features, stride, 0),
    );
    let d: Vec<f32> = (0..n * stride).map(|_| rng.random_range(-1.0..1.0)).collect();
    let d_features = context.upload(&d);
    let mut grads = vec![0.0; grid.len()];
    rows.row(
        "its scatter",
        2.0 * traffic,
        "GB",
        |work| encoding.scatter(work, &k, Points { positions: &positions, count: n }, &d_features, unit_of(1.0)),
        || {
            let batch = Scatter { positions: &x, d_features: &d, gradient: None, stride, first: 0 };
            grid.scatter(&[batch], grid.levels(), &mut grads);
        },
    );
    p.table.grads = grads;
    // It clears the gradient, and leaves alone what has none.
    rows.row_after(
        |work| encoding.scatter(work, &k, Points { positions: &positions, count: n }, &d_features, unit_of(1.0)),
        "Adam of the table",
        (grid.len() * 40) as f64 / 1e9,
        "GB",
        |work| encoding.step(work, &k, unit_of(1.0), &AdamStep { options: ADAM, lr: 1e-2, t: 1 }),
        || p.table.step(&AdamOptions { skip_untouched: true, ..ADAM }, 1e-2, 1),
    );
    network_rows(&rows, &k, n, "density network", (density, &p.density));
    network_rows(&rows, &k, n, "colour network", (color, &p.color));
    // Eight layers of 256: a hundred times the work of a sample.
    let published = FrequencyField::<3>::new(&FrequencyFieldOptions::PAPER);
    let trunk = published.init(&mut rng).trunk;
    network_rows(&rows, &k, n / 16, "trunk of the published nerf, n / 16 samples", (&published.trunk, &trunk));
    surface_rows(&rows, &k, &x);
    voxel_rows(&rows, &k, &x);
}

/// The features of the fine stage of `dvgo`.
fn voxel_rows(rows: &Rows<'_>, k: &Kernels, x: &[[f32; 3]]) {
    let (context, n) = (rows.context, x.len());
    let options = DvgoOptions::fast();
    let channels = options.network.channels;
    // An eighth of the voxels that a run has at its end: twin and device would need gigabytes.
    let side = ((options.fine.voxels / 8) as f64).cbrt().round() as usize;
    let grid = DenseGrid { size: [side; 3], channels };
    let mut rng = mb_job::rng(2, 0);
    let mut p = Parameters::new((0..grid.len()).map(|_| rng.random_range(-1.0..1.0)).collect());
    let encoding = Encoding::of_voxels(context, &grid, &p, channels);
    let (positions, features) = (context.upload(x.as_flattened()), context.zeros(n * channels));
    let mut twin_features = vec![0.0; n * channels];
    let traffic = (n * 8 * channels * 4) as f64 / 1e9;
    let points = Points { positions: &positions, count: n };
    rows.row(
        "voxels",
        traffic,
        "GB",
        |work| encoding.forward(work, k, points, &features),
        || grid.forward(&p.values, x, &mut twin_features, channels, 0),
    );
    let d: Vec<f32> = (0..n * channels).map(|_| rng.random_range(-1.0..1.0)).collect();
    let d_features = context.upload(&d);
    let mut grads = vec![0.0; grid.len()];
    rows.row(
        "their scatter",
        2.0 * traffic,
        "GB",
        |work| encoding.scatter(work, k, points, &d_features, unit_of(1.0)),
        || grid.scatter(&[(x, &d)], channels, 0, &mut grads),
    );
    p.grads = grads;
    let options = voxel_field::ADAM;
    rows.row_after(
        |work| encoding.scatter(work, k, points, &d_features, unit_of(1.0)),
        "Adam of the voxels",
        (grid.len() * 40) as f64 / 1e9,
        "GB",
        |work| encoding.step(work, k, unit_of(1.0), &AdamStep { options, lr: 1e-1, t: 1 }),
        || p.step(&AdamOptions { skip_untouched: true, ..options }, 1e-1, 1),
    );
}

/// A network and its derivatives.
fn network_rows(rows: &Rows<'_>, k: &Kernels, n: usize, name: &str, (mlp, parameters): (&Mlp, &Parameters)) {
    let (context, mut rng) = (rows.context, mb_job::rng(3, 0));
    let mut network = Network::new(context, mlp, parameters, false);
    network.reserve(context, n);
    let input: Vec<f32> = (0..n * mlp.in_stride()).map(|_| rng.random_range(-1.0..1.0)).collect();
    let d_out: Vec<f32> = (0..n * mlp.out_stride()).map(|_| rng.random_range(-1.0..1.0)).collect();
    let (x, d) = (context.upload(&input), context.upload(&d_out));
    let gflop = (2 * n * mlp.layout().map(|(inputs, outputs, ..)| inputs * outputs).sum::<usize>()) as f64 / 1e9;
    let mut cache = MlpCache::default();
    rows.row(
        &format!("{name}, forward"),
        gflop,
        "GFLOP",
        |work| network.forward(work, k, &x, n),
        || mlp.forward(&parameters.values, &input, mlp.in_stride(), n, &mut cache),
    );
    let transposed = mlp.transpose(&parameters.values);
    let weights = Weights { parameters: &parameters.values, transposed: &transposed };
    let mut grads = vec![0.0; mlp.buffer_len()];
    rows.row(
        &format!("{name}, backward"),
        2.0 * gflop,
        "GFLOP",
        |work| network.backward(work, k, &x, &d, n),
        || mlp.backward(&weights, &input, mlp.in_stride(), &mut cache, &d_out, None, &mut grads, true),
    );
}

/// The geometry network of a distance field, whose normals a loss uses.
fn surface_rows(rows: &Rows<'_>, k: &Kernels, x: &[[f32; 3]]) {
    let (context, n) = (rows.context, x.len());
    let mut rng = mb_job::rng(1, 0);
    let field = SdfField::new(NeusOptions::default().field, &mut rng);
    let parts = field.parts();
    let (grid, table) = parts.grid.expect("a hash encoding");
    let (mlp, parameters) = (parts.geometry.mlp(), parts.geometry.direct());
    let encoding = Encoding::new(context, grid, table, 3);
    let mut network = Network::new(context, mlp, parameters, true);
    network.reserve(context, n);
    let stride = encoding.stride();
    let (positions, encoded) = (context.upload(x.as_flattened()), context.zeros(n * stride));
    let (normals, d_gradient) = (context.zeros(3 * n), context.zeros(n * stride));
    let mut work = context.work();
    encoding.forward(&mut work, k, Points { positions: &positions, count: n }, &encoded);
    work.submit();
    let (mut cache, transposed) = (MlpCache::default(), mlp.transpose(&parameters.values));
    let weights = Weights { parameters: &parameters.values, transposed: &transposed };
    let mut features = vec![0.0; n * stride];
    grid.forward(&table.values, x, grid.levels(), &mut features, stride, 3);
    let mut found = vec![[0.0; 3]; n];
    let products = (2 * n * mlp.layout().map(|(inputs, outputs, ..)| inputs * outputs).sum::<usize>()) as f64 / 1e9;
    rows.row(
        "geometry network, forward and normals",
        products + (2 * n * mlp.shape().inputs * mlp.shape().width) as f64 / 1e9,
        "GFLOP",
        |work| {
            network.forward(work, k, &encoded, n);
            network.gradient(work, k, &encoded, n);
            encoding.normals(work, k, Points { positions: &positions, count: n }, &network.gradient, &normals);
        },
        || {
            mlp.forward(&parameters.values, &features, stride, n, &mut cache);
            mlp.gradient(&weights, &mut cache);
            grid.input_gradient(&table.values, x, grid.levels(), &cache.gradient, stride, 3, &mut found);
        },
    );
    let d_out: Vec<f32> = (0..n * mlp.out_stride()).map(|_| rng.random_range(-1.0..1.0)).collect();
    let d_g = vec![0.1; n * stride];
    let d = context.upload(&d_out);
    let mut grads = vec![0.0; mlp.buffer_len()];
    rows.row(
        "geometry network, double backward",
        4.0 * products,
        "GFLOP",
        |work| network.double_backward(work, k, &encoded, [&d, &d_gradient], n),
        || mlp.backward(&weights, &features, stride, &mut cache, &d_out, Some(&d_g), &mut grads, true),
    );
}
