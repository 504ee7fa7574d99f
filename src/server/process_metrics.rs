//! Process metrics, with the names of the Prometheus client libraries.

use tmpi_pipeline::usage::{cpu_seconds, resident_bytes};

use super::metrics::{Metric, counter, gauge};

/// The available metrics; without `/proc` only CPU time and the file limit.
#[must_use]
pub fn figures() -> Vec<Metric> {
    let mut all = Vec::new();
    all.extend(cpu_seconds().map(|s| counter("process_cpu_seconds", "Time of the processor, of processes that make photos not", s)));
    all.extend(resident_bytes().map(|bytes| gauge("process_resident_memory_bytes", "Resident memory", bytes as f64)));
    // minus the descriptor that reads the folder
    let open = std::fs::read_dir("/proc/self/fd").ok().map(|files| files.count().saturating_sub(1));
    all.extend(open.map(|files| gauge("process_open_fds", "Open files, connections among them", files as f64)));
    all.extend(most_files().map(|files| gauge("process_max_fds", "Files that may be open", files)));
    all
}

#[cfg(unix)]
#[allow(unsafe_code, reason = "a call of libc that only writes the struct it is handed")]
#[allow(clippy::cast_lossless, clippy::unnecessary_cast, reason = "the width differs by system")]
fn most_files() -> Option<f64> {
    let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: the struct outlives the call
    let answer = unsafe { libc::getrlimit(libc::RLIMIT_NOFILE, &raw mut limit) };
    (answer == 0 && limit.rlim_cur != libc::RLIM_INFINITY).then_some(limit.rlim_cur as f64)
}

#[cfg(not(unix))]
fn most_files() -> Option<f64> {
    None
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use super::*;
    use crate::server::metrics::Value;

    fn value(name: &str) -> f64 {
        let figure = figures().into_iter().find(|figure| figure.name == name).unwrap();
        let (Value::Gauge(value) | Value::Counter(value)) = figure.value;
        value
    }

    #[test]
    fn process_metrics_have_values() {
        let before = value("process_open_fds");
        let files: Vec<_> = (0..50).map(|_| std::fs::File::open("/dev/null").unwrap()).collect();
        // concurrent tests open and close some
        assert!(value("process_open_fds") >= before + 25.0 && value("process_max_fds") >= before + 50.0);
        drop(files);
        let memory = vec![1_u8; 64 << 20];
        let resident = value("process_resident_memory_bytes");
        assert!(resident > std::hint::black_box(&memory).len() as f64 && resident < 64e9, "{resident}");
        let start = value("process_cpu_seconds");
        let mut sum = 0_u64;
        while value("process_cpu_seconds") < start + 0.01 {
            sum = sum.wrapping_add(1);
        }
        assert!(sum > 0 && matches!(figures()[0].value, Value::Counter(_)));
    }
}
