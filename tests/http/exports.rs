//! Exports that are written as jobs.

use tmpi::server::Exports;

use crate::access::upload as upload_as;
use crate::prelude::*;

fn order(addr: SocketAddr, photo: &str, parameters: &str) -> Response {
    request(addr, "POST", &format!("/v1/photos/{photo}/exports?{parameters}"), &[], &[])
}

/// Orders a file and waits for it; returns its state.
pub fn written(addr: SocketAddr, photo: &str, parameters: &str) -> Value {
    let ordered = order(addr, photo, parameters).any_of(&[200, 202]);
    ended(addr, ordered.header("location").unwrap(), "done")
}

/// Waits until a file has ended as `state`.
fn ended(addr: SocketAddr, location: &str, state: &str) -> Value {
    let mut last = Value::Null;
    wait_until(&format!("{location} is {state}"), || {
        last = get(addr, location).json();
        last["state"] == state
    });
    last
}

fn files(data: &Path) -> usize {
    contents(data, "", "export").len()
}

fn keeping(exports: Exports) -> Limits {
    Limits { exports, ..Limits::default() }
}

fn start(limits: Limits) -> (Running, String) {
    let server = Running::with(limits, Arc::new(pipeline()));
    let photo = server.make(&jpeg(1));
    (server, photo)
}

