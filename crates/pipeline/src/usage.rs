//! Wall time, processor time and memory of this process. A [`Clock`]'s processor time includes child processes that have ended and been
//! waited for.

use std::time::Instant;

/// Times one span: wall and processor milliseconds.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    wall: Instant,
    cpu: f64,
}

impl Clock {
    /// Starts now.
    pub fn start() -> Self {
        Self { wall: Instant::now(), cpu: cpu_ms() }
    }

    /// Wall milliseconds since the start.
    pub fn ms(&self) -> f64 {
        self.wall.elapsed().as_secs_f64() * 1e3
    }

    /// Processor milliseconds since the start: all threads of this process, plus child processes that have ended since. 0 if the system
    /// does not report them.
    pub fn cpu_ms(&self) -> f64 {
        cpu_ms() - self.cpu
    }
}

#[cfg(unix)]
#[allow(unsafe_code, reason = "two libc calls that only write the struct passed to them")]
mod system {
    /// Processor seconds of all threads of this process, without child processes; `None` if the system does not report them.
    pub fn cpu_seconds() -> Option<f64> {
        let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
        // SAFETY: `t` outlives the call, which writes nothing else.
        if unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &raw mut t) } != 0 {
            return None;
        }
        Some(t.tv_sec as f64 + t.tv_nsec as f64 / 1e9)
    }

    pub fn cpu_ms() -> f64 {
        let programs = usage(libc::RUSAGE_CHILDREN).map_or(0.0, |u| ms(u.ru_utime) + ms(u.ru_stime));
        cpu_seconds().map_or(0.0, |seconds| seconds * 1e3 + programs)
    }

    fn ms(t: libc::timeval) -> f64 {
        t.tv_sec as f64 * 1e3 + t.tv_usec as f64 / 1e3
    }

    fn usage(of: libc::c_int) -> Option<libc::rusage> {
        let mut usage = std::mem::MaybeUninit::<libc::rusage>::zeroed();
        // SAFETY: `usage` outlives the call and all-zero is a valid `rusage`.
        unsafe { (libc::getrusage(of, usage.as_mut_ptr()) == 0).then(|| usage.assume_init()) }
    }

    /// Peak resident memory of this process in bytes; 0 if the system does not report it.
    pub fn peak_rss_bytes() -> u64 {
        // on Linux, `getrusage` also counts what the parent process held when it started this one
        super::status_bytes("VmHWM:").unwrap_or_else(|| {
            // kilobytes, except on macOS
            usage(libc::RUSAGE_SELF).map_or(0, |u| u.ru_maxrss as u64) * if cfg!(target_os = "macos") { 1 } else { 1024 }
        })
    }
}

/// Resident memory of this process in bytes; `None` if the system does not report it.
pub fn resident_bytes() -> Option<u64> {
    status_bytes("VmRSS:")
}

/// One memory figure of `/proc/self/status`, in bytes.
fn status_bytes(name: &str) -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let kilobytes = status.lines().find_map(|line| line.strip_prefix(name)?.trim().strip_suffix(" kB"))?;
    Some(kilobytes.trim().parse::<u64>().ok()? * 1024)
}

#[cfg(not(unix))]
mod system {
    pub fn cpu_seconds() -> Option<f64> {
        None
    }

    pub fn cpu_ms() -> f64 {
        0.0
    }

    pub fn peak_rss_bytes() -> u64 {
        0
    }
}

use system::cpu_ms;
pub use system::{cpu_seconds, peak_rss_bytes};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_counts_from_its_own_start() {
        let first = Clock::start();
        let mut turns = 0u64;
        let has_cpu_time = cpu_ms() > 0.0;
        while if has_cpu_time { first.cpu_ms() < 5.0 } else { first.ms() < 5.0 } {
            turns = std::hint::black_box(turns + 1);
        }
        let second = Clock::start();
        // the second clock is read first: time that other threads take between the two readings then only makes the first clock larger
        let (later, later_cpu) = (second.ms(), second.cpu_ms());
        let (earlier, earlier_cpu) = (first.ms(), first.cpu_ms());
        assert!(later >= 0.0 && earlier >= later, "{earlier} {later}");
        assert!(!has_cpu_time || earlier_cpu >= later_cpu + 5.0, "{earlier_cpu} {later_cpu}");
        assert!(has_cpu_time || !cfg!(unix), "Unix reports processor time");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn peak_memory_covers_memory_in_use() {
        let held = std::hint::black_box(vec![1u8; 64 << 20]);
        let now = resident_bytes().unwrap();
        assert!(now >= held.len() as u64 && peak_rss_bytes() >= now, "{now} {}", peak_rss_bytes());
    }
}
