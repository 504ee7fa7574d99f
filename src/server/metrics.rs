//! Metrics in the `OpenMetrics` text format, for Prometheus.

use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::encoding::text::{encode_eof, encode_registry};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;

use super::traces::{Collector, CollectorError, JobSpan, Parent, Traces};
use tmpi_library::{PhotoId, Swept};

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

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Route {
    route: String,
}

/// A metric that is counted elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Metric {
    /// Name; that of a counter without its `_total`.
    pub name: &'static str,
    /// Help text.
    pub help: &'static str,
    /// Value.
    pub value: Value,
}

/// Value of a [`Metric`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// May rise and fall.
    Gauge(f64),
    /// Only rises.
    Counter(f64),
}

/// A gauge.
#[must_use]
pub const fn gauge(name: &'static str, help: &'static str, value: f64) -> Metric {
    Metric { name, help, value: Value::Gauge(value) }
}

/// A counter.
#[must_use]
pub const fn counter(name: &'static str, help: &'static str, value: f64) -> Metric {
    Metric { name, help, value: Value::Counter(value) }
}

/// An outcome label.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub(super) struct Outcome {
    /// One word.
    pub outcome: &'static str,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Retired {
    reason: &'static str,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Phase {
    phase: &'static str,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Classed {
    class: &'static str,
    outcome: &'static str,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct OfClass {
    class: &'static str,
}

fn histogram() -> Histogram {
    Histogram::new(BUCKETS)
}

type Durations<L> = Family<L, Histogram, fn() -> Histogram>;

/// All metrics of a server.
pub struct Telemetry {
    started: Instant,
    since: SystemTime,
    registry: Registry,
    requests: Family<Answered, Counter>,
    durations: Durations<Route>,
    jobs: Family<Outcome, Counter>,
    job_durations: Histogram,
    class_jobs: Family<Classed, Counter>,
    class_durations: Durations<OfClass>,
    view_phases: Durations<Phase>,
    uploaded: Counter,
    retired: Family<Retired, Counter>,
    freed: Counter,
    connections: Gauge,
    in_flight: Gauge,
    deliveries: Family<Outcome, Counter>,
    spans: Family<Outcome, Counter>,
    traces: Option<Traces>,
}

