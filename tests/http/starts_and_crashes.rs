//! Starts, stops and crashes of `tmpi serve` as a process, and of the processes that make its photos.

use std::collections::BTreeSet;
use std::io::Write;
use std::process::Command;
#[cfg(unix)]
use std::process::Stdio;
use std::sync::Mutex;
use std::sync::atomic::AtomicUsize;

#[cfg(target_os = "linux")]
use rustix::process::Signal;

use crate::prelude::*;
#[cfg(target_os = "linux")]
use crate::process::Held;
use crate::process::{Process, large, sized, slow, upload, upload_with};

#[test]
#[cfg(target_os = "linux")]
fn processes_that_make_photos_get_no_credentials() {
    let dir = tempfile::tempdir().unwrap();
    let environment = [
        ("AWS_SECRET_ACCESS_KEY", "a-secret"),
        ("OTEL_EXPORTER_OTLP_HEADERS", "authorization=a-secret"),
        ("TMPI_SERVE_LIMITS_JOB_MEMORY", "5000"),
        ("TMPI_MODELS", "/nowhere"),
    ];
    let server = Process::start_at(0, dir.path(), &["--network-url", "http://user:a-secret@localhost/"], &environment);
    let read =
        |file: &str| String::from_utf8_lossy(&std::fs::read(format!("/proc/{}/{file}", server.maker().unwrap())).unwrap()).into_owned();
    // between fork and exec, the child still has the server's environment
    wait_until("there is a process that makes photos", || server.maker().is_some() && read("environ").contains("TMPI_MAKES_PHOTOS=1"));
    let (environment, line) = (read("environ"), read("cmdline"));
    assert!(!environment.contains("a-secret") && !line.contains("a-secret"), "{environment} {line}");
    assert!(environment.contains("TMPI_MODELS=/nowhere") && line.contains("--set=limits.job-memory=5000"), "{environment} {line}");
}

#[test]
#[cfg(unix)]
fn json_logs_have_one_object_per_line() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start_with(dir.path(), &["--log", "json", "--set", "limits.drain=5"]);
    request(server.addr, "GET", "/nothing\"}", &[("x-request-id", "mine-1")], b"").is(404);
    let (_, log) = server.terminate();
    let lines: Vec<serde_json::Value> = log.lines().map(|l| serde_json::from_str(l).unwrap_or_else(|e| panic!("{e}: {l}"))).collect();
    let line = lines.iter().find(|l| l["span"]["id"] == "mine-1").unwrap_or_else(|| panic!("{log}"));
    assert_eq!((&line["status"], &line["span"]["peer"], &line["span"]["method"]), (&404.into(), &"127.0.0.1".into(), &"GET".into()));
    assert!(line["timestamp"].is_string() && line["ms"].is_number() && line["level"] == "INFO", "{line}");
}

#[test]
fn a_server_without_its_library_is_not_ready_and_logs_why() {
    let data = tempfile::tempdir().unwrap();
    let server = Process::start_at(0, data.path(), &[], &[("ORT_DYLIB_PATH", "/nowhere/libonnxruntime.so")]);
    wait_until("it is not ready", || get(server.addr, "/readyz").status == 503);
    let detail = get(server.addr, "/readyz").problem(503)["detail"].as_str().unwrap().to_owned();
    assert!(detail.contains("ONNX Runtime is missing") && !detail.contains("/nowhere"), "the answer contains no path: {detail}");
    let log = server.logged();
    assert_eq!(log.matches("/nowhere/libonnxruntime.so").count(), 1, "{log}");
    assert!(log.contains("ORT_DYLIB_PATH"), "the log says what to do: {log}");
}

