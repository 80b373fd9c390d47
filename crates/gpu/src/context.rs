//! One device of wgpu: its buffers, kernels and transfers.

use std::sync::{Arc, Mutex, PoisonError};

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
}

/// A compiled entry point.
pub struct Kernel(wgpu::ComputePipeline);

/// Storage on the device, which grows.
pub struct Buffer(wgpu::Buffer);

/// Commands that are recorded, to be sent at once.
pub struct Work<'a> {
    context: &'a Context,
    encoder: wgpu::CommandEncoder,
}

/// Threads of a workgroup in every kernel.
pub const WORKGROUP: usize = 64;
/// Storage buffers of the kernel that has most.
const STORAGE_BUFFERS: u32 = 15;
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
        Self::open(&adapter).ok()
    }

    /// The `number`-th device, or the first one, hardware before software.
    ///
    /// # Errors
    /// There is no such device, or it cannot be opened: the devices that there are.
    pub fn numbered(number: Option<usize>) -> Result<Self> {
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
        Self::open(adapter)
    }

    fn open(adapter: &wgpu::Adapter) -> Result<Self> {
        let name = adapter.get_info().name;
        let buffers = adapter.limits().max_storage_buffers_per_shader_stage;
        if buffers < STORAGE_BUFFERS {
            return Err(Error::Failed(format!(
                "{name} is too small: its kernels can have {buffers} buffers, and {STORAGE_BUFFERS} are needed. Use --device cpu"
            )));
        }
        let (device, queue) = pollster::block_on(
            adapter.request_device(&wgpu::DeviceDescriptor { required_limits: adapter.limits(), ..Default::default() }),
        )
        .map_err(|e| Error::Failed(format!("{name} cannot be opened: {e}. Use --device cpu")))?;
        let complaint = Arc::new(Mutex::new(None));
        let first = Arc::clone(&complaint);
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert_with(|| e.to_string());
        }));
        let first = Arc::clone(&complaint);
        device.set_device_lost_callback(move |_, why| {
            // What it complains of afterwards is only a consequence.
            *first.lock().unwrap_or_else(PoisonError::into_inner) = Some(format!("it was lost ({why})"));
        });
        Ok(Self { device, queue, name, complaint })
    }

    /// Loses the device, for tests.
    #[cfg(test)]
    pub fn lose(&self) {
        self.device.destroy();
    }

    /// Compiles an entry point of a WGSL source, with its `override` constants.
    pub fn kernel(&self, source: &str, entry: &str, constants: &[(&str, f64)]) -> Kernel {
        let module = self.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(entry),
            source: wgpu::ShaderSource::Wgsl(source.into()),
        });
        // Tiles are written before they are read.
        let options = wgpu::PipelineCompilationOptions { constants, zero_initialize_workgroup_memory: false };
        Kernel(self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: None,
            module: &module,
            entry_point: Some(entry),
            compilation_options: options,
            cache: None,
        }))
    }

    /// Zeros: `len` numbers of four bytes.
    pub fn zeros(&self, len: usize) -> Buffer {
        Buffer(self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            // An empty buffer cannot be bound.
            size: 4 * len.max(4) as u64,
            usage: USAGE,
            mapped_at_creation: false,
        }))
    }

    /// A buffer with this content.
    pub fn upload<T: Pod>(&self, content: &[T]) -> Buffer {
        let buffer = self.zeros(size_of_val(content).div_ceil(4));
        // A lost device refuses this without a panic, unlike a buffer that is mapped when it is made.
        self.queue.write_buffer(&buffer.0, 0, bytemuck::cast_slice(content));
        buffer
    }

    /// Replaces numbers of a buffer from number `first` on, before whatever is sent next.
    pub fn write(&self, buffer: &Buffer, first: usize, content: &[f32]) {
        self.queue.write_buffer(&buffer.0, 4 * first as u64, bytemuck::cast_slice(content));
    }

    /// Makes room for `len` numbers of four bytes; the content is lost where the buffer has to grow.
    pub fn reserve(&self, buffer: &mut Buffer, len: usize) {
        if buffer.0.size() < 4 * len as u64 {
            *buffer = self.zeros(len + len / 4);
        }
    }

    /// Waits, and brings the first `len` numbers back.
    ///
    /// # Errors
    /// The device was lost, ran out of memory or refused something since the last call.
    pub fn read<T: Pod>(&self, buffer: &Buffer, len: usize) -> Result<Vec<T>> {
        let size = (len * size_of::<T>()) as u64;
        if size == 0 {
            return Ok(Vec::new());
        }
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(&buffer.0, 0, &staging, 0, size);
        self.queue.submit([encoder.finish()]);
        // A failure shows when the range is asked for.
        staging.map_async(wgpu::MapMode::Read, .., |_| ());
        let waited = self.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| e.to_string());
        let complaint = self.complaint.lock().unwrap_or_else(PoisonError::into_inner).take();
        let content = match complaint {
            Some(complaint) => Err(complaint),
            None => waited.and_then(|_| {
                let range = staging.get_mapped_range(..).map_err(|e| e.to_string())?;
                Ok(bytemuck::pod_collect_to_vec(&range))
            }),
        };
        content.map_err(|e| Error::Failed(format!("{} failed: {e}. Use --device cpu", self.name)))
    }

    /// Begins to record.
    pub fn work(&self) -> Work<'_> {
        let encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        Work { context: self, encoder }
    }
}

impl Work<'_> {
    /// Runs at least so many threads. `sizes` are the words of the uniform at binding 0; each buffer has the number of its
    /// binding.
    pub fn run(&mut self, kernel: &Kernel, sizes: &[u32], buffers: &[(u32, &Buffer)], threads: usize) {
        if threads == 0 {
            return;
        }
        let device = &self.context.device;
        let mut words = sizes.to_vec();
        words.resize(sizes.len().next_multiple_of(4), 0);
        let uniform = device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: 4 * words.len() as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.context.queue.write_buffer(&uniform, 0, bytemuck::cast_slice(&words));
        let mut entries = vec![wgpu::BindGroupEntry { binding: 0, resource: uniform.as_entire_binding() }];
        entries.extend(buffers.iter().map(|(binding, buffer)| wgpu::BindGroupEntry {
            binding: *binding,
            resource: buffer.0.as_entire_binding(),
        }));
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &kernel.0.get_bind_group_layout(0),
            entries: &entries,
        });
        let groups = threads.div_ceil(WORKGROUP);
        let mut pass = self.encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&kernel.0);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(groups.min(ROW) as u32, groups.div_ceil(ROW) as u32, 1);
    }

    /// Fills a buffer with zeros.
    pub fn clear(&mut self, buffer: &Buffer) {
        self.encoder.clear_buffer(&buffer.0, 0, None);
    }

    /// Sends what was recorded.
    pub fn submit(self) {
        self.context.queue.submit([self.encoder.finish()]);
    }
}
