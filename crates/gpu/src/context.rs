//! One device of wgpu: its buffers, kernels and transfers.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytemuck::Pod;
use mb_job::{Error, Result};

/// An open device.
pub struct Context {
    device: wgpu::Device,
    queue: wgpu::Queue,
    /// For people.
    pub name: String,
    /// What the device complained of first.
    complaint: Arc<Mutex<Option<String>>>,
    /// Numbers kernels and buffers.
    next: AtomicU64,
    bindings: Mutex<Bindings>,
    /// Where what is read lands, for the next time.
    staging: Mutex<Option<wgpu::Buffer>>,
    profile: Option<Profile>,
}

/// A compiled entry point.
pub struct Kernel {
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    name: String,
    number: u64,
}

/// Storage on the device, which grows.
pub struct Buffer {
    buffer: wgpu::Buffer,
    number: u64,
}

/// Which buffers a kernel is bound to: what a step binds, the next one binds again.
#[derive(Default)]
struct Bindings {
    /// By the kernel's number, the bindings and the buffers' numbers.
    groups: BTreeMap<(u64, Vec<(u32, u64)>), Bound>,
    submissions: u64,
}

struct Bound {
    group: wgpu::BindGroup,
    /// The submission that used it last.
    used: u64,
}

/// Submissions after which buffers that nobody binds any more are let go.
const FORGET: u64 = 64;

/// How long each kernel ran.
struct Profile {
    stamps: wgpu::QuerySet,
    /// Where a submission's stamps go.
    resolved: wgpu::Buffer,
    /// Seconds and runs, by the kernel's name.
    spent: Mutex<BTreeMap<String, (f64, u64)>>,
}

/// Stamps of one submission, at most.
const STAMPS: u32 = 4096;

/// Commands that are recorded, to be sent at once.
pub struct Work<'a> {
    context: &'a Context,
    /// Ends before what it is recorded into does.
    pass: Option<wgpu::ComputePass<'static>>,
    encoder: wgpu::CommandEncoder,
    /// The kernels that were stamped.
    stamped: Vec<String>,
}

/// Threads of a workgroup in every kernel.
pub const WORKGROUP: usize = 64;
/// Storage buffers of the kernel that has most.
const STORAGE_BUFFERS: u32 = 15;
/// Bytes of a kernel's sizes, at most.
const SIZES: u32 = 64;
/// Workgroups in a row; a device allows 65535.
const ROW: usize = 32_768;

const USAGE: wgpu::BufferUsages =
    wgpu::BufferUsages::STORAGE.union(wgpu::BufferUsages::COPY_DST).union(wgpu::BufferUsages::COPY_SRC);

/// All devices that the drivers of this machine show, with whether each is the processor in disguise.
fn adapters() -> Vec<(wgpu::Adapter, bool)> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    adapters
        .into_iter()
        .map(|adapter| {
            let software = adapter.get_info().device_type == wgpu::DeviceType::Cpu;
            (adapter, software)
        })
        .collect()
}

impl Context {
    /// The first device that is no software, where there is one.
    pub fn first_hardware() -> Option<Self> {
        let (adapter, _) = adapters().into_iter().find(|(_, software)| !software)?;
        Self::open(&adapter, false).ok()
    }

    /// The `number`-th device, or the first one, hardware before software.
    ///
    /// # Errors
    /// There is no such device, or it cannot be opened: the devices that there are.
    pub fn numbered(number: Option<usize>) -> Result<Self> {
        Self::choose(number, false)
    }

    /// The same device, which waits for whatever is sent and keeps the time of each kernel: see [`Self::spent`].
    ///
    /// # Errors
    /// As [`Self::numbered`]; the device has no clock.
    pub fn profiled(number: Option<usize>) -> Result<Self> {
        Self::choose(number, true)
    }

    fn choose(number: Option<usize>, profiled: bool) -> Result<Self> {
        let adapters = adapters();
        let hardware = adapters.iter().position(|(_, software)| !software).unwrap_or(0);
        let Some((adapter, _)) = adapters.get(number.unwrap_or(hardware)) else {
            let names: Vec<String> =
                adapters.iter().enumerate().map(|(i, (a, _))| format!("gpu:{i} is {}", a.get_info().name)).collect();
            let found = if names.is_empty() { "the drivers show none".to_owned() } else { names.join(", ") };
            return Err(Error::Failed(format!(
                "no such GPU: {found}. Install the GPU's Vulkan driver, or use --device cpu"
            )));
        };
        Self::open(adapter, profiled)
    }

