//! Counts and durations, in the text format of Prometheus.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Upper bounds of the buckets of every histogram, in seconds.
const BUCKETS: [f64; 12] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 5.0, 30.0];

#[derive(Clone, Default)]
struct Histogram {
    buckets: [u64; BUCKETS.len()],
    count: u64,
    sum: f64,
}

impl Histogram {
    fn add(&mut self, seconds: f64) {
        for (n, bound) in self.buckets.iter_mut().zip(BUCKETS) {
            *n += u64::from(seconds <= bound);
        }
        self.count += 1;
        self.sum += seconds;
    }

    fn write(&self, out: &mut String, name: &str, labels: &str) {
        let comma = if labels.is_empty() { "" } else { "," };
        for (n, bound) in self.buckets.iter().zip(BUCKETS) {
            let _ = writeln!(out, "{name}_bucket{{{labels}{comma}le=\"{bound}\"}} {n}");
        }
        let _ = writeln!(out, "{name}_bucket{{{labels}{comma}le=\"+Inf\"}} {}", self.count);
        let _ = writeln!(out, "{name}_sum{{{labels}}} {}", self.sum);
        let _ = writeln!(out, "{name}_count{{{labels}}} {}", self.count);
    }
}

#[derive(Default)]
struct Tables {
    requests: BTreeMap<(String, String, u16), u64>,
    durations: BTreeMap<String, Histogram>,
    jobs: BTreeMap<&'static str, u64>,
    job_durations: Histogram,
    view_phases: BTreeMap<&'static str, Histogram>,
}

/// All counters of a server.
pub struct Telemetry {
    started: Instant,
    tables: Mutex<Tables>,
    uploaded: AtomicU64,
    connections: AtomicI64,
    in_flight: AtomicI64,
}

impl Default for Telemetry {
    fn default() -> Self {
        Self {
            started: Instant::now(),
            tables: Mutex::default(),
            uploaded: AtomicU64::new(0),
            connections: AtomicI64::new(0),
            in_flight: AtomicI64::new(0),
        }
    }
}

/// Counts one as long as it lives.
pub struct Present<'a>(&'a AtomicI64);

impl Drop for Present<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Telemetry {
    fn lock(&self) -> MutexGuard<'_, Tables> {
        self.tables.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A request was answered.
    pub fn request(&self, method: &str, route: &str, status: u16, took: Duration) {
        let mut tables = self.lock();
        *tables.requests.entry((method.to_owned(), route.to_owned(), status)).or_default() += 1;
        tables.durations.entry(route.to_owned()).or_default().add(took.as_secs_f64());
    }

    /// A job ended as `outcome`.
    pub fn job(&self, outcome: &'static str, took: Duration) {
        let mut tables = self.lock();
        *tables.jobs.entry(outcome).or_default() += 1;
        tables.job_durations.add(took.as_secs_f64());
    }

    /// A phase of drawing a view: `decode`, `render` or `encode`.
    pub fn view(&self, phase: &'static str, took: Duration) {
        self.lock().view_phases.entry(phase).or_default().add(took.as_secs_f64());
    }

    /// Bytes of accepted uploads.
    pub fn uploaded(&self, bytes: u64) {
        self.uploaded.fetch_add(bytes, Ordering::Relaxed);
    }

    /// A connection, as long as the result lives.
    pub fn connection(&self) -> Present<'_> {
        self.connections.fetch_add(1, Ordering::Relaxed);
        Present(&self.connections)
    }

    /// A request under way, as long as the result lives.
    pub fn in_flight(&self) -> Present<'_> {
        self.in_flight.fetch_add(1, Ordering::Relaxed);
        Present(&self.in_flight)
    }

    /// Everything, with `gauges` (name, help, value) that others know.
    #[must_use]
    pub fn text(&self, gauges: &[(&str, &str, f64)]) -> String {
        let tables = self.lock();
        let mut out = String::with_capacity(8192);
        head(&mut out, "tmpi_requests_total", "counter", "Requests answered.");
        for ((method, route, status), n) in &tables.requests {
            let _ = writeln!(out, "tmpi_requests_total{{method=\"{method}\",route=\"{route}\",status=\"{status}\"}} {n}");
        }
        head(&mut out, "tmpi_request_seconds", "histogram", "Time to the header of the response.");
        for (route, histogram) in &tables.durations {
            histogram.write(&mut out, "tmpi_request_seconds", &format!("route=\"{route}\""));
        }
        head(&mut out, "tmpi_jobs_total", "counter", "Jobs ended.");
        for (outcome, n) in &tables.jobs {
            let _ = writeln!(out, "tmpi_jobs_total{{outcome=\"{outcome}\"}} {n}");
        }
        head(&mut out, "tmpi_job_seconds", "histogram", "Duration of jobs.");
        tables.job_durations.write(&mut out, "tmpi_job_seconds", "");
        head(&mut out, "tmpi_view_seconds", "histogram", "Duration of the phases of drawing a view.");
        for (phase, histogram) in &tables.view_phases {
            histogram.write(&mut out, "tmpi_view_seconds", &format!("phase=\"{phase}\""));
        }
        drop(tables);
        head(&mut out, "tmpi_uploaded_bytes_total", "counter", "Bytes of accepted uploads.");
        let _ = writeln!(out, "tmpi_uploaded_bytes_total {}", self.uploaded.load(Ordering::Relaxed));
        let own = [
            ("tmpi_connections", "Open connections.", self.connections.load(Ordering::Relaxed) as f64),
            ("tmpi_requests_in_flight", "Requests under way.", self.in_flight.load(Ordering::Relaxed) as f64),
            ("tmpi_uptime_seconds", "Time since the start.", self.started.elapsed().as_secs_f64()),
        ];
        for (name, help, value) in own.iter().chain(gauges) {
            head(&mut out, name, "gauge", help);
            let _ = writeln!(out, "{name} {value}");
        }
        out
    }
}

fn head(out: &mut String, name: &str, kind: &str, help: &str) {
    let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} {kind}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_is_what_prometheus_reads() {
        let t = Telemetry::default();
        t.request("GET", "/healthz", 200, Duration::from_millis(3));
        t.request("GET", "/healthz", 200, Duration::from_mins(1));
        t.job("done", Duration::from_millis(700));
        let alive = t.connection();
        let text = t.text(&[("tmpi_queue_depth", "Waiting jobs.", 2.0)]);
        drop(alive);
        for line in [
            "tmpi_requests_total{method=\"GET\",route=\"/healthz\",status=\"200\"} 2",
            "tmpi_request_seconds_bucket{route=\"/healthz\",le=\"0.0025\"} 0",
            "tmpi_request_seconds_bucket{route=\"/healthz\",le=\"0.005\"} 1",
            "tmpi_request_seconds_bucket{route=\"/healthz\",le=\"+Inf\"} 2",
            "tmpi_job_seconds_bucket{le=\"1\"} 1",
            "tmpi_jobs_total{outcome=\"done\"} 1",
            "tmpi_connections 1",
            "tmpi_queue_depth 2",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} is missing in\n{text}");
        }
        for line in text.lines().filter(|l| !l.starts_with('#')) {
            assert!(line.rsplit_once(' ').is_some_and(|(_, v)| v.parse::<f64>().is_ok()), "{line}");
        }
        assert!(t.text(&[]).contains("tmpi_connections 0"));
    }
}
