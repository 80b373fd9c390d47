//! How the program's allocator treats memory that is freed.

/// Keeps freed memory for what comes next. Scoring a table frees the same large buffers after every sequence; the system
/// would take them back and clear new pages, which took a tenth of the time. Only GNU's C library has this switch.
pub fn keep_freed() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: these calls set numbers of the allocator and touch no memory.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 1 << 30);
        libc::mallopt(libc::M_TRIM_THRESHOLD, i32::MAX);
        libc::mallopt(libc::M_TOP_PAD, 256 << 20);
    }
}
