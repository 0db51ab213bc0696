//! `machine.json`: what a run was trained on, without the names of host and user.

use std::fs;
use std::path::Path;

use parallax::Result;
use parallax::formats::atomic::write_bytes_atomically;
use parallax::tensor::simd;
use serde_json::json;

/// Leaves it in a run's folder.
pub fn record(folder: &Path) -> Result<()> {
    let machine = json!({
        "processor": processor(),
        "architecture": std::env::consts::ARCH,
        "system": std::env::consts::OS,
        "threads": rayon::current_num_threads(),
        "simd": simd::level()?,
        "version": env!("CARGO_PKG_VERSION"),
    });
    write_bytes_atomically(folder.join("machine.json"), machine.to_string().as_bytes())
}

/// The processor's name, where the system tells it in a file.
fn processor() -> Option<String> {
    let text = fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("model name"))?;
    line.split_once(':').map(|(_, name)| name.trim().to_owned())
}
