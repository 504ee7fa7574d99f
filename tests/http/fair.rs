//! Fairness: requests delay only requests of their own kind, and waiting requests hold no memory.

use std::io::Read as _;
use std::sync::atomic::{AtomicBool, AtomicUsize};

use tmpi::server::Caches;

use crate::prelude::*;

const HELD: u32 = SlowDrawing::HELD;

/// A server with finished photos and a renderer that the test opens.
fn start(limits: Limits, photos: u8) -> (Running, Vec<String>, Arc<SlowDrawing>) {
    let drawing = Arc::new(SlowDrawing::default());
    let server = Running::drawing(drawing.clone(), Arc::new(pipeline()), |config| Config { limits, ..config });
    let photos = (0..photos).map(|seed| format!("/v1/photos/{}", server.make(&jpeg(seed)))).collect();
    (server, photos, drawing)
}

#[test]
fn films_do_not_delay_views_and_views_do_not_delay_levels_or_files() {
    let (server, photos, drawing) = start(Limits { views: 1, ..Limits::default() }, 1);
    let photo = &photos[0];
    let _film = Connection::asking(server.addr, &format!("{photo}/view?path=orbit&frames=2&w={HELD}"));
    wait_until("the film is drawn", || drawing.held.load(Ordering::SeqCst) == 1);
    assert_eq!(get(server.addr, &format!("{photo}/view?w=40")).status, 200);
    let _view = Connection::asking(server.addr, &format!("{photo}/view?w={HELD}"));
    wait_until("the view is drawn", || drawing.held.load(Ordering::SeqCst) == 2);
    assert_eq!(get(server.addr, &format!("{photo}/atlas?level=1")).status, 200);
    // waiting views do not delay these
    let _more: Vec<_> = (0..8).map(|n| Connection::asking(server.addr, &format!("{photo}/view?ty=0.0{n}&w={HELD}"))).collect();
    wait_until("they wait", || server.metric("tmpi_views_waiting") >= 8);
    for path in ["/healthz", "/readyz", "/metrics"] {
        assert_eq!(get(server.addr, path).status, 200, "{path}");
    }
    drawing.open();
}

#[test]
fn a_film_ends_with_its_client() {
    let (server, photos, drawing) = start(Limits::default(), 1);
    let film = Connection::asking(server.addr, &format!("{}/view?path=orbit&frames=240&w={HELD}", photos[0]));
    wait_until("it is drawn", || drawing.held.load(Ordering::SeqCst) == 1);
    let before = drawing.begun.load(Ordering::SeqCst);
    drop(film);
    wait_until("the request is gone", || server.metric("tmpi_requests_in_flight") <= 1);
    drawing.open();
    // the slot becomes free after the current frame
    wait_until("the memory is free", || server.metric("tmpi_work_memory_bytes") == 0);
    assert_eq!(drawing.begun.load(Ordering::SeqCst), before, "no further picture was drawn");
}

#[test]
fn waiting_requests_hold_no_scene_and_memory_bounds_parallel_drawing() {
    const PHOTOS: u8 = 6;
    let limits = Limits { views: 8, work_memory: 2 << 20, cache: Caches { scenes: 0, ..Caches::default() }, ..Limits::default() };
    let (server, photos, drawing) = start(limits, PHOTOS);
    let clients: Vec<_> = photos.iter().map(|photo| Connection::asking(server.addr, &format!("{photo}/view?w={HELD}"))).collect();
    // each view reserves one unit of memory, of which a scene needs less
    wait_until("two are drawn", || drawing.held.load(Ordering::SeqCst) == 2);
    wait_until("the others wait", || server.metric("tmpi_views_waiting") == u64::from(PHOTOS - 2));
    assert_eq!(server.metric("tmpi_work_memory_bytes"), 2 << 20);
    assert_eq!((drawing.held.load(Ordering::SeqCst), server.metric("tmpi_scene_cache_bytes")), (2, 0));
    drawing.open();
    for mut client in clients {
        assert_eq!(client.receive("GET").unwrap().status, 200);
    }
}

#[test]
fn a_view_is_drawn_once_for_all_clients_even_if_the_first_leaves() {
    let (server, photos, drawing) = start(Limits::default(), 1);
    let path = format!("{}/view?w={HELD}", photos[0]);
    let first = Connection::asking(server.addr, &path);
    wait_until("it is drawn", || drawing.held.load(Ordering::SeqCst) == 1);
    let others: Vec<_> = (0..6).map(|_| Connection::asking(server.addr, &path)).collect();
    wait_until("all ask", || server.metric("tmpi_requests_in_flight") >= 8);
    drop(first);
    wait_until("one is gone", || server.metric("tmpi_requests_in_flight") <= 7);
    drawing.open();
    for mut client in others {
        assert_eq!(client.receive("GET").unwrap().status, 200);
    }
    assert!(drawing.begun.load(Ordering::SeqCst) <= 2, "once for the one that left, once for all others");
}

