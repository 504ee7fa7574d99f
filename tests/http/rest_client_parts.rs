//! The Rust client: uploads in parts, and strokes.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::json;
use tmpi::server::Limits;
use tmpi_client::{Client, Error, State, Stroke, Touch, Upload};

use crate::fixture::{Running, depth_map, jpeg, pipeline};
use crate::rest_client::{block_on, client};

/// What a server does with a request.
enum Step {
    /// Reads it, and answers so.
    Answer(String),
    /// Reads so many bytes of its body, and breaks off.
    Cut(usize),
}

/// Head of a request in small letters, and what was read of its body.
type Asked = (String, Vec<u8>);

fn answer(status: &str, headers: &str, body: &str) -> Step {
    Step::Answer(format!("HTTP/1.1 {status}\r\n{headers}content-length: {}\r\nconnection: close\r\n\r\n{body}", body.len()))
}

/// Reads a request with at most so many bytes of its body.
fn read(stream: &mut TcpStream, most: usize) -> Asked {
    let (mut head, mut byte) = (Vec::new(), [0]);
    while !head.ends_with(b"\r\n\r\n") {
        stream.read_exact(&mut byte).unwrap();
        head.push(byte[0]);
    }
    let head = String::from_utf8(head).unwrap().to_lowercase();
    let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")?.parse().ok()).unwrap_or(0_usize);
    let mut body = vec![0; length.min(most)];
    stream.read_exact(&mut body).unwrap();
    (head, body)
}

/// A server that does one step with each connection, and tells what it was asked.
fn scripted(steps: Vec<Step>) -> (Client, JoinHandle<Vec<Asked>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let client = Client::new(&format!("http://{}", listener.local_addr().unwrap())).unwrap();
    let served = std::thread::spawn(move || {
        let one = |step: &Step| {
            let (mut stream, _) = listener.accept().unwrap();
            match step {
                Step::Cut(most) => read(&mut stream, *most),
                Step::Answer(text) => {
                    let asked = read(&mut stream, usize::MAX);
                    stream.write_all(text.as_bytes()).unwrap();
                    asked
                }
            }
        };
        steps.iter().map(one).collect()
    });
    (client, served)
}

fn begun() -> Step {
    answer("201 Created", "location: /v1/uploads/ab\r\nset-cookie: node=7; Path=/; HttpOnly\r\n", "{}")
}

fn extent(offset: usize, photo: Option<&str>) -> Step {
    answer("200 OK", "", &json!({ "offset": offset, "complete": photo.is_some(), "photo": photo }).to_string())
}

fn state(id: &str) -> Step {
    let links: serde_json::Map<_, _> =
        ["self", "atlas", "view", "thumbnail", "poster", "page", "embed"].iter().map(|name| ((*name).into(), "/".into())).collect();
    answer("200 OK", "", &json!({ "id": id, "state": "queued", "created": "", "photo_bytes": 20, "links": links }).to_string())
}

#[test]
fn an_upload_goes_on_from_what_the_server_has() {
    let photo: Vec<u8> = (0..20).collect();
    let (client, served) = scripted(vec![
        begun(),
        Step::Cut(5),
        extent(5, None),
        answer("204 No Content", "", ""),
        // too many are at it for now
        answer("429 Too Many Requests", "retry-after: 0\r\n", "{}"),
        extent(17, None),
        // all of it came, and the answer is lost
        Step::Cut(3),
        extent(20, Some("/v1/photos/cd")),
        state("cd"),
    ]);
    let mut told = Vec::new();
    let upload = Upload::of(photo.clone()).title("Sea").wait(Duration::from_secs(9));
    let made = block_on(client.upload_in_parts(upload, 12, |there, all| told.push((there, all)))).unwrap();
    assert_eq!((made.id.as_str(), made.state), ("cd", State::Queued));
    assert_eq!(told, [(0, 20), (5, 20), (17, 20), (17, 20), (20, 20)]);
    let asked = served.join().unwrap();
    let (begin, others) = asked.split_first().unwrap();
    assert!(begin.0.starts_with("post /v1/photos?title=sea http/1.1\r\n") && begin.1.is_empty(), "{}", begin.0);
    assert!(begin.0.contains("\r\nupload-complete: ?0\r\n") && begin.0.contains("\r\nupload-length: 20\r\n"), "{}", begin.0);
    let lines: Vec<&str> = others.iter().map(|(head, _)| head.lines().next().unwrap()).collect();
    let (part, ask) = ("patch /v1/uploads/ab http/1.1", "get /v1/uploads/ab http/1.1");
    assert_eq!(lines, [part, ask, part, part, ask, part, ask, "get /v1/photos/cd http/1.1"]);
    // a proxy is told each time at which node the upload is
    assert!(others[..7].iter().all(|(head, _)| head.contains("\r\ncookie: node=7\r\n")), "{others:?}");
    let parts: Vec<&Asked> = others.iter().filter(|(head, _)| head.starts_with("patch")).collect();
    for ((head, body), (from, to, last)) in parts.into_iter().zip([(0, 5, "?0"), (5, 17, "?0"), (17, 20, "?1"), (17, 20, "?1")]) {
        assert_eq!(body, &photo[from..to]);
        let wanted =
            [format!("upload-offset: {from}"), format!("upload-complete: {last}"), "content-type: application/partial-upload".into()];
        assert!(wanted.iter().all(|line| head.lines().any(|l| l == line)), "{wanted:?} in {head}");
        assert_eq!(head.contains("\r\nprefer: wait=9\r\n"), last == "?1", "only the last part is answered with the photo");
    }
}

