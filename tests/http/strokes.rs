//! Touch-up: strokes, with which a photo is made again.

use tmpi_pipeline::depth::DepthKind;

use crate::photo_settings::{self, PATCH};
use crate::prelude::*;

const WAIT: (&str, &str) = ("prefer", "wait=30");

fn patch(server: &Running, photo: &str, headers: &[(&str, &str)], body: &Value) -> Response {
    photo_settings::patch(server, &format!("{photo}/strokes"), headers, body)
}

fn sky() -> Value {
    json!({ "points": [[0.2, 0.1], [0.8, 0.1]], "radius": 0.1, "to": 0.0 })
}

#[test]
fn strokes_make_the_photo_again_and_stay_with_it() {
    let (server, photo) = Running::with_photo();
    let title = json!({ "title": "A box" });
    photo_settings::patch(&server, &photo, &[], &title).is(200);
    let before = get(server.addr, &photo).json();
    let depth = |server: &Running| get(server.addr, &format!("{photo}/depth")).body;
    let untouched = depth(&server);
    let none = get(server.addr, before["links"]["strokes"].as_str().unwrap());
    assert_eq!(none.json(), json!({ "version": 1, "strokes": [] }));

    let seen = none.header("etag").unwrap();
    let changed = patch(&server, &photo, &[WAIT, ("if-match", seen)], &json!({ "strokes": [sky()] })).is(200);
    assert_eq!(changed.header("preference-applied"), Some("wait=30"));
    let after = changed.json();
    assert_eq!((&after["state"], &after["id"], &after["settings"]["title"]), (&json!("done"), &before["id"], &json!("A box")));
    assert_ne!(after["version"], before["version"]);
    assert_ne!(depth(&server), untouched);
    assert_eq!(get(server.addr, &format!("{photo}/report")).json()["input"]["strokes"], 1);

    // addresses with the old version are no longer immutable, those with the new version are
    for part in ["atlas", "depth", "report", "thumbnail", "view?w=20", "export?format=glb"] {
        let and = if part.contains('?') { '&' } else { '?' };
        for (version, kept) in [(&before["version"], "no-cache"), (&after["version"], "public, max-age=31536000, immutable")] {
            let answer = get(server.addr, &format!("{photo}/{part}{and}v={}", version.as_str().unwrap()));
            assert_eq!((answer.status, answer.header("cache-control")), (200, Some(kept)), "{part}");
        }
    }

    // `If-Match` with an old tag does not overwrite the strokes
    let late = patch(&server, &photo, &[("if-match", seen)], &json!({ "strokes": null }));
    assert_eq!(late.problem(412)["field"], "If-Match");
    let kept = get(server.addr, &format!("{photo}/strokes"));
    assert_eq!((kept.json()["strokes"].clone(), kept.header("etag")), (json!([sky()]), changed.header("etag")));
    // the same strokes do not make the photo again
    for same in [json!({ "strokes": [sky()] }), json!({}), json!({ "version": 1 })] {
        let same = patch(&server, &photo, &[], &same);
        assert_eq!((same.status, &same.json()["version"]), (200, &after["version"]));
    }

    let server = server.restarted();
    assert_eq!(get(server.addr, &format!("{photo}/strokes")).json()["strokes"], json!([sky()]), "after a restart");
    assert_eq!(server.upload(&picture(1, PictureFormat::Png)), before["id"].as_str().unwrap(), "the same upload is the same photo");
    let removed = patch(&server, &photo, &[WAIT], &json!({ "strokes": null }));
    assert_eq!((removed.status, depth(&server) == untouched), (200, true), "the original depth is back");
}