#[test]
fn a_full_lane_answers_503() {
    let (server, photos, drawing) = start(Limits { views: 1, views_waiting: 1, ..Limits::default() }, 1);
    let view = |n: u32| format!("{}/view?tx=0.0{n}&w={HELD}", photos[0]);
    let _drawn = Connection::asking(server.addr, &view(1));
    wait_until("one is drawn", || drawing.held.load(Ordering::SeqCst) == 1);
    let _waits = Connection::asking(server.addr, &view(2));
    wait_until("one waits", || server.metric("tmpi_views_waiting") == 1);
    let refused = get(server.addr, &view(3));
    assert!(refused.header("retry-after").is_some());
    refused.problem(503);
    drawing.open();
}

#[test]
fn a_file_is_written_once_for_all_its_parts() {
    let (server, photos, _) = start(Limits::default(), 1);
    let path = format!("{}/export?format=zip", photos[0]);
    let whole = get(server.addr, &path);
    assert!(whole.all("server-timing").contains("export;dur="));
    let part = request(server.addr, "GET", &path, &[("range", "bytes=0-0")], &[]);
    assert_eq!((part.status, part.body.as_slice()), (206, &whole.body[..1]));
    let head = request(server.addr, "HEAD", &path, &[], &[]);
    assert_eq!(head.header("content-length"), Some(whole.body.len().to_string().as_str()));
    for again in [&part, &head] {
        assert!(!again.all("server-timing").contains("export;dur="), "not written again");
    }
    assert!(server.metric("tmpi_export_cache_bytes") >= whole.body.len() as u64);
    assert_eq!(incoming(server.data()), 0, "`incoming` stays empty");
    assert_eq!(request(server.addr, "DELETE", &photos[0], &[], &[]).status, 204);
    assert_eq!(server.metric("tmpi_export_cache_bytes"), 0);
}

#[test]
fn an_address_has_no_more_connections_than_its_share() {
    let limits = Limits { connections_per_address: 2, ..Limits::default() };
    let server = Running::with(limits, Arc::new(pipeline()));
    let (mut a, mut b) = (Connection::open(server.addr), Connection::open(server.addr));
    assert_eq!((a.request("GET", "/healthz", &[], &[]).status, b.request("GET", "/healthz", &[], &[]).status), (200, 200));
    let mut third = Connection::open(server.addr);
    assert!(matches!(third.raw().read(&mut [0; 9]), Ok(0) | Err(_)), "closed at once");
    drop(a);
    wait_until("another one is let in", || {
        let mut next = Connection::open(server.addr);
        let sent = std::io::Write::write_all(next.raw(), b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n").is_ok();
        sent && next.receive("GET").is_ok_and(|answer| answer.status == 200)
    });
}

#[test]
fn event_streams_have_their_own_places() {
    let server = Running::with(Limits { streams: 1, ..Limits::default() }, Gate::new(0));
    let _busy = server.upload(&jpeg(1));
    let path = format!("/v1/photos/{}/events", server.upload(&jpeg(2)));
    let mut first = Connection::asking(server.addr, &path);
    assert_eq!(first.head().unwrap().status, 200);
    get(server.addr, &path).problem(503);
    drop(first);
    wait_until("the place is free", || Connection::asking(server.addr, &path).head().unwrap().status == 200);
}

#[test]
fn memory_bounds_the_number_of_parallel_jobs() {
    let one = pipeline().memory(&jpeg(1), None, &Options::default());
    let gate = Gate::new(0);
    let limits = Limits { workers: 4, job_memory: 2 * one + one / 2, ..Limits::default() };
    let server = Running::with(limits, gate.clone());
    let ids: Vec<String> = (0..4).map(|seed| server.upload(&jpeg(seed))).collect();
    gate.wait_started(2);
    serves_others(server.addr);
    assert_eq!(gate.started.load(Ordering::SeqCst), 2, "there is memory for two");
    assert_eq!(server.metric("tmpi_job_memory_bytes"), 2 * one);
    gate.open(1);
    gate.wait_started(3);
    gate.open(3);
    for id in &ids {
        server.wait(id, "done");
    }
}

/// Counts checks, which last until the test opens them.
#[derive(Default)]
struct Checks {
    now: AtomicUsize,
    most: AtomicUsize,
    open: AtomicBool,
}

impl Maker for Checks {
    fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
        self.most.fetch_max(self.now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
        wait_until("the test opens it", || self.open.load(Ordering::SeqCst));
        self.now.fetch_sub(1, Ordering::SeqCst);
        Ok(())
    }

    fn make(&self, _: &[u8], _: Option<&[u8]>, _: &Options, _: &dyn Sink) -> Result<Product, Fault> {
        Err(Fault::Cancelled)
    }
}

#[test]
fn parallel_checks_of_uploads_are_bounded() {
    let checks = Arc::new(Checks::default());
    let server = Running::with(Limits { changes: 3, ..Limits::default() }, checks.clone());
    std::thread::scope(|scope| {
        for seed in 0..12 {
            let server = &server;
            scope.spawn(move || server.upload(&jpeg(seed)));
        }
        wait_until("three are checked", || checks.now.load(Ordering::SeqCst) >= 3);
        serves_others(server.addr);
        checks.open.store(true, Ordering::SeqCst);
    });
    assert_eq!(checks.most.load(Ordering::SeqCst), 3);
}
