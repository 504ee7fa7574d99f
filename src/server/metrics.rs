//! Metrics in the `OpenMetrics` text format, for Prometheus.

use std::hash::Hash;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::encoding::text::{encode_eof, encode_registry};
use prometheus_client::metrics::counter::{ConstCounter, Counter};
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::{ConstGauge, Gauge};
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{self, Registry};

use super::traces::{Collector, CollectorError, JobSpan, Traces};
use tmpi_library::{Class, PhotoId, Swept};
use tmpi_pipeline::usage::cpu_seconds;

/// Media type of the text.
pub const MEDIA_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Upper bounds of the buckets of every histogram, in seconds: jobs and films take minutes.
const BUCKETS: [f64; 15] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 30.0, 120.0, 600.0];

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Answered {
    method: &'static str,
    route: String,
    status: u16,
}

/// A gauge that is counted elsewhere: name, help text, and value.
pub type Metric = (&'static str, &'static str, f64);

/// Labels with values from closed sets.
type Labels<const N: usize> = [(&'static str, &'static str); N];

type Durations<L> = Family<L, Histogram, fn() -> Histogram>;

fn durations<L: Clone + Hash + Eq>() -> Durations<L> {
    Durations::new_with_constructor(|| Histogram::new(BUCKETS))
}

pub struct Telemetry {
    started: Instant,
    since: SystemTime,
    registry: Registry,
    requests: Family<Answered, Counter>,
    durations: Durations<[(&'static str, String); 1]>,
    jobs: Family<Labels<2>, Counter>,
    job_durations: Durations<Labels<1>>,
    view_phases: Durations<Labels<1>>,
    uploaded: Counter,
    retired: Family<Labels<1>, Counter>,
    freed: Counter,
    connections: Gauge,
    in_flight: Gauge,
    deliveries: Family<Labels<1>, Counter>,
    traces: Option<Traces>,
}

/// Registers a metric.
fn added<M: registry::Metric + Clone>(name: &str, help: &str, metric: M, to: &mut Registry) -> M {
    to.register(name, help, metric.clone());
    metric
}

impl Default for Telemetry {
    fn default() -> Self {
        let mut to = Registry::default();
        let telemetry = Self {
            started: Instant::now(),
            since: SystemTime::now(),
            requests: added("tmpi_requests", "Requests answered", Family::default(), &mut to),
            durations: added("tmpi_request_seconds", "Time to the header of the response", durations(), &mut to),
            jobs: added("tmpi_jobs", "Jobs ended, photos and files, by class", Family::default(), &mut to),
            job_durations: added("tmpi_job_seconds", "Duration of jobs by class", durations(), &mut to),
            view_phases: added("tmpi_view_seconds", "Duration of the phases of drawing a view", durations(), &mut to),
            uploaded: added("tmpi_uploaded_bytes", "Bytes of accepted uploads", Counter::default(), &mut to),
            retired: added("tmpi_photos_retired", "Photos that went by themselves", Family::default(), &mut to),
            freed: added("tmpi_retired_bytes", "Bytes of photos that went by themselves", Counter::default(), &mut to),
            connections: added("tmpi_connections", "Open connections", Gauge::default(), &mut to),
            in_flight: added("tmpi_requests_in_flight", "Requests under way", Gauge::default(), &mut to),
            deliveries: added(
                "tmpi_deliveries",
                "Attempts to deliver events to webhooks, by what became of the delivery",
                Family::default(),
                &mut to,
            ),
            traces: None,
            registry: to,
        };
        // created now: Prometheus does not see the first increment of a new counter, and alerts look for durations that do not come
        for reason in ["age", "space"] {
            drop(telemetry.retired.get_or_create(&[("reason", reason)]));
        }
        for class in [Class::Interactive, Class::Batch] {
            drop(telemetry.job_durations.get_or_create(&[("class", class.name())]));
        }
        telemetry
    }
}

/// Counts one, until it is dropped.
pub struct GaugeGuard(Gauge);

impl GaugeGuard {
    fn of(gauge: &Gauge) -> Self {
        gauge.inc();
        Self(gauge.clone())
    }
}

impl Drop for GaugeGuard {
    fn drop(&mut self) {
        self.0.dec();
    }
}

impl Telemetry {
    /// With a trace exporter if there is a collector.
    ///
    /// # Errors
    /// [`CollectorError`].
    pub fn of(collector: Option<&Collector>) -> Result<Self, CollectorError> {
        Ok(Self { traces: collector.map(Traces::open).transpose()?, ..Self::default() })
    }

    /// Creates spans; `None` without a collector.
    pub const fn traces(&self) -> Option<&Traces> {
        self.traces.as_ref()
    }

    /// Starts the span of making a photo, for the `attempt`th time from 1, within `parent`.
    pub fn begin_job(&self, parent: Option<&str>, id: PhotoId, attempt: u32) -> JobSpan {
        self.traces.as_ref().map_or_else(JobSpan::default, |traces| traces.job(parent, id, attempt))
    }

    pub fn request(&self, method: &'static str, route: &str, status: u16, took: Duration) {
        self.requests.get_or_create(&Answered { method, route: route.to_owned(), status }).inc();
        self.durations.get_or_create(&[("route", route.to_owned())]).observe(took.as_secs_f64());
    }

    /// Records the outcome of a job by its class: of a photo, or `export`.
    pub fn job(&self, class: &'static str, outcome: &'static str, took: Duration) {
        self.jobs.get_or_create(&[("class", class), ("outcome", outcome)]).inc();
        self.job_durations.get_or_create(&[("class", class)]).observe(took.as_secs_f64());
    }

    /// Records a phase of rendering a view: `decode`, `wait`, `render` or `encode`.
    pub fn view(&self, phase: &'static str, took: Duration) {
        self.view_phases.get_or_create(&[("phase", phase)]).observe(took.as_secs_f64());
    }

    pub fn uploaded(&self, bytes: u64) {
        self.uploaded.inc_by(bytes);
    }

    pub fn swept(&self, swept: &Swept) {
        for (reason, count) in [("age", swept.by_age), ("space", swept.by_space)] {
            self.retired.get_or_create(&[("reason", reason)]).inc_by(count);
        }
        self.freed.inc_by(swept.bytes);
    }

    /// Records an attempt to deliver an event to a webhook: `delivered`, `retried` or `failed`.
    pub fn delivery(&self, outcome: &'static str) {
        self.deliveries.get_or_create(&[("outcome", outcome)]).inc();
    }

    /// Counts a connection, until the result is dropped.
    pub fn connection(&self) -> GaugeGuard {
        GaugeGuard::of(&self.connections)
    }

    /// Counts a running request, until the result is dropped.
    pub fn in_flight(&self) -> GaugeGuard {
        GaugeGuard::of(&self.in_flight)
    }

    /// All metrics as text, with `figures` from elsewhere.
    pub fn text(&self, figures: &[Metric]) -> Result<String, std::fmt::Error> {
        let mut now = Registry::default();
        let since = self.since.duration_since(UNIX_EPOCH).unwrap_or_default();
        let own = [
            ("tmpi_uptime_seconds", "Time since the start", self.started.elapsed().as_secs_f64()),
            ("process_start_time_seconds", "When the server started, in seconds since 1970", since.as_secs_f64()),
        ];
        for (name, help, value) in figures.iter().chain(&own) {
            now.register(*name, *help, ConstGauge::new(*value));
        }
        if let Some(seconds) = cpu_seconds() {
            now.register("process_cpu_seconds", "Time of the processor, of processes that make photos not", ConstCounter::new(seconds));
        }
        let mut out = String::with_capacity(8192);
        encode_registry(&mut out, &self.registry)?;
        encode_registry(&mut out, &now)?;
        encode_eof(&mut out)?;
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_is_what_prometheus_reads() {
        let t = Telemetry::default();
        t.request("GET", "/healthz", 200, Duration::from_millis(3));
        t.request("GET", "/healthz", 200, Duration::from_hours(1));
        t.job("batch", "done", Duration::from_millis(700));
        let alive = t.connection();
        let text = t.text(&[("tmpi_queue_depth", "Waiting jobs", 2.0)]).unwrap();
        drop(alive);
        for line in [
            "tmpi_requests_total{method=\"GET\",route=\"/healthz\",status=\"200\"} 2",
            "tmpi_request_seconds_bucket{le=\"0.0025\",route=\"/healthz\"} 0",
            "tmpi_request_seconds_bucket{le=\"0.005\",route=\"/healthz\"} 1",
            "tmpi_request_seconds_bucket{le=\"+Inf\",route=\"/healthz\"} 2",
            "tmpi_job_seconds_bucket{le=\"1.0\",class=\"batch\"} 1",
            "tmpi_job_seconds_count{class=\"interactive\"} 0",
            "tmpi_jobs_total{class=\"batch\",outcome=\"done\"} 1",
            "tmpi_connections 1",
            "tmpi_queue_depth 2.0",
            "# TYPE process_start_time_seconds gauge",
            "# EOF",
        ] {
            assert!(text.lines().any(|l| l == line), "{line} is missing in\n{text}");
        }
        for line in text.lines().filter(|l| !l.starts_with('#')) {
            assert!(line.rsplit_once(' ').is_some_and(|(_, v)| v.parse::<f64>().is_ok()), "{line}");
        }
        assert!(t.text(&[]).unwrap().contains("tmpi_connections 0"));
    }
}