#[test]
fn a_file_is_written_once_for_all_callers_and_survives_a_restart() {
    let (server, photo) = start(Limits::default());
    let address = format!("/v1/photos/{photo}/exports");
    let form = [("content-type", "application/x-www-form-urlencoded")];
    let first = request(server.addr, "POST", &address, &form, b"format=glb");
    assert!(matches!(first.status, 200 | 202) && first.header("location").unwrap().starts_with(&format!("{address}/")));
    let location = first.header("location").unwrap().to_owned();
    let state = ended(server.addr, &location, "done");
    assert_eq!((&state["parameters"]["format"], &state["parameters"]["shape"]), (&"glb".into(), &"relief".into()));
    let again = request(server.addr, "POST", &address, &[JSON], br#"{"shape": "relief", "format": "GLB"}"#);
    assert_eq!((again.status, again.header("location")), (200, Some(location.as_str())), "the same, said otherwise");
    assert_ne!(written(server.addr, &photo, "format=glb&shape=metric")["key"], state["key"]);
    // counters may lag behind the state
    for line in ["{class=\"export\",outcome=\"done\"} 2", "{class=\"interactive\",outcome=\"done\"} 1"] {
        let counted = || get(server.addr, "/metrics").text().contains(&format!("tmpi_jobs_total{line}"));
        wait_until(line, counted);
    }

    let at = state["links"]["file"].as_str().unwrap();
    let file = get(server.addr, at);
    assert_eq!((file.status, file.header("content-type")), (200, Some("model/gltf-binary")));
    assert_eq!(file.header("content-disposition"), Some(format!("attachment; filename=\"{photo}.glb\"").as_str()));
    assert_eq!(file.body, get(server.addr, &format!("/v1/photos/{photo}/export?format=glb")).body, "the same as the direct export");
    assert_eq!(state["bytes"], file.body.len());
    let tag = file.header("etag").unwrap();
    assert_eq!(request(server.addr, "GET", at, &[("if-none-match", tag)], &[]).status, 304);
    let part = request(server.addr, "GET", at, &[("range", "bytes=2-9"), ("if-range", tag)], &[]);
    assert_eq!((part.status, part.body.as_slice()), (206, &file.body[2..10]));
    assert_eq!(request(server.addr, "GET", at, &[("range", "bytes=999999999-")], &[]).status, 416);

    let server = server.restarted();
    let later = get(server.addr, at);
    assert!(later.status == 200 && later.body == file.body && later.header("etag") == Some(tag));
    assert_eq!(request(server.addr, "DELETE", &location, &[], &[]).status, 204);
    for gone in [location.as_str(), at] {
        get(server.addr, gone).problem(404);
    }
    assert_eq!(files(server.data()), 1, "the other one");
}

#[test]
fn wrong_orders_are_refused_before_they_are_queued() {
    let (server, photo) = start(Limits::default());
    for (parameters, field) in [("format=gif", "format"), ("size=3", "size")] {
        assert_eq!(order(server.addr, &photo, parameters).problem(400)["field"], field, "{parameters}");
    }
    let address = format!("/v1/photos/{photo}/exports");
    request(server.addr, "POST", &address, &[("content-type", "image/jpeg")], b"a picture").problem(415);
    request(server.addr, "POST", &address, &[JSON], &vec![b' '; 5000]).problem(413);
    request(server.addr, "POST", &address, &[JSON], b"[]").problem(400);
    get(server.addr, &format!("{address}/0123456789abcdef")).problem(404);
    let server = Running::with(Limits::default(), Gate::new(0));
    let early = order(server.addr, &server.upload(&jpeg(1)), "format=glb");
    early.problem(409);
}

#[test]
fn files_are_deleted_with_their_photo_and_when_it_is_made_again() {
    let (server, photo) = start(Limits::default());
    let made = |parameters| written(server.addr, &photo, parameters)["links"]["self"].as_str().unwrap().to_owned();
    let before = made("format=glb");
    request(server.addr, "POST", &format!("/v1/photos/{photo}/remake?class=batch"), &[("prefer", "wait=20")], &[]).is(200);
    get(server.addr, &before).problem(404);
    let after = made("format=glb");
    assert_ne!(before, after);
    wait_until("the file of the previous version is deleted", || files(server.data()) == 1);
    request(server.addr, "POST", &format!("/v1/photos/{photo}/remake?class=never"), &[], &[]).problem(400);
    assert_eq!(request(server.addr, "DELETE", &format!("/v1/photos/{photo}"), &[], &[]).status, 204);
    get(server.addr, &after).problem(404);
    assert_eq!(files(server.data()), 0);
}

#[test]
fn files_make_room_for_others_and_expire_without_downloads() {
    let (server, photo) = start(Limits::default());
    let bytes = |parameters| written(server.addr, &photo, parameters)["bytes"].as_u64().unwrap();
    let (glb, zip) = (bytes("format=glb"), bytes("format=zip"));
    // room for one of the two
    let (server, photo) = start(keeping(Exports { bytes: glb + zip - 1, ..Exports::default() }));
    let first = written(server.addr, &photo, "format=glb");
    written(server.addr, &photo, "format=zip");
    get(server.addr, first["links"]["self"].as_str().unwrap()).problem(404);
    wait_until("the first file is deleted", || files(server.data()) == 1);
    let (server, photo) = start(keeping(Exports { bytes: glb.min(zip) - 1, ..Exports::default() }));
    let ordered = order(server.addr, &photo, "format=glb");
    let failed = ended(server.addr, ordered.header("location").unwrap(), "failed");
    assert_eq!(failed["problem"]["type"], "urn:tmpi:problem:export-too-large");
    get(server.addr, failed["links"]["file"].as_str().unwrap()).problem(422);
    assert_eq!(files(server.data()), 0);
    let (server, photo) = start(keeping(Exports { keep: Duration::from_millis(300), ..Exports::default() }));
    let ordered = order(server.addr, &photo, "format=glb");
    wait_until("it has gone", || get(server.addr, ordered.header("location").unwrap()).status == 404);
    wait_until("its file is deleted", || files(server.data()) == 0);
}

#[test]
fn an_order_over_the_waiting_limit_is_refused() {
    let drawing = Arc::new(SlowDrawing::default());
    let limits = keeping(Exports { waiting: 1, ..Exports::default() });
    let server = Running::drawing(drawing.clone(), Arc::new(pipeline()), |config| Config { limits, ..config });
    let photo = server.make(&jpeg(1));
    let film = format!("path=orbit&frames=2&w={}", SlowDrawing::HELD);
    let held = order(server.addr, &photo, &film);
    ended(server.addr, held.header("location").unwrap(), "working");
    assert_eq!(order(server.addr, &photo, "format=glb").status, 202);
    let waits = order(server.addr, &photo, "format=glb");
    assert_eq!((waits.status, waits.header("retry-after")), (202, Some("1")), "the same order is already waiting");
    let refused = order(server.addr, &photo, "format=zip");
    assert!(refused.header("retry-after").is_some());
    refused.problem(503);
    // the film is cancelled: the next file is written
    assert_eq!(request(server.addr, "DELETE", held.header("location").unwrap(), &[], &[]).status, 204);
    drawing.open();
    written(server.addr, &photo, "format=glb");
    get(server.addr, held.header("location").unwrap()).problem(404);
}

#[test]
fn callers_who_see_a_photo_may_order_files_and_its_owner_may_cancel_them() {
    let server = private();
    let (ann, bob) = (secret("a"), secret("b"));
    let photo = id(&upload_as(&server, Some(&ann), 1));
    let address = format!("/v1/photos/{photo}/exports?format=glb");
    let ask = |method: &str, path: &str, who: Option<&str>| {
        let headers: Vec<_> = std::iter::once(HOST).chain(who.map(|who| ("authorization", who))).collect();
        request(server.addr, method, path, &headers, &[])
    };
    for stranger in [None, Some(bob.as_str())] {
        ask("POST", &address, stranger).problem(404);
    }
    let ordered = ask("POST", &address, Some(&ann));
    let location = ordered.header("location").unwrap().to_owned();
    wait_until("it is written", || ask("GET", &location, Some(&ann)).json()["state"] == "done");
    ask("GET", &location, Some(&bob)).problem(404);
    ask("GET", &format!("{location}/file"), None).problem(404);
    let shown = [HOST, ("authorization", ann.as_str()), JSON];
    assert_eq!(request(server.addr, "PATCH", &format!("/v1/photos/{photo}"), &shown, br#"{"visibility": "link"}"#).status, 200);
    assert_eq!(ask("POST", &address, Some(&bob)).status, 200);
    assert_eq!(ask("GET", &format!("{location}/file"), None).status, 200);
    ask("DELETE", &location, Some(&bob)).problem(404);
    assert_eq!(ask("DELETE", &location, Some(&ann)).status, 204);
}

#[test]
fn a_batch_upload_waits_behind_others() {
    let gate = Gate::new(0);
    let server = Running::with(Limits { drain: Duration::from_millis(100), ..Limits::default() }, gate.clone());
    let busy = server.upload(&jpeg(1));
    gate.wait_started(1);
    let batch = id(&post_form(server.addr, &[], &[("photo", &jpeg(2)), ("class", b"batch")]).json());
    let next = server.upload(&jpeg(3));
    let wrong = post_form(server.addr, &[], &[("photo", &jpeg(4)), ("class", b"export")]);
    assert_eq!(wrong.problem(400)["field"], "class");
    gate.open(2);
    for id in [&busy, &next] {
        server.wait(id, "done");
    }
    assert_ne!(server.state(&batch)["state"], "done");
    let server = server.restarted();
    server.wait(&batch, "done");
}

#[cfg(target_os = "linux")]
mod processes {
    use rustix::process::Signal;

    use super::*;
    use crate::process::{Process, heavy, large, upload, upload_with};

    /// A server with a finished photo, whose writer process has already written a page.
    fn with_writer(data: &Path, arguments: &[&str], photo: &[u8]) -> (Process, String) {
        let server = Process::start_with(data, &[&["--set", "limits.drain=5", "--set", "limits.idle=600"], arguments].concat());
        let id = upload_with(server.addr, photo, &[]);
        wait_until("it is done", || state(server.addr, &id)["state"] == "done");
        written_at_last(server.addr, &id, "format=html");
        (server, id)
    }

    /// Orders a file until it is written, because under a short time limit a busy machine may need several attempts.
    fn written_at_last(addr: SocketAddr, photo: &str, parameters: &str) {
        wait_until(&format!("{parameters} is written"), || order(addr, photo, parameters).any_of(&[200, 202]).status == 200);
    }

    fn working(addr: SocketAddr, photo: &str, parameters: &str) -> String {
        let ordered = order(addr, photo, parameters).is(202);
        let location = ordered.header("location").unwrap().to_owned();
        ended(addr, &location, "working");
        location
    }

    #[test]
    fn deleting_the_photo_or_the_file_stops_its_writer() {
        let dir = tempfile::tempdir().unwrap();
        let (server, photo) = with_writer(dir.path(), &[], &large(1));
        let writer = server.hold_writer();
        let zip = working(server.addr, &photo, "format=zip");
        assert_eq!(request(server.addr, "DELETE", &zip, &[], &[]).status, 204);
        wait_until("the file is no longer written", || writer.has_ended());
        written(server.addr, &photo, "format=glb");
        let writer = server.hold_writer();
        working(server.addr, &photo, "format=zip");
        assert_eq!(request(server.addr, "DELETE", &format!("/v1/photos/{photo}"), &[], &[]).status, 204);
        wait_until("the file of a deleted photo is no longer written", || writer.has_ended());
        assert_eq!(files(dir.path()), 0);
        let next = upload(server.addr, &large(2)).unwrap();
        wait_until("the next one is done", || state(server.addr, &next)["state"] == "done");
        written(server.addr, &next, "format=zip");
    }

    #[test]
    fn a_file_that_takes_too_long_fails_and_the_next_one_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let (server, photo) = with_writer(dir.path(), &["--set", "exports.timeout=4"], &large(1));
        let writer = server.hold_writer();
        let zip = working(server.addr, &photo, "format=zip");
        let failed = ended(server.addr, &zip, "failed");
        assert_eq!(failed["problem"]["type"], "urn:tmpi:problem:late");
        wait_until("its process has ended", || writer.has_ended());
        written_at_last(server.addr, &photo, "format=zip");
    }

    #[test]
    fn a_file_over_its_memory_bound_ends_only_its_own_process() {
        let dir = tempfile::tempdir().unwrap();
        let (server, photo) = with_writer(dir.path(), &[], &heavy(3));
        // a small file starts the threads of the writer
        let small = upload(server.addr, &large(3)).unwrap();
        wait_until("it is done", || state(server.addr, &small)["state"] == "done");
        written(server.addr, &small, "format=zip");
        let writer = server.hold_writer();
        // little more than it has now: as if the file took more memory than estimated
        writer.bound_data(writer.figure("status", "VmData:", 1024).unwrap() + (24 << 20));
        let zip = working(server.addr, &photo, "format=zip");
        writer.signal(Signal::CONT);
        wait_until("the limit has ended it", || writer.has_ended());
        // the server goes on, and another process writes the file
        ended(server.addr, &zip, "done");
        assert!(server.logged().contains("crashed the process") && !server.logged().contains("panicked"), "{}", server.logged());
    }

    #[test]
    fn a_crash_while_writing_leaves_no_partial_file_and_the_job_runs_again() {
        let dir = tempfile::tempdir().unwrap();
        let (mut server, photo) = with_writer(dir.path(), &["--set", "limits.lease=3"], &large(1));
        let html = order(server.addr, &photo, "format=html").json()["links"]["file"].as_str().unwrap().to_owned();
        let writer = server.hold_writer();
        let zip = working(server.addr, &photo, "format=zip");
        server.crash();
        drop(writer);
        let server = Process::start(dir.path());
        assert_eq!(get(server.addr, &html).status, 200);
        // the job runs again after its old lease has expired
        let state = ended(server.addr, &zip, "done");
        assert_eq!(&state["links"]["self"], &zip, "under the same address");
        assert_eq!(files(dir.path()), 2, "the page and the archive");
        assert_eq!(&get(server.addr, &format!("{zip}/file")).body[..4], b"PK\x03\x04");
    }

    #[test]
    fn heavy_files_are_written_in_another_process_also_for_waiting_clients() {
        let dir = tempfile::tempdir().unwrap();
        let (server, photo) = with_writer(dir.path(), &[], &heavy(4));
        let maker = server.hold();
        let client = Connection::asking(server.addr, &format!("/v1/photos/{photo}/export?format=zip"));
        let held = || figure(server.addr, "tmpi_job_memory_bytes");
        wait_until("the export runs", || held() > 0);
        drop(client);
        wait_until("its process ends with the client", || maker.has_ended());
        wait_until("its memory is free", || held() == 0);
        let whole = get(server.addr, &format!("/v1/photos/{photo}/export?format=zip"));
        assert_eq!((whole.status, &whole.body[..4]), (200, b"PK\x03\x04".as_slice()));
        let state = written(server.addr, &photo, "format=zip");
        assert!(get(server.addr, state["links"]["file"].as_str().unwrap()).body == whole.body, "the same either way");
    }
}