impl Default for Telemetry {
    fn default() -> Self {
        let mut registry = Registry::default();
        let t = Self {
            started: Instant::now(),
            since: SystemTime::now(),
            requests: Family::default(),
            durations: Family::new_with_constructor(histogram),
            jobs: Family::default(),
            job_durations: histogram(),
            class_jobs: Family::default(),
            class_durations: Family::new_with_constructor(histogram),
            view_phases: Family::new_with_constructor(histogram),
            uploaded: Counter::default(),
            retired: Family::default(),
            freed: Counter::default(),
            connections: Gauge::default(),
            in_flight: Gauge::default(),
            deliveries: Family::default(),
            spans: Family::default(),
            traces: None,
            registry: Registry::default(),
        };
        registry.register("tmpi_requests", "Requests answered", t.requests.clone());
        registry.register("tmpi_request_seconds", "Time to the header of the response", t.durations.clone());
        registry.register("tmpi_jobs", "Jobs ended", t.jobs.clone());
        registry.register("tmpi_job_seconds", "Duration of jobs", t.job_durations.clone());
        registry.register("tmpi_class_jobs", "Jobs ended, photos and files, by class", t.class_jobs.clone());
        registry.register("tmpi_class_job_seconds", "Duration of jobs by class", t.class_durations.clone());
        registry.register("tmpi_view_seconds", "Duration of the phases of drawing a view", t.view_phases.clone());
        registry.register("tmpi_uploaded_bytes", "Bytes of accepted uploads", t.uploaded.clone());
        registry.register("tmpi_photos_retired", "Photos that went by themselves", t.retired.clone());
        for reason in ["age", "space"] {
            // create it now: Prometheus does not see the first increment of a new counter
            drop(t.retired.get_or_create(&Retired { reason }));
        }
        registry.register("tmpi_retired_bytes", "Bytes of photos that went by themselves", t.freed.clone());
        registry.register("tmpi_connections", "Open connections", t.connections.clone());
        registry.register("tmpi_requests_in_flight", "Requests under way", t.in_flight.clone());
        registry.register(
            "tmpi_deliveries",
            "Attempts to deliver events to webhooks, by what became of the delivery",
            t.deliveries.clone(),
        );
        registry.register("tmpi_trace_spans", "Spans of traces, by what became of them", t.spans.clone());
        Self { registry, ..t }
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
    /// With a trace exporter if there is a collector; uses the caller's runtime.
    ///
    /// # Errors
    /// [`CollectorError`].
    pub fn of(collector: Option<&Collector>) -> Result<Self, CollectorError> {
        let mut telemetry = Self::default();
        telemetry.traces = collector.map(|to| Traces::open(to, telemetry.spans.clone())).transpose()?;
        Ok(telemetry)
    }

    /// Creates spans; `None` without a collector.
    #[must_use]
    pub const fn traces(&self) -> Option<&Traces> {
        self.traces.as_ref()
    }

    /// Starts the span of making a photo, for the `attempt`th time from 1, within `parent`.
    #[must_use]
    pub fn begin_job(&self, parent: Option<&Parent>, id: PhotoId, attempt: u32) -> JobSpan {
        self.traces.as_ref().map_or_else(JobSpan::default, |traces| JobSpan::new(traces.job(parent, id, attempt)))
    }

    /// Records an answered request.
    pub fn request(&self, method: &'static str, route: &str, status: u16, took: Duration) {
        self.requests.get_or_create(&Answered { method, route: route.to_owned(), status }).inc();
        self.durations.get_or_create(&Route { route: route.to_owned() }).observe(took.as_secs_f64());
    }

    /// Records a job that ended as `outcome`.
    pub fn job(&self, outcome: &'static str, took: Duration) {
        self.jobs.get_or_create(&Outcome { outcome }).inc();
        self.job_durations.observe(took.as_secs_f64());
    }

    /// Records the outcome of a job by its class: a photo, which [`Self::job`] counts, too, or a file.
    pub fn class_job(&self, class: &'static str, outcome: &'static str, took: Duration) {
        self.class_jobs.get_or_create(&Classed { class, outcome }).inc();
        self.class_durations.get_or_create(&OfClass { class }).observe(took.as_secs_f64());
    }

    /// Records a phase of rendering a view: `decode`, `wait`, `render` or `encode`.
    pub fn view(&self, phase: &'static str, took: Duration) {
        self.view_phases.get_or_create(&Phase { phase }).observe(took.as_secs_f64());
    }

    /// Records bytes of accepted uploads.
    pub fn uploaded(&self, bytes: u64) {
        self.uploaded.inc_by(bytes);
    }

    /// Records photos that retention deleted.
    pub fn swept(&self, swept: &Swept) {
        for (reason, count) in [("age", swept.by_age), ("space", swept.by_space)] {
            self.retired.get_or_create(&Retired { reason }).inc_by(count);
        }
        self.freed.inc_by(swept.bytes);
    }

    /// Records an attempt to deliver an event to a webhook: `delivered`, `retried` or `failed`.
    pub fn delivery(&self, outcome: &'static str) {
        self.deliveries.get_or_create(&Outcome { outcome }).inc();
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
    ///
    /// # Errors
    /// Does not happen in practice.
    pub fn text(&self, figures: &[Metric]) -> Result<String, std::fmt::Error> {
        let mut now = Registry::default();
        let since = self.since.duration_since(UNIX_EPOCH).unwrap_or_default();
        let own = [
            gauge("tmpi_uptime_seconds", "Time since the start", self.started.elapsed().as_secs_f64()),
            gauge("process_start_time_seconds", "When the server started, in seconds since 1970", since.as_secs_f64()),
        ];
        for Metric { name, help, value } in figures.iter().chain(&own) {
            match value {
                Value::Gauge(value) => {
                    let gauge = Gauge::<f64, AtomicU64>::default();
                    gauge.set(*value);
                    now.register(*name, *help, gauge);
                }
                Value::Counter(value) => {
                    let counter = Counter::<f64, AtomicU64>::default();
                    counter.inc_by(*value);
                    now.register(*name, *help, counter);
                }
            }
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
        t.job("done", Duration::from_millis(700));
        let alive = t.connection();
        let text = t.text(&[gauge("tmpi_queue_depth", "Waiting jobs", 2.0), counter("words_sent", "Words", 3.0)]).unwrap();
        drop(alive);
        for line in [
            "tmpi_requests_total{method=\"GET\",route=\"/healthz\",status=\"200\"} 2",
            "tmpi_request_seconds_bucket{le=\"0.0025\",route=\"/healthz\"} 0",
            "tmpi_request_seconds_bucket{le=\"0.005\",route=\"/healthz\"} 1",
            "tmpi_request_seconds_bucket{le=\"+Inf\",route=\"/healthz\"} 2",
            "tmpi_job_seconds_bucket{le=\"1.0\"} 1",
            "tmpi_jobs_total{outcome=\"done\"} 1",
            "tmpi_connections 1",
            "tmpi_queue_depth 2.0",
            "# TYPE words_sent counter",
            "words_sent_total 3.0",
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
