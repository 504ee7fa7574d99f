//! Traces, with a stand-in for the collector.

use std::net::TcpListener;
use std::sync::Mutex;

use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use opentelemetry_proto::tonic::trace::v1::status::StatusCode;
use opentelemetry_proto::tonic::trace::v1::{ResourceSpans, Span};
use prost::Message as _;
use tmpi::server::{Collector, hex};
use tmpi_testing::{Answer, Request, StandIn};

use crate::prelude::*;
use crate::process::Process;

/// How a collector answers.
#[derive(Clone, Copy)]
enum Mood {
    Takes,
    Refuses,
    Hangs,
}

/// A stand-in for a collector.
struct TraceCollector {
    server: StandIn,
    mood: Arc<Mutex<Mood>>,
}

impl TraceCollector {
    fn start(mood: Mood) -> Self {
        let mood = Arc::new(Mutex::new(mood));
        let now = Arc::clone(&mood);
        let server = StandIn::start(move |_| match *now.lock().unwrap() {
            Mood::Takes => Answer::of(200),
            Mood::Refuses => Answer::of(400),
            Mood::Hangs => Answer::Stalled(Vec::new()),
        });
        Self { server, mood }
    }

    /// What it has taken.
    fn resources(&self) -> Vec<ResourceSpans> {
        let taken = self.server.answered().into_iter().filter(|request| request.status == 200);
        let read = |request: Request| {
            assert_eq!((request.line.as_str(), request.header("content-type")), ("POST /v1/traces HTTP/1.1", "application/x-protobuf"));
            ExportTraceServiceRequest::decode(request.body.as_slice()).unwrap().resource_spans
        };
        taken.flat_map(read).collect()
    }

    fn spans(&self) -> Vec<Span> {
        self.resources().into_iter().flat_map(|resource| resource.scope_spans).flat_map(|scope| scope.spans).collect()
    }

    /// Waits for `count` spans of a name.
    fn wait(&self, name: &str, count: usize) -> Vec<Span> {
        let named = || self.spans().into_iter().filter(|s| s.name == name).collect::<Vec<_>>();
        wait_until(&format!("{count} times {name:?}"), || named().len() >= count);
        named()
    }

    fn traces(&self, ratio: f64) -> Collector {
        Collector { url: self.server.url(""), ratio }
    }
}

fn text(attributes: &[KeyValue], key: &str) -> String {
    let value = attributes.iter().find(|a| a.key == key).and_then(|a| a.value.clone()).and_then(|v| v.value);
    match value {
        Some(Value::StringValue(text)) => text,
        Some(Value::IntValue(n)) => n.to_string(),
        other => panic!("{key}: {other:?}"),
    }
}

fn attribute(span: &Span, key: &str) -> String {
    text(&span.attributes, key)
}

fn start(traces: Collector, maker: Arc<dyn Maker>) -> Running {
    Running::configured(maker, |config| Config { traces: Some(traces), ..config })
}

#[test]
fn an_upload_is_one_trace_of_request_job_and_stages() {
    let collector = TraceCollector::start(Mood::Takes);
    let server = start(collector.traces(1.0), Arc::new(pipeline()));
    let id = server.make(&jpeg(1));
    let (upload, job) = (&collector.wait("POST /v1/photos", 1)[0], &collector.wait("job", 1)[0]);
    assert!(upload.parent_span_id.is_empty(), "a root span");
    assert_eq!((upload.kind, job.kind), (SpanKind::Server as i32, SpanKind::Consumer as i32));
    for (key, value) in
        [("http.request.method", "POST"), ("http.route", "/v1/photos"), ("http.response.status_code", "202"), ("tmpi.peer", "loopback")]
    {
        assert_eq!(attribute(upload, key), value);
    }
    assert_eq!((&job.trace_id, &job.parent_span_id), (&upload.trace_id, &upload.span_id));
    for (key, value) in [("tmpi.photo", id.as_str()), ("tmpi.job.class", "photo"), ("tmpi.job.attempt", "1"), ("tmpi.job.outcome", "done")]
    {
        assert_eq!(attribute(job, key), value);
    }
    let all = collector.spans();
    let mut stages: Vec<&Span> = all.iter().filter(|s| s.parent_span_id == job.span_id).collect();
    stages.sort_by_key(|s| s.start_time_unix_nano);
    let names: Vec<&str> = stages.iter().map(|s| s.name.as_str()).collect();
    let known: Vec<&str> = tmpi_pipeline::STAGES.iter().copied().filter(|stage| names.contains(stage)).collect();
    assert!(names.len() > 4 && names == known, "{names:?}");
    for pair in stages.windows(2) {
        assert!(pair[0].trace_id == job.trace_id && pair[0].end_time_unix_nano <= pair[1].start_time_unix_nano, "{pair:?}");
    }
    assert!(stages.last().unwrap().end_time_unix_nano <= job.end_time_unix_nano);
    // the job of a photo that is made again belongs to the request that asked for it
    let patch = br#"{"strokes": [{"points": [[0.5, 0.5]], "radius": 0.1, "to": 0}]}"#;
    assert_eq!(request(server.addr, "PATCH", &format!("/v1/photos/{id}/strokes"), &[JSON], patch).status, 202);
    let (patched, jobs) = (&collector.wait("PATCH /v1/photos/{id}/strokes", 1)[0], collector.wait("job", 2));
    assert_eq!(jobs[1].parent_span_id, patched.span_id);
    // work that waits for a slot has its own span
    server.wait(&id, "done");
    assert_eq!(get(server.addr, &format!("/v1/photos/{id}/view?w=16")).status, 200);
    let (view, work) = (&collector.wait("GET /v1/photos/{id}/view", 1)[0], &collector.wait("work", 1)[0]);
    assert_eq!((&work.parent_span_id, attribute(work, "tmpi.job.class").as_str()), (&view.span_id, "interactive"));
    get(server.addr, "/healthz");
    get(server.addr, "/metrics");
    server.stop();
    let health = collector.spans().into_iter().filter(|s| ["GET /healthz", "GET /metrics"].contains(&s.name.as_str())).count();
    assert_eq!(health, 0, "health checks and metrics have no spans");
}