#[test]
fn the_map_before_the_strokes_is_kept_beside_the_touched_up_one() {
    let (server, photo) = Running::with_photo();
    let limits = tmpi_pipeline::photo::Limits::default();
    let read = |file: &[u8]| tmpi_pipeline::depth::from_map(file, DepthKind::Disparity, &limits, 80, 60).unwrap().0.delta;
    let before = |server: &Running| get(server.addr, &format!("{photo}/depth?before=strokes"));
    let used = |server: &Running| get(server.addr, &format!("{photo}/depth"));
    let untouched = read(&used(&server).body);
    before(&server).problem(404);
    assert_eq!(get(server.addr, &format!("{photo}/depth?before=sky")).problem(400)["field"], "before");
    assert_eq!(get(server.addr, &format!("{photo}/depth?after=strokes")).problem(400)["field"], "after");

    let nearer = json!({ "points": [[0.3, 0.7], [0.7, 0.7]], "radius": 0.1, "by": -0.4 });
    let mut all: Vec<Vec<f32>> = Vec::new();
    for strokes in [json!([nearer]), json!([nearer, sky()]), json!([sky()])] {
        let state = patch(&server, &photo, &[WAIT], &json!({ "strokes": strokes })).json();
        let kept = before(&server);
        assert_eq!((kept.status, kept.header("content-type")), (200, Some("image/png")));
        let map = read(&kept.body);
        // the map before strokes is the network's ramp, nearer towards the bottom
        let off = map.iter().enumerate().map(|(i, d)| f64::from((d - (i / 80 + 1) as f32 / 60.0).abs())).sum::<f64>() / 4800.0;
        assert!(off < 0.01, "{strokes}: {off} from the network's map");
        assert!(all.iter().all(|other| *other == map), "{strokes}: the map before strokes depends on the strokes");
        all.push(map);
        let now = used(&server);
        assert_ne!(read(&now.body), untouched, "{strokes}: the used map contains the strokes");
        assert!(kept.header("etag").is_some() && kept.header("etag") != now.header("etag"));
        let version = state["version"].as_str().unwrap();
        let lasting = get(server.addr, &format!("{photo}/depth?before=strokes&v={version}"));
        assert_eq!((lasting.header("cache-control"), &lasting.body), (Some("public, max-age=31536000, immutable"), &kept.body));
        let known =
            request(server.addr, "GET", &format!("{photo}/depth?before=strokes"), &[("if-none-match", kept.header("etag").unwrap())], &[]);
        assert_eq!(known.status, 304);
        // the map is an ordinary PNG
        assert_eq!(image::load_from_memory(&now.body).unwrap().into_luma16().dimensions(), (80, 60));
    }

    let kept = before(&server).body;
    let server = server.restarted();
    assert_eq!(before(&server).body, kept, "after a restart");
    patch(&server, &photo, &[WAIT], &json!({ "strokes": null }));
    before(&server).problem(404);
    assert_eq!(read(&used(&server).body), untouched);
}

#[test]
fn a_wrong_stroke_is_named_and_changes_nothing() {
    let (server, photo) = Running::with_photo();
    let mut wrong = sky();
    wrong["radius"] = json!(0.3);
    let refused = patch(&server, &photo, &[], &json!({ "strokes": [sky(), wrong] })).problem(400);
    assert_eq!(refused["field"], "strokes[1].radius");
    patch(&server, &photo, &[], &json!([])).problem(400);
    let raw = |headers: &[(&str, &str)], body: &str| request(server.addr, "PATCH", &format!("{photo}/strokes"), headers, body.as_bytes());
    raw(&[("content-type", "text/plain")], "{}").problem(415);
    let at_limit = format!("{{{}}}", " ".repeat((1 << 19) - 2));
    assert_eq!(raw(&[PATCH], &at_limit).status, 200);
    raw(&[PATCH], &format!("{at_limit} ")).problem(413);
    assert_eq!(raw(&[PATCH, ("sec-fetch-site", "cross-site")], "{}").problem(403)["type"], "urn:tmpi:problem:cross-site");
    patch(&server, "/v1/photos/0123456789abcdef0123456789abcdef", &[], &json!({})).problem(404);
    assert_eq!(get(server.addr, &format!("{photo}/strokes")).json()["strokes"], json!([]));
}

#[test]
fn strokes_are_refused_while_the_photo_is_made() {
    let gate = Gate::new(1);
    let server = Running::with(Limits::default(), gate.clone());
    let id = server.make(&jpeg(1));
    let photo = format!("/v1/photos/{id}");
    patch(&server, &photo, &[], &json!({ "strokes": [sky()] })).is(202);
    gate.wait_started(2);
    let refused = patch(&server, &photo, &[], &json!({ "strokes": null })).problem(409);
    assert_eq!((&refused["type"], &refused["retry_after"]), (&json!("urn:tmpi:problem:not-ready"), &json!(1)));
    get(server.addr, &format!("{photo}/atlas")).problem(409);
    gate.open(1);
    server.wait(&id, "done");
    assert_eq!(gate.finished.load(Ordering::SeqCst), 2);
    assert_eq!(get(server.addr, &format!("{photo}/report")).json()["input"]["strokes"], 1);
    assert_eq!(request(server.addr, "DELETE", &photo, &[], &[]).status, 204);
    assert!(contents(server.data(), &id, "").is_empty());
}