#[test]
fn a_crash_during_ten_uploads_loses_and_doubles_none() {
    let photos: Vec<Vec<u8>> = (0..10).map(large).collect();
    // three at a time, so that at most two more uploads are answered after the crash is due
    for crash_after in [1, 4, 7] {
        let dir = tempfile::tempdir().unwrap();
        let server = Mutex::new(Process::start(dir.path()));
        let addr = server.lock().unwrap().addr;
        let answered = Mutex::new(BTreeSet::new());
        let next = AtomicUsize::new(0);
        // one upload that never ends
        let mut half = Connection::open(addr);
        half.raw().write_all(b"POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ncontent-length: 100000\r\n\r\nhalf of it").unwrap();
        std::thread::scope(|scope| {
            for _ in 0..3 {
                scope.spawn(|| {
                    while let Some(photo) = photos.get(next.fetch_add(1, Ordering::SeqCst)) {
                        let Some(id) = upload(addr, photo) else { return };
                        // the lock is held during the crash, so that no thread starts another upload before it
                        let mut answered = answered.lock().unwrap();
                        answered.insert(id);
                        if answered.len() == crash_after {
                            server.lock().unwrap().crash();
                        }
                    }
                });
            }
        });
        let answered = answered.into_inner().unwrap();
        assert!(answered.len() >= crash_after && answered.len() < 10, "{} answered", answered.len());

        let server = Process::start(dir.path());
        assert_eq!(incoming(dir.path()), 0, "leftovers are removed");
        let found = listed(server.addr);
        assert_eq!(found.iter().collect::<BTreeSet<_>>().len(), found.len(), "none is there twice");
        let lost: Vec<_> = answered.iter().filter(|id| !found.contains(id)).collect();
        assert!(lost.is_empty(), "lost: {lost:?}");
        for id in &found {
            wait_until("a photo from before the crash is done", || state(server.addr, id)["state"] == "done");
        }
        // uploading all again gives the same ten photos
        let all: BTreeSet<String> = photos.iter().map(|p| upload(server.addr, p).unwrap()).collect();
        assert!(all.len() == 10 && answered.is_subset(&all));
        for id in &all {
            wait_until("all are done", || state(server.addr, id)["state"] == "done");
            let atlas = get(server.addr, &format!("/v1/photos/{id}/atlas")).body;
            assert!(tmpi_core::container::decode(&atlas).is_ok());
        }
        assert_eq!(listed(server.addr).len(), 10);
        assert_eq!(contents(dir.path(), "", "container").len(), 10);
    }
}

#[cfg(unix)]
#[test]
fn sigterm_exits_with_0_and_accepted_photos_are_finished_or_kept() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path());
    let id = upload(server.addr, &large(1)).unwrap();
    let second =
        Command::new(env!("CARGO_BIN_EXE_tmpi")).args(["serve", "--addr", "127.0.0.1:0", "--data"]).arg(dir.path()).output().unwrap();
    assert_eq!(second.status.code(), Some(1), "one process a data directory");
    assert!(String::from_utf8_lossy(&second.stderr).contains("another process"));
    assert_eq!(request(server.addr, "GET", "/healthz", &[], &[]).status, 200);
    let (status, log) = server.terminate();
    assert_eq!(status.code(), Some(0), "{log}");
    assert!(log.contains("stopping") && log.contains("stopped"), "{log}");
    let server = Process::start(dir.path());
    wait_until("it is done", || state(server.addr, &id)["state"] == "done");
}

#[test]
fn a_port_in_use_is_an_error_that_names_it() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let addr = taken.local_addr().unwrap().to_string();
    let dir = tempfile::tempdir().unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_tmpi")).args(["serve", "--addr", &addr, "--data"]).arg(dir.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains(&addr) && said.contains("another port with --addr") && said.matches("in use").count() == 1, "{said}");
    assert!(output.stdout.is_empty());
}

#[cfg(unix)]
#[test]
fn a_low_limit_of_open_files_is_raised_to_the_hard_limit() {
    let dir = tempfile::tempdir().unwrap();
    let log = tempfile::NamedTempFile::new().unwrap();
    let script = "ulimit -Sn 64 && exec \"$0\" serve --addr 127.0.0.1:0 --data \"$1\"";
    let child = Command::new("sh")
        .args(["-c", script, env!("CARGO_BIN_EXE_tmpi")])
        .arg(dir.path())
        .stdout(Stdio::piped())
        .stderr(log.reopen().unwrap())
        .spawn()
        .unwrap();
    let server = Process::listening(child, log);
    let mut open: Vec<Connection> = (0..150).map(|_| Connection::open(server.addr)).collect();
    for connection in &mut open {
        assert_eq!(connection.request("GET", "/healthz", &[], &[]).status, 200);
    }
}

#[test]
fn crashes_of_the_server_do_not_count_as_attempts() {
    let dir = tempfile::tempdir().unwrap();
    let mut ids: Vec<String> = Vec::new();
    // more rounds than a photo has attempts
    for round in 0..4 {
        let mut server = Process::start(dir.path());
        if round == 0 {
            ids.push(upload_with(server.addr, &slow(1), &[]));
            ids.extend((0..3).map(|seed| upload(server.addr, &large(seed)).unwrap()));
        }
        wait_until("the same photo is being made", || state(server.addr, &ids[0])["state"] == "working");
        server.crash();
    }
    let server = Process::start(dir.path());
    for id in &ids {
        wait_until("it is done", || {
            let state = state(server.addr, id)["state"].as_str().unwrap().to_owned();
            assert_ne!(state, "failed");
            state == "done"
        });
    }
}

