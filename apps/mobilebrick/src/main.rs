//! The `mobilebrick` command.
fn main() {}
