//! Progress as server-sent events.

use crate::prelude::*;

/// An open event stream.
pub struct Events {
    connection: Connection,
    buffer: String,
}

impl Events {
    pub fn open(addr: SocketAddr, id: &str) -> Self {
        Self::open_as(addr, id, "", &[])
    }

    /// With these headers and this query as credentials.
    pub fn open_as(addr: SocketAddr, id: &str, query: &str, headers: &[(&str, &str)]) -> Self {
        let mut connection = Connection::open(addr);
        connection.send("GET", &format!("/v1/photos/{id}/events{query}"), headers, &[]);
        let head = connection.head().unwrap();
        assert_eq!((head.status, head.header("content-type")), (200, Some("text/event-stream")));
        Self { connection, buffer: String::new() }
    }

    /// The next block: an event with its data, or a comment with none.
    pub fn next(&mut self) -> Option<(String, Value)> {
        while !self.buffer.contains("\n\n") {
            self.buffer += &String::from_utf8(self.connection.chunk()?).unwrap();
        }
        let (block, rest) = self.buffer.split_once("\n\n").unwrap();
        let line = |name: &str| block.lines().find_map(|l| l.strip_prefix(name)).map(|l| l.trim().to_owned());
        let event = (line("event:").unwrap_or_default(), line("data:").map_or(Value::Null, |d| serde_json::from_str(&d).unwrap()));
        self.buffer = rest.to_owned();
        Some(event)
    }
}

#[test]
fn queued_stages_done_and_the_end() {
    let gate = Gate::new(0);
    let server = Running::with(Limits::default(), gate.clone());
    let _busy = server.upload(&jpeg(1));
    gate.wait_started(1);
    let id = server.upload(&jpeg(2));
    let mut events = Events::open(server.addr, &id);
    assert_eq!(events.next().unwrap(), ("queued".into(), serde_json::json!({"position": 0})));
    gate.open(2);
    let mut seen = Vec::new();
    while let Some((name, data)) = events.next() {
        seen.push((name, data));
    }
    let (last, stages) = seen.split_last().unwrap();
    assert_eq!((last.0.as_str(), last.1["state"].as_str(), last.1["id"].as_str()), ("done", Some("done"), Some(id.as_str())));
    assert!(stages.len() >= 8, "every stage has an event: {stages:?}");
    assert!(stages.iter().all(|(name, _)| name == "stage"));
    // the first stage is the gate's, the others are the pipeline's
    let steps: Vec<u64> = stages[1..].iter().map(|(_, s)| s["step"].as_u64().unwrap()).collect();
    assert!(steps.is_sorted() && stages.iter().all(|(_, s)| s["step"].as_u64() <= s["steps"].as_u64()), "{steps:?}");

    let mut late = Events::open(server.addr, &id);
    assert_eq!(late.next().unwrap().0, "done");
    assert_eq!(late.next(), None, "the stream ends");
}

#[test]
fn waiting_clients_are_told_when_the_queue_moves() {
    let gate = Gate::new(0);
    let server = Running::with(Limits::default(), gate.clone());
    let ids: Vec<String> = (0..3).map(|seed| server.upload(&jpeg(seed))).collect();
    gate.wait_started(1);
    let mut events = Events::open(server.addr, &ids[2]);
    for position in [1, 0] {
        assert_eq!(events.next().unwrap(), ("queued".into(), serde_json::json!({"position": position})));
        gate.open(1);
    }
    gate.open(1);
    let names: Vec<String> = std::iter::from_fn(|| events.next()).map(|(name, _)| name).collect();
    assert_eq!(names.last().map(String::as_str), Some("done"), "{names:?}");
}

#[test]
fn late_listeners_get_the_last_stage_first() {
    let gate = Gate::new(0);
    let server = Running::with(Limits::default(), gate.clone());
    let id = server.upload(&jpeg(1));
    gate.wait_started(1);
    server.wait(&id, "working");
    let mut events = Events::open(server.addr, &id);
    let (name, stage) = events.next().unwrap();
    assert_eq!((name.as_str(), stage["stage"].as_str()), ("stage", Some("photo")));
    assert_eq!(server.state(&id)["progress"]["stage"], "photo");
    assert_eq!(request(server.addr, "DELETE", &format!("/v1/photos/{id}"), &[], &[]).status, 204);
    assert_eq!(events.next().unwrap().0, "deleted");
    assert_eq!(events.next(), None);
}

#[test]
fn failures_and_unknown_photos() {
    let server = Running::open();
    let failed = post_form(server.addr, &[], &[("photo", &jpeg(1)), ("depth", &spoilt_map())]).json();
    let mut events = Events::open(server.addr, failed["id"].as_str().unwrap());
    let last = std::iter::from_fn(|| events.next()).last().unwrap();
    assert_eq!((last.0.as_str(), last.1["status"].as_u64()), ("failed", Some(422)));
    get(server.addr, "/v1/photos/00000000000000000000000000000000/events").problem(404);
}

#[test]
fn idle_streams_get_comments_and_a_stop_ends_them() {
    let limits = Limits { keep_alive: Duration::from_millis(30), drain: Duration::from_millis(500), ..Limits::default() };
    let mut server = Running::with(limits, Gate::new(0));
    let _busy = server.upload(&jpeg(1));
    let id = server.upload(&jpeg(2));
    let mut events = Events::open(server.addr, &id);
    assert_eq!(events.next().unwrap().0, "queued");
    assert_eq!(events.next().unwrap(), (String::new(), Value::Null), "a comment");
    assert_eq!(events.next().unwrap(), (String::new(), Value::Null), "and another, as nothing happens");
    server.signal();
    // the stream ends in time, after nothing but comments
    let began = std::time::Instant::now();
    let rest: Vec<_> = std::iter::from_fn(|| events.next()).collect();
    assert!(began.elapsed() < Duration::from_secs(20), "{:?}", began.elapsed());
    assert!(rest.iter().all(|(name, _)| name.is_empty()), "{rest:?}");
    server.stop();
}