#[cfg(target_os = "linux")]
#[test]
fn another_process_makes_the_photo_if_one_is_killed() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path());
    let maker = server.hold();
    let id = upload_with(server.addr, &slow(2), &[]);
    server.wait_for_photo();
    maker.signal(Signal::KILL);
    wait_until("it is done", || state(server.addr, &id)["state"] == "done");
    let log = server.logged();
    assert!(log.contains("crashed its process") && !log.contains("panicked"), "{log}");
}

#[cfg(target_os = "linux")]
#[test]
fn deleting_a_photo_stops_its_process_within_a_stage_and_the_next_one_is_made() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start(dir.path());
    let maker = server.hold();
    let long = upload_with(server.addr, &slow(3), &[]);
    server.wait_for_photo();
    assert_eq!(request(server.addr, "DELETE", &format!("/v1/photos/{long}"), &[], &[]).status, 204);
    wait_until("its process has ended", || maker.has_ended());
    let next = upload(server.addr, &large(4)).unwrap();
    wait_until("the next one is done", || state(server.addr, &next)["state"] == "done");
}

#[cfg(target_os = "linux")]
#[test]
fn a_job_that_takes_too_long_fails_and_the_next_one_is_made() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start_with(dir.path(), &["--set", "limits.job-timeout=1"]);
    let maker = server.hold();
    let long = upload_with(server.addr, &slow(5), &[]);
    server.wait_for_photo();
    wait_until("it has failed", || state(server.addr, &long)["state"] == "failed");
    assert_eq!(state(server.addr, &long)["problem"]["type"], "urn:tmpi:problem:late");
    wait_until("its process has ended", || maker.has_ended());
    let next = upload(server.addr, &large(6)).unwrap();
    wait_until("the next one is done", || state(server.addr, &next)["state"] == "done");
}

#[cfg(target_os = "linux")]
#[test]
fn a_photo_over_its_memory_bound_ends_only_its_own_process() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start_with(dir.path(), &["--set", "limits.job-memory=777"]);
    wait_until("the process has its memory bound", || {
        server.maker().and_then(|pid| Held(pid).figure("limits", "Max data size", 1)) == Some(777 << 20)
    });
    let maker = server.hold();
    // little more than it has now: as if the photo took more memory than estimated
    maker.bound_data(maker.figure("status", "VmData:", 1024).unwrap() + (24 << 20));
    let id = upload_with(server.addr, &slow(9), &[]);
    server.wait_for_photo();
    maker.signal(Signal::CONT);
    wait_until("the limit has ended it", || maker.has_ended());
    // the server goes on, and another process makes the photo
    wait_until("it is done", || state(server.addr, &id)["state"] == "done");
    let log = server.logged();
    assert!(log.contains("crashed its process") && !log.contains("panicked"), "{log}");
}

#[test]
fn a_photo_that_needs_too_much_memory_is_refused_with_limit_and_need() {
    let dir = tempfile::tempdir().unwrap();
    let server = Process::start_with(dir.path(), &["--set", "limits.job-memory=512"]);
    let (large, depth) = (sized(6, 4000, 3000), depth_map());
    let (content_type, body) = form(&[("photo", &large), ("depth", &depth), ("planes", b"8")]);
    let refused = request(server.addr, "POST", "/v1/photos", &[("content-type", &content_type)], &body).problem(413);
    let detail = refused["detail"].as_str().unwrap();
    let figures: Vec<u64> = detail.split(' ').filter_map(|word| word.parse().ok()).collect();
    assert!(figures.len() == 2 && figures[0] > figures[1] && figures[1] == 512 << 20, "{detail}");
    // without options the photo is made as large as fits
    let fitted = upload_with(server.addr, &large, &[]);
    wait_until("it is made", || state(server.addr, &fitted)["state"] == "done");
    let report = get(server.addr, &format!("/v1/photos/{fitted}/report")).json();
    let pixels = report["width"].as_u64().unwrap() * report["height"].as_u64().unwrap();
    assert!(report["input"]["fitted"] == true && (2_000_000..12_000_000).contains(&pixels), "{report}");
    // a reduced photo fits
    let reduced = upload_with(server.addr, &large, &[("max-size", b"800")]);
    wait_until("it is done", || state(server.addr, &reduced)["state"] == "done");
}

#[cfg(target_os = "linux")]
#[test]
fn a_second_signal_ends_it_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Process::start_with(dir.path(), &["--set", "limits.drain=600"]);
    let _maker = server.hold();
    upload_with(server.addr, &slow(8), &[]);
    server.wait_for_photo();
    server.signal(Signal::TERM);
    wait_until("the first signal has arrived", || server.logged().contains("stopping"));
    wait_until("the second signal ends it", || {
        server.signal(Signal::TERM);
        server.child.0.try_wait().unwrap().is_some_and(|status| status.code() == Some(1))
    });
}