#[test]
fn an_upload_that_fails_is_given_up_and_gives_its_place_back() {
    let deleted = || answer("204 No Content", "", "");
    let refusal = json!({ "type": "urn:tmpi:problem:photo", "title": "No", "status": 415, "detail": "no picture" }).to_string();
    block_on(async {
        let (client, served) = scripted(vec![begun(), Step::Cut(1), deleted()]);
        let failed = client.patience(Duration::ZERO).upload_in_parts(Upload::of(vec![1_u8; 9]), 4, |_, _| ()).await.unwrap_err();
        assert!(matches!(failed, Error::Network(_)), "{failed:?}");
        assert!(served.join().unwrap()[2].0.starts_with("delete /v1/uploads/ab "));
        // what would be refused again is not sent again
        let (client, served) = scripted(vec![begun(), answer("415 Unsupported Media Type", "", &refusal), deleted()]);
        let refused = client.upload_in_parts(Upload::of(vec![1_u8; 9]), 9, |_, _| ()).await.unwrap_err();
        assert!(matches!(&refused, Error::Problem(p) if p.status == 415 && p.detail == "no picture"), "{refused:?}");
        assert!(served.join().unwrap()[2].0.starts_with("delete "));
        // an offset that cannot be
        let (client, served) = scripted(vec![begun(), Step::Cut(1), extent(10, None), deleted()]);
        let wrong = client.upload_in_parts(Upload::of(vec![1_u8; 9]), 4, |_, _| ()).await.unwrap_err();
        assert!(matches!(wrong, Error::Answer(_)), "{wrong:?}");
        served.join().unwrap();
    });
}

#[test]
fn parts_make_the_photo_that_the_client_makes_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), Limits::default(), Arc::new(pipeline()));
    let here = client(&server);
    block_on(async {
        let upload = Upload::of(jpeg(1)).depth(depth_map()).title("In parts").option("planes", "4");
        let mut told = Vec::new();
        let made = here.upload_in_parts(upload.clone(), 700, |there, all| told.push((there, all))).await.unwrap();
        let all = told[0].1;
        assert!(told.len() > 2 && told.iter().take(told.len() - 1).enumerate().all(|(n, t)| *t == (n * 700, all)), "{told:?}");
        assert_eq!(told.last(), Some(&(all, all)));
        assert_eq!(here.upload(upload).await.unwrap().id, made.id);
        assert_eq!(here.finished(&made.id, |_| ()).await.unwrap().settings.title.as_deref(), Some("In parts"));
        let refused = here.upload_in_parts(Upload::of(&b"no picture"[..]), 4, |_, _| ()).await.unwrap_err();
        assert_eq!(refused.status(), Some(415), "{refused}");
    });
    assert!(std::fs::read_dir(dir.path().join("uploads")).unwrap().count() < 2, "what was refused has no place any more");
    drop(server);
    let dir = tempfile::tempdir().unwrap();
    let none = Running::start(dir.path(), Limits { partials: 0, ..Limits::default() }, Arc::new(pipeline()));
    let made = block_on(client(&none).upload_in_parts(Upload::of(jpeg(1)), 700, |_, _| ())).unwrap();
    assert_eq!(none.upload(&jpeg(1)), made.id, "where parts are not taken, it goes at once");
}

#[test]
fn strokes_go_up_and_come_down_and_are_undone() {
    let dir = tempfile::tempdir().unwrap();
    let server = Running::start(dir.path(), Limits::default(), Arc::new(pipeline()));
    let client = client(&server);
    block_on(async {
        let id = client.upload(Upload::of(jpeg(1)).wait(Duration::from_secs(20))).await.unwrap().id;
        let untouched = client.depth(&id).await.unwrap();
        let before = client.strokes(&id).await.unwrap();
        assert!(before.strokes.is_empty() && before.tag.is_some());
        let sky = Stroke { points: vec![[0.2, 0.1], [0.8, 0.1]], radius: 0.1, touch: Touch::To(0.0) };
        let near = Stroke { points: vec![[0.5, 0.9]], radius: 0.05, touch: Touch::By(0.125) };
        let all = [sky.clone(), near.clone()];
        client.touch_up(&id, &all, before.tag.as_deref()).await.unwrap();
        client.finished(&id, |_| ()).await.unwrap();
        let now = client.strokes(&id).await.unwrap();
        assert_eq!(now.strokes, all);
        assert_ne!(client.depth(&id).await.unwrap(), untouched);
        let late = client.touch_up(&id, &[], before.tag.as_deref()).await.unwrap_err();
        assert_eq!(late.status(), Some(412));
        let wrong = Stroke { radius: 0.5, ..near };
        let refused = client.touch_up(&id, &[sky.clone(), wrong], None).await.unwrap_err();
        assert!(matches!(&refused, Error::Problem(p) if p.field.as_deref() == Some("strokes[1].radius")), "{refused:?}");
        // the last one undone, then all
        client.touch_up(&id, &all[..1], now.tag.as_deref()).await.unwrap();
        client.finished(&id, |_| ()).await.unwrap();
        assert_eq!(client.strokes(&id).await.unwrap().strokes, [sky]);
        client.touch_up(&id, &[], None).await.unwrap();
        client.finished(&id, |_| ()).await.unwrap();
        assert!(client.strokes(&id).await.unwrap().strokes.is_empty());
        assert_eq!(client.depth(&id).await.unwrap(), untouched, "it is as it was");
    });
}