#[test]
fn a_clients_trace_continues_after_a_restart() {
    let collector = TraceCollector::start(Mood::Takes);
    let (trace, outer) = ("0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331");
    // traces that begin here are not sampled
    let limits = Limits { drain: Duration::from_millis(100), ..Limits::default() };
    let traces = Some(collector.traces(0.0));
    let accepts = Running::configured(Gate::new(0), |config| Config { traces, limits, ..config });
    let upload = |seed, sampled| {
        let parent = format!("00-{trace}-{outer}-{sampled}");
        id(&request(accepts.addr, "POST", "/v1/photos", &[("traceparent", &parent)], &jpeg(seed)).is(202).json())
    };
    let (told, untold) = (upload(1, "01"), upload(2, "00"));
    let worker = accepts.restarted();
    worker.wait(&told, "done");
    worker.wait(&untold, "done");
    worker.stop();
    let uploads = collector.wait("POST /v1/photos", 1);
    assert_eq!(uploads.len(), 1, "an unsampled trace is not sent");
    assert_eq!((hex(&uploads[0].trace_id), hex(&uploads[0].parent_span_id)), (trace.into(), outer.into()));
    let jobs = collector.wait("job", 1);
    let done = jobs.iter().find(|job| attribute(job, "tmpi.job.outcome") == "done").unwrap();
    assert_eq!((&done.trace_id, &done.parent_span_id), (&uploads[0].trace_id, &uploads[0].span_id));
    assert_eq!(attribute(done, "tmpi.photo"), told);
    assert!(collector.spans().iter().all(|s| hex(&s.trace_id) == trace));
}

#[test]
fn a_missing_or_refusing_collector_changes_no_answer() {
    let unused = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let away = Collector { url: format!("http://{unused}"), ratio: 1.0 };
    let refuses = TraceCollector::start(Mood::Refuses);
    for (name, traces) in [("away", away), ("refuses", refuses.traces(1.0))] {
        let server = start(traces, Arc::new(pipeline()));
        server.make(&jpeg(1));
        if name == "refuses" {
            wait_until("spans are refused", || refuses.server.answered().iter().any(|request| request.status == 400));
            *refuses.mood.lock().unwrap() = Mood::Takes;
            get(server.addr, "/v1/photos");
            refuses.wait("GET /v1/photos", 1);
        }
        server.stop();
    }
}

#[test]
fn a_hanging_collector_delays_neither_answers_nor_the_stop() {
    let collector = TraceCollector::start(Mood::Hangs);
    let server = start(collector.traces(1.0), Arc::new(pipeline()));
    let mut connection = Connection::open(server.addr);
    // more spans than may wait
    for _ in 0..3000 {
        assert_eq!(connection.request("GET", "/v1/photos", &[], &[]).status, 200);
    }
    server.make(&jpeg(1));
    let start = Instant::now();
    server.stop();
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
}

#[test]
fn server_errors_are_marked_in_spans() {
    let collector = TraceCollector::start(Mood::Takes);
    let server = start(collector.traces(1.0), Gate::new(0));
    get(server.addr, "/oembed?format=xml").problem(501);
    get(server.addr, "/v1/photos/0123456789abcdef0123456789abcdef").problem(404);
    let status = |name: &str| collector.wait(name, 1)[0].status.clone().map_or(0, |s| s.code);
    assert_eq!(status("GET /oembed"), StatusCode::Error as i32);
    assert_eq!(status("GET /v1/photos/{id}"), StatusCode::Unset as i32, "a client's error");
}

#[cfg(unix)]
#[test]
fn the_program_sends_stages_of_child_processes_and_flushes_spans_when_it_stops() {
    for named in [true, false] {
        let (dir, collector) = (tempfile::tempdir().unwrap(), TraceCollector::start(Mood::Takes));
        let url = collector.server.url("");
        let url = url.as_str();
        let (arguments, environment) = if named {
            (vec!["--otlp", url], Vec::new())
        } else {
            (Vec::new(), vec![("OTEL_EXPORTER_OTLP_ENDPOINT", url), ("OTEL_SERVICE_NAME", "attic")])
        };
        let server = Process::start_at(0, dir.path(), &arguments, &environment);
        let photo = post_form(server.addr, &[], &[("photo", &jpeg(1)), ("depth", &depth_map())]).is(202).json();
        let photo = format!("/v1/photos/{}", id(&photo));
        wait_until("it is made", || get(server.addr, &photo).json()["state"] == "done");
        assert_eq!(get(server.addr, "/v1/photos").status, 200);
        let (status, log) = server.terminate();
        assert!(status.success(), "{log}");
        // all spans were sent before the process ended
        let spans = collector.spans();
        let of = |name: &str| spans.iter().find(|s| s.name == name).unwrap_or_else(|| panic!("{name}: {spans:?}"));
        let (upload, job, _) = (of("POST /v1/photos"), of("job"), of("GET /v1/photos"));
        assert_eq!(job.parent_span_id, upload.span_id);
        assert!(spans.iter().filter(|s| s.parent_span_id == job.span_id).count() > 4, "{spans:?}");
        assert!(log.contains(&hex(&upload.trace_id)), "the request's log line has its trace id: {log}");
        let sender = collector.resources().pop().unwrap().resource.unwrap();
        assert_eq!(text(&sender.attributes, "service.name"), if named { "tmpi" } else { "attic" });
    }
}
