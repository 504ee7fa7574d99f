//! Traces, with a stand-in for the collector.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::{KeyValue, any_value::Value};
use opentelemetry_proto::tonic::trace::v1::{Span, span::SpanKind, status::StatusCode};
use prost::Message as _;
use tmpi::server::{Collector, Config, Limits, Maker, Server, hex};
use tmpi_render::Backend;

use crate::client::{Connection, get, post_form, request};
use crate::fixture::{Gate, Running, depth_map, jpeg, pipeline, wait_until};
use crate::process::Process;

/// How a collector answers.
#[derive(Clone, Copy)]
enum Mood {
    Takes,
    Refuses,
    Hangs,
}

/// A stand-in for a collector.
struct StandIn {
    url: String,
    spans: Mutex<Vec<Span>>,
    /// `service.name` of the last sender.
    service: Mutex<String>,
    mood: Mutex<Mood>,
    /// Requests that it refused.
    refused: AtomicUsize,
}

impl StandIn {
    fn start(mood: Mood) -> Arc<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let made = Arc::new(Self {
            url,
            spans: Mutex::default(),
            service: Mutex::default(),
            mood: Mutex::new(mood),
            refused: AtomicUsize::new(0),
        });
        let of = Arc::clone(&made);
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let of = Arc::clone(&of);
                std::thread::spawn(move || while of.take(stream.as_ref().unwrap()).is_some() {});
            }
        });
        made
    }

    fn spans(&self) -> Vec<Span> {
        self.spans.lock().unwrap().clone()
    }

    /// Waits for `count` spans of a name.
    fn wait(&self, name: &str, count: usize) -> Vec<Span> {
        let named = || self.spans().into_iter().filter(|s| s.name == name).collect::<Vec<_>>();
        wait_until(&format!("{count} times {name:?}"), || named().len() >= count);
        named()
    }

    fn traces(&self, ratio: f64) -> Collector {
        Collector { url: self.url.clone(), ratio }
    }

    /// Reads and answers one request; `None` at the end of the connection.
    fn take(&self, stream: &TcpStream) -> Option<()> {
        let mut reader = BufReader::new(stream);
        let mut line = String::new();
        reader.read_line(&mut line).ok().filter(|n| *n > 0)?;
        assert_eq!(line.trim(), "POST /v1/traces HTTP/1.1");
        let mut length = 0;
        loop {
            line.clear();
            reader.read_line(&mut line).ok()?;
            let Some((name, value)) = line.trim().split_once(':') else { break };
            match name.to_ascii_lowercase().as_str() {
                "content-length" => length = value.trim().parse().unwrap(),
                "content-type" => assert_eq!(value.trim(), "application/x-protobuf"),
                _ => {}
            }
        }
        let mut body = vec![0; length];
        reader.read_exact(&mut body).ok()?;
        let mood = *self.mood.lock().unwrap();
        let status = match mood {
            Mood::Takes => "200 OK",
            Mood::Refuses => {
                self.refused.fetch_add(1, Ordering::AcqRel);
                "400 Bad Request"
            }
            // until the client gives up
            Mood::Hangs => return reader.read_to_end(&mut body).ok().and(None),
        };
        if matches!(mood, Mood::Takes) {
            let export = ExportTraceServiceRequest::decode(body.as_slice()).unwrap();
            for resource in export.resource_spans {
                let of = resource.resource.unwrap();
                *self.service.lock().unwrap() = text(&of.attributes, "service.name");
                self.spans.lock().unwrap().extend(resource.scope_spans.into_iter().flat_map(|scope| scope.spans));
            }
        }
        let mut stream = stream;
        write!(stream, "HTTP/1.1 {status}\r\ncontent-length: 0\r\n\r\n").ok()
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

fn start(data: &Path, traces: Collector, maker: Arc<dyn Maker>) -> Running {
    start_with(data, traces, maker, Limits::default())
}

fn start_with(data: &Path, traces: Collector, maker: Arc<dyn Maker>, limits: Limits) -> Running {
    let config = Config { traces: Some(traces), limits, ..Config::new(([127, 0, 0, 1], 0).into(), data.to_owned()) };
    let renderer = tmpi_render::select(Backend::Cpu).unwrap();
    Running::of(async move { Server::bind(config, maker, renderer).await.unwrap() })
}

#[test]
fn an_upload_is_one_trace_of_request_job_and_stages() {
    let (dir, collector) = (tempfile::tempdir().unwrap(), StandIn::start(Mood::Takes));
    let server = start(dir.path(), collector.traces(1.0), Arc::new(pipeline()));
    let id = server.upload(&jpeg(1));
    server.wait(&id, "done");
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
    let json = [("content-type", "application/json")];
    assert_eq!(request(server.addr, "PATCH", &format!("/v1/photos/{id}/strokes"), &json, patch).status, 202);
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
    let (dir, collector) = (tempfile::tempdir().unwrap(), StandIn::start(Mood::Takes));
    let (trace, outer) = ("0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331");
    // traces that begin here are not sampled
    let limits = Limits { drain: Duration::from_millis(100), ..Limits::default() };
    let accepts = start_with(dir.path(), collector.traces(0.0), Gate::new(0), limits);
    let upload = |seed, sampled| {
        let parent = format!("00-{trace}-{outer}-{sampled}");
        let answer = request(accepts.addr, "POST", "/v1/photos", &[("traceparent", &parent)], &jpeg(seed));
        assert_eq!(answer.status, 202);
        answer.json()["id"].as_str().unwrap().to_owned()
    };
    let (told, untold) = (upload(1, "01"), upload(2, "00"));
    accepts.stop();
    let worker = start(dir.path(), collector.traces(0.0), Arc::new(pipeline()));
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
    let dir = tempfile::tempdir().unwrap();
    let unused = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let away = Collector { url: format!("http://{unused}"), ratio: 1.0 };
    let refuses = StandIn::start(Mood::Refuses);
    for (name, traces) in [("away", away), ("refuses", refuses.traces(1.0))] {
        let server = start(&dir.path().join(name), traces, Arc::new(pipeline()));
        let id = server.upload(&jpeg(1));
        server.wait(&id, "done");
        if name == "refuses" {
            wait_until("spans are refused", || refuses.refused.load(Ordering::Acquire) > 0);
            *refuses.mood.lock().unwrap() = Mood::Takes;
            get(server.addr, "/v1/photos");
            refuses.wait("GET /v1/photos", 1);
        }
        server.stop();
    }
}

#[test]
fn a_hanging_collector_delays_neither_answers_nor_the_stop() {
    let (dir, collector) = (tempfile::tempdir().unwrap(), StandIn::start(Mood::Hangs));
    let server = start(dir.path(), collector.traces(1.0), Arc::new(pipeline()));
    let mut connection = Connection::open(server.addr);
    // more spans than may wait
    for _ in 0..3000 {
        assert_eq!(connection.request("GET", "/v1/photos", &[], &[]).status, 200);
    }
    let id = server.upload(&jpeg(1));
    server.wait(&id, "done");
    let start = Instant::now();
    server.stop();
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
}

#[test]
fn server_errors_are_marked_in_spans() {
    let (dir, collector) = (tempfile::tempdir().unwrap(), StandIn::start(Mood::Takes));
    let config = Config { traces: Some(collector.traces(1.0)), ..Config::new(([127, 0, 0, 1], 0).into(), dir.path().to_owned()) };
    let renderer = tmpi_render::select(Backend::Cpu).unwrap();
    let server = Running::of(async move { Server::bind(config, Gate::new(0), renderer).await.unwrap() });
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
        let (dir, collector) = (tempfile::tempdir().unwrap(), StandIn::start(Mood::Takes));
        let url = collector.url.as_str();
        let (arguments, environment) = if named {
            (vec!["--otlp", url], Vec::new())
        } else {
            (Vec::new(), vec![("OTEL_EXPORTER_OTLP_ENDPOINT", url), ("OTEL_SERVICE_NAME", "attic")])
        };
        let server = Process::start_in(dir.path(), &arguments, &environment);
        let answer = post_form(server.addr, &[], &[("photo", &jpeg(1)), ("depth", &depth_map())]);
        assert_eq!(answer.status, 202);
        let photo = format!("/v1/photos/{}", answer.json()["id"].as_str().unwrap());
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
        assert_eq!(*collector.service.lock().unwrap(), if named { "tmpi" } else { "attic" });
    }
}