    fn open(adapter: &wgpu::Adapter, profiled: bool) -> Result<Self> {
        let name = adapter.get_info().name;
        let buffers = adapter.limits().max_storage_buffers_per_shader_stage;
        if buffers < STORAGE_BUFFERS {
            return Err(Error::Failed(format!(
                "{name} is too small: its kernels can have {buffers} buffers, and {STORAGE_BUFFERS} are needed. Use --device cpu"
            )));
        }
        let bytes = adapter.limits().max_immediate_size;
        if bytes < SIZES || !adapter.features().contains(wgpu::Features::IMMEDIATES) {
            return Err(Error::Failed(format!(
                "{name} is too small: its kernels can be given {bytes} bytes, and {SIZES} are needed. Use --device cpu"
            )));
        }
        let mut features = wgpu::Features::IMMEDIATES;
        if profiled {
            features |= wgpu::Features::TIMESTAMP_QUERY;
        }
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            required_features: features,
            required_limits: adapter.limits(),
            ..Default::default()
        }))
        .map_err(|e| Error::Failed(format!("{name} cannot be opened: {e}. Use --device cpu")))?;
        let complaint = Arc::new(Mutex::new(None));
        let first = Arc::clone(&complaint);
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            lock(&first).get_or_insert_with(|| e.to_string());
        }));
        let first = Arc::clone(&complaint);
        device.set_device_lost_callback(move |_, why| {
            // What it complains of afterwards is only a consequence.
            *lock(&first) = Some(format!("it was lost ({why})"));
        });
        let profile = profiled.then(|| Profile {
            stamps: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: None,
                ty: wgpu::QueryType::Timestamp,
                count: STAMPS,
            }),
            resolved: device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size: 8 * u64::from(STAMPS),
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            spent: Mutex::default(),
        });
        let (next, bindings, staging) = (AtomicU64::new(0), Mutex::default(), Mutex::default());
        Ok(Self { device, queue, name, complaint, next, bindings, staging, profile })
    }

    /// Seconds and runs of each kernel, the longest first; nothing where the context is not profiled.
    pub fn spent(&self) -> Vec<(String, f64, u64)> {
        let Some(profile) = &self.profile else { return Vec::new() };
        let spent = lock(&profile.spent);
        let mut spent: Vec<_> = spent.iter().map(|(name, (seconds, runs))| (name.clone(), *seconds, *runs)).collect();
        spent.sort_by(|a, b| b.1.total_cmp(&a.1));
        spent
    }

    fn number(&self) -> u64 {
        self.next.fetch_add(1, Ordering::Relaxed)
    }

    /// Loses the device, for tests.
    #[cfg(test)]
    pub fn lose(&self) {
        self.device.destroy();
    }

    /// Compiles an entry point of a WGSL source, with its `override` constants.
    pub fn kernel(&self, source: &str, entry: &str, constants: &[(&str, f64)]) -> Kernel {
        let descriptor =
            wgpu::ShaderModuleDescriptor { label: Some(entry), source: wgpu::ShaderSource::Wgsl(source.into()) };
        // A counter in every loop would keep the driver from unrolling it.
        let checks = wgpu::ShaderRuntimeChecks { force_loop_bounding: false, ..wgpu::ShaderRuntimeChecks::checked() };
        // SAFETY: accesses stay checked. The sources are this crate's own, and each of their loops counts towards an end that
        // it does not move; that of march.wgsl walks at least one step of a positive length.
        let module = unsafe { self.device.create_shader_module_trusted(descriptor, checks) };
        // Tiles are written before they are read.
        let options = wgpu::PipelineCompilationOptions { constants, zero_initialize_workgroup_memory: false };
        let pipeline = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: None,
            module: &module,
            entry_point: Some(entry),
            compilation_options: options,
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        let constants: String = constants.iter().map(|(name, value)| format!(" {name}={value}")).collect();
        Kernel { pipeline, layout, name: format!("{entry}{constants}"), number: self.number() }
    }

    /// Zeros: `len` numbers of four bytes.
    pub fn zeros(&self, len: usize) -> Buffer {
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            // An empty buffer cannot be bound.
            size: 4 * len.max(4) as u64,
            usage: USAGE,
            mapped_at_creation: false,
        });
        Buffer { buffer, number: self.number() }
    }

    /// A buffer with this content.
    pub fn upload<T: Pod>(&self, content: &[T]) -> Buffer {
        let buffer = self.zeros(size_of_val(content).div_ceil(4));
        // A lost device refuses this without a panic, unlike a buffer that is mapped when it is made.
        self.queue.write_buffer(&buffer.buffer, 0, bytemuck::cast_slice(content));
        buffer
    }

    /// Replaces numbers of a buffer from number `first` on, before whatever is sent next.
    pub fn write<T: Pod>(&self, buffer: &Buffer, first: usize, content: &[T]) {
        self.queue.write_buffer(&buffer.buffer, 4 * first as u64, bytemuck::cast_slice(content));
    }

    /// Replaces the content of a buffer, which grows where it has to.
    pub fn replace<T: Pod>(&self, buffer: &mut Buffer, content: &[T]) {
        self.reserve(buffer, size_of_val(content).div_ceil(4));
        self.write(buffer, 0, content);
    }

    /// Makes room for `len` numbers of four bytes; the content is lost where the buffer has to grow.
    pub fn reserve(&self, buffer: &mut Buffer, len: usize) {
        if buffer.buffer.size() < 4 * len as u64 {
            *buffer = self.zeros(len + len / 4);
        }
    }

    /// Waits, and brings the first `len` numbers back.
    ///
    /// # Errors
    /// The device was lost, ran out of memory or refused something since the last call.
    pub fn read<T: Pod>(&self, buffer: &Buffer, len: usize) -> Result<Vec<T>> {
        self.read_with(buffer, len, |found: &[T]| found.to_vec())
    }

    /// The same, for one look.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn read_with<T: Pod, R>(&self, buffer: &Buffer, len: usize, look: impl FnOnce(&[T]) -> R) -> Result<R> {
        self.bring(&[(&buffer.buffer, len * size_of::<T>())], |bytes| look(bytemuck::cast_slice(bytes)))
    }

    /// The first words of several buffers, in one wait.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn read_all(&self, buffers: &[(&Buffer, usize)]) -> Result<Vec<Vec<u32>>> {
        let parts: Vec<_> = buffers.iter().map(|(buffer, len)| (&buffer.buffer, 4 * len)).collect();
        self.bring(&parts, |bytes| {
            let mut words: &[u32] = bytemuck::cast_slice(bytes);
            buffers.iter().map(|(_, len)| words.split_off(..*len).unwrap_or_default().to_vec()).collect()
        })
    }

    /// Copies the first bytes of buffers, one behind the other, to where the processor may `look`.
    fn bring<R>(&self, parts: &[(&wgpu::Buffer, usize)], look: impl FnOnce(&[u8]) -> R) -> Result<R> {
        let size = parts.iter().map(|(_, bytes)| *bytes as u64).sum::<u64>();
        if size == 0 {
            // An empty slice of bytes need not lie where wider numbers may.
            return Ok(look(bytemuck::cast_slice::<u64, u8>(&[])));
        }
        let mut kept = lock(&self.staging);
        let staging = kept.take().filter(|staging| staging.size() >= size).unwrap_or_else(|| {
            self.device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size: size.next_power_of_two(),
                usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut to = 0;
        for (buffer, bytes) in parts.iter().filter(|(_, bytes)| *bytes > 0) {
            encoder.copy_buffer_to_buffer(buffer, 0, &staging, to, *bytes as u64);
            to += *bytes as u64;
        }
        self.queue.submit([encoder.finish()]);
        // A failure shows when the range is asked for.
        staging.map_async(wgpu::MapMode::Read, 0..size, |_| ());
        let waited = self.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| e.to_string());
        let complaint = lock(&self.complaint).take();
        let found = match complaint {
            Some(complaint) => Err(complaint),
            None => waited.and_then(|_| {
                let range = staging.get_mapped_range(0..size).map_err(|e| e.to_string())?;
                Ok(look(&range))
            }),
        };
        if found.is_ok() {
            staging.unmap();
            *kept = Some(staging);
        }
        found.map_err(|e| Error::Failed(format!("{} failed: {e}. Use --device cpu", self.name)))
    }

    /// Begins to record.
    pub fn work(&self) -> Work<'_> {
        let encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Work { context: self, pass: None, encoder, stamped: Vec::new() }
    }

    /// Binds a kernel to buffers.
    fn bind(&self, kernel: &Kernel, buffers: &[(u32, &Buffer)]) -> wgpu::BindGroup {
        let mut bindings = lock(&self.bindings);
        let now = bindings.submissions;
        let key = (kernel.number, buffers.iter().map(|(binding, buffer)| (*binding, buffer.number)).collect());
        let bound = bindings.groups.entry(key).or_insert_with(|| {
            let entries = buffers.iter().map(|(binding, buffer)| wgpu::BindGroupEntry {
                binding: *binding,
                resource: buffer.buffer.as_entire_binding(),
            });
            let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: None,
                layout: &kernel.layout,
                entries: &entries.collect::<Vec<_>>(),
            });
            Bound { group, used: now }
        });
        bound.used = now;
        bound.group.clone()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Work<'_> {
    /// Runs at least so many threads. `sizes` are the words that the kernel calls so; each buffer has the number of its
    /// binding.
    pub fn run(&mut self, kernel: &Kernel, sizes: &[u32], buffers: &[(u32, &Buffer)], threads: usize) {
        if threads == 0 {
            return;
        }
        let group = self.context.bind(kernel, buffers);
        let groups = threads.div_ceil(WORKGROUP);
        if let Some(profile) = &self.context.profile {
            let first = 2 * self.stamped.len() as u32;
            let timestamp_writes = (first < STAMPS).then(|| {
                self.stamped.push(kernel.name.clone());
                wgpu::ComputePassTimestampWrites {
                    query_set: &profile.stamps,
                    beginning_of_pass_write_index: Some(first),
                    end_of_pass_write_index: Some(first + 1),
                }
            });
            // A pass of its own, since stamps are those of passes.
            self.pass = None;
            let descriptor = wgpu::ComputePassDescriptor { label: None, timestamp_writes };
            self.pass = Some(self.encoder.begin_compute_pass(&descriptor).forget_lifetime());
        }
        let encoder = &mut self.encoder;
        let pass = self.pass.get_or_insert_with(|| {
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default()).forget_lifetime()
        });
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.set_immediates(0, bytemuck::cast_slice(sizes));
        pass.dispatch_workgroups(groups.min(ROW) as u32, groups.div_ceil(ROW) as u32, 1);
    }

    /// Fills a buffer with zeros.
    pub fn clear(&mut self, buffer: &Buffer) {
        self.pass = None;
        self.encoder.clear_buffer(&buffer.buffer, 0, None);
    }

    /// Sends what was recorded.
    pub fn submit(mut self) {
        self.pass = None;
        let context = self.context;
        {
            let mut bindings = lock(&context.bindings);
            bindings.submissions += 1;
            let oldest = bindings.submissions.saturating_sub(FORGET);
            bindings.groups.retain(|_, bound| bound.used >= oldest);
        }
        let Some(profile) = &context.profile else {
            context.queue.submit([self.encoder.finish()]);
            return;
        };
        let stamps = 2 * self.stamped.len() as u32;
        self.encoder.resolve_query_set(&profile.stamps, 0..stamps, &profile.resolved, 0);
        context.queue.submit([self.encoder.finish()]);
        let bytes = 8 * stamps as usize;
        let found = context.bring(&[(&profile.resolved, bytes)], bytemuck::pod_collect_to_vec::<u8, [u64; 2]>);
        let Ok(stamps) = found else { return };
        let tick = 1e-9 * f64::from(context.queue.get_timestamp_period());
        let mut spent = lock(&profile.spent);
        for (name, [begin, end]) in self.stamped.into_iter().zip(stamps) {
            let (seconds, runs) = spent.entry(name).or_default();
            *seconds += tick * end.saturating_sub(begin) as f64;
            *runs += 1;
        }
    }
}
