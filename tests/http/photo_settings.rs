//! Settings of a photo, animations, and abandoned views.

use tmpi_testing::Need;

use crate::prelude::*;

/// The header of a merge patch.
pub const PATCH: (&str, &str) = ("content-type", "application/merge-patch+json");

pub fn patch(server: &Running, path: &str, headers: &[(&str, &str)], body: &Value) -> Response {
    request(server.addr, "PATCH", path, &[&[PATCH], headers].concat(), body.to_string().as_bytes())
}

#[test]
fn a_photo_uploaded_again_takes_the_new_title_and_is_listed_first() {
    let (server, photo) = Running::with_photo();
    let first = photo.rsplit('/').next().unwrap().to_owned();
    let second = server.make(&picture(2, PictureFormat::Png));
    assert_eq!(server.listed(), [second.clone(), first.clone()]);
    let send = |query: &str| request(server.addr, "POST", &format!("/v1/photos{query}"), &[], &picture(1, PictureFormat::Png));
    let again = send("?title=By%20the%20lake");
    assert_eq!((again.status, again.json()["id"].as_str()), (202, Some(first.as_str())));
    assert_eq!(again.json()["settings"], json!({ "version": 1, "title": "By the lake" }));
    // an upload without a title keeps the title
    assert_eq!(send("").json()["settings"]["title"], "By the lake");
    let page = get(server.addr, "/v1/photos?limit=1").json();
    assert_eq!(page["photos"][0]["id"], first);
    assert_eq!(get(server.addr, page["next"].as_str().unwrap()).json()["photos"][0]["id"], second);
    let server = server.restarted();
    assert_eq!(server.listed(), [first, second]);
    assert_eq!(request(server.addr, "DELETE", &photo, &[], &[]).status, 204);
    assert_eq!(server.listed().len(), 1);
}

#[test]
fn downloads_are_named_after_the_title() {
    let (server, photo) = Running::with_photo();
    let id = photo.rsplit('/').next().unwrap();
    let name =
        || request(server.addr, "GET", &format!("{photo}/export?format=glb"), &[], &[]).header("content-disposition").unwrap().to_owned();
    assert_eq!(name(), format!("attachment; filename=\"{id}.glb\""));
    patch(&server, &photo, &[], &json!({ "title": "By the lake: \"Rex\"" }));
    assert_eq!(name(), "attachment; filename=\"By-the-lake-Rex.glb\"");
    patch(&server, &photo, &[], &json!({ "title": "Am Müggelsee" }));
    assert_eq!(name(), format!("attachment; filename=\"{id}.glb\"; filename*=UTF-8''Am-M%C3%BCggelsee.glb"));
}

#[test]
fn settings_stay_with_the_photo() {
    let (server, photo) = Running::with_photo();
    let before = get(server.addr, &photo);
    assert_eq!(before.json()["settings"], json!({ "version": 1 }));
    let thumbnail = before.json()["links"]["thumbnail"].clone();
    assert_eq!(before.json()["links"]["poster"], thumbnail);
    let etag = before.header("etag").unwrap().to_owned();
    assert_eq!(request(server.addr, "GET", &photo, &[("if-none-match", &etag)], &[]).status, 304);

    let wanted = json!({ "title": "A box", "motion": { "x": 0.5 }, "focus": 0.4, "start": { "x": -0.25 }, "poster": { "x": 1, "y": -1 } });
    let changed = patch(&server, &photo, &[("if-match", &etag)], &wanted).is(200);
    let settings = changed.json()["settings"].clone();
    assert_eq!(settings["title"], "A box");
    assert_eq!(settings["motion"], json!({ "x": 0.5, "y": 1.0, "z": 1.0 }));
    let second = changed.header("etag").unwrap().to_owned();
    assert_ne!(second, etag);
    assert_eq!(get(server.addr, &photo).header("etag"), Some(second.as_str()));

    // `If-Match` with an old tag does not overwrite the change
    let late = patch(&server, &photo, &[("if-match", &etag)], &json!({ "title": null }));
    assert_eq!(late.problem(412)["field"], "If-Match");
    let poster = get(server.addr, changed.json()["links"]["poster"].as_str().unwrap());
    assert_eq!((poster.status, poster.header("content-type")), (200, Some("image/jpeg")));

    let server = server.restarted();
    assert_eq!(get(server.addr, &photo).json()["settings"], settings, "after a restart");
    let removed = patch(&server, &photo, &[], &json!({ "title": null, "poster": null }));
    assert_eq!((removed.json()["settings"].get("title"), &removed.json()["links"]["poster"]), (None, &thumbnail));
}

#[test]
fn a_wrong_setting_is_named_and_changes_nothing() {
    let (server, photo) = Running::with_photo();
    for (body, field) in [(json!({ "title": "fine", "motion": { "x": 1.5 } }), "motion.x"), (json!({ "colour": "red" }), "colour")] {
        assert_eq!(patch(&server, &photo, &[], &body).problem(400)["field"], field);
    }
    patch(&server, &photo, &[], &json!(3)).problem(400);
    request(server.addr, "PATCH", &photo, &[("content-type", "text/plain")], b"{}").problem(415);
    request(server.addr, "PATCH", &photo, &[], b"{}").problem(415);
    let at_limit = format!("{{{}}}", " ".repeat((16 << 10) - 2));
    assert_eq!(request(server.addr, "PATCH", &photo, &[PATCH], at_limit.as_bytes()).status, 200);
    request(server.addr, "PATCH", &photo, &[PATCH], format!("{at_limit} ").as_bytes()).problem(413);
    request(server.addr, "PATCH", "/v1/photos/0123456789abcdef0123456789abcdef", &[PATCH], b"{}").problem(404);
    let foreign = request(server.addr, "PATCH", &photo, &[PATCH, ("sec-fetch-site", "cross-site")], b"{}");
    assert_eq!(foreign.problem(403)["type"], "urn:tmpi:problem:cross-site");
    assert_eq!(get(server.addr, &photo).json()["settings"], json!({ "version": 1 }));
}

#[test]
fn a_camera_path_is_drawn_as_an_animation() {
    let (server, photo) = Running::with_photo();
    for (query, media_type, magic) in
        [("path=swing&frames=4", "image/webp", (8, b"WEBP")), ("path=orbit&frames=3&w=64&format=mp4", "video/mp4", (4, b"ftyp"))]
    {
        let answer = get(server.addr, &format!("{photo}/view?{query}"));
        if answer.status == 501 {
            assert_eq!(answer.problem(501)["field"], "path");
            let _: Option<()> = Need::Ffmpeg.or_skip(Err("the server finds no ffmpeg"));
            return;
        }
        assert_eq!((answer.status, answer.header("content-type")), (200, Some(media_type)), "{}", String::from_utf8_lossy(&answer.body));
        assert_eq!(&answer.body[magic.0..magic.0 + 4], magic.1);
        let again =
            request(server.addr, "GET", &format!("{photo}/view?{query}"), &[("if-none-match", answer.header("etag").unwrap())], &[]);
        assert_eq!(again.status, 304);
    }
    assert_eq!(get(server.addr, &format!("{photo}/view?path=orbit&frames=240&w=2000&h=2000")).problem(400)["field"], "w");
}

#[test]
fn abandoned_views_are_not_drawn() {
    const CLIENTS: usize = 8;
    let server = Running::with(Limits { views: 1, views_waiting: CLIENTS, ..Limits::default() }, Arc::new(pipeline()));
    let photo = format!("/v1/photos/{}", server.make(&picture(1, PictureFormat::Png)));
    let path = |n: usize| format!("{photo}/view?tx=0.00{n}&w=4000&h=3000&format=png");
    let clients: Vec<_> = (0..CLIENTS).map(|n| Connection::asking(server.addr, &path(n))).collect();
    // the request for the metrics counts, too
    wait_until("all ask", || server.metric("tmpi_requests_in_flight") > CLIENTS as u64);
    drop(clients);
    wait_until("all are gone", || server.metric("tmpi_requests_in_flight") <= 1);
    let view = get(server.addr, &format!("{photo}/view?w=40"));
    assert_eq!(view.status, 200, "the slots are free: {}", String::from_utf8_lossy(&view.body));
    let drawn = server.metric("tmpi_view_seconds_count{phase=\"render\"}");
    assert!((1..CLIENTS as u64).contains(&drawn), "{drawn} views were drawn to the end");
}

#[test]
fn if_match_depends_on_the_settings_not_on_the_progress() {
    let gate = Gate::new(0);
    let server = Running::with(Limits::default(), gate.clone());
    let id = server.upload(&jpeg(1));
    gate.wait_started(1);
    let photo = format!("/v1/photos/{id}");
    let seen = get(server.addr, &photo).header("etag").unwrap().to_owned();
    gate.open(1);
    server.wait(&id, "done");
    assert_ne!(get(server.addr, &photo).header("etag"), Some(seen.as_str()), "the state has changed");
    assert_eq!(patch(&server, &photo, &[("if-match", &seen)], &json!({ "title": "A" })).status, 200);
    patch(&server, &photo, &[("if-match", &seen)], &json!({ "title": "B" })).problem(412);
}

#[test]
fn parallel_changes_are_all_kept_and_never_restore_a_deleted_photo() {
    let (server, photo) = Running::with_photo();
    let settings = [json!({ "title": "A" }), json!({ "focus": 0.5 }), json!({ "speed": 2.0 }), json!({ "idle": "orbit" })];
    std::thread::scope(|scope| {
        for one in &settings {
            let (server, photo) = (&server, &photo);
            scope.spawn(move || assert_eq!(patch(server, photo, &[], one).status, 200));
        }
    });
    let all = json!({ "version": 1, "title": "A", "focus": 0.5, "speed": 2.0, "idle": "orbit" });
    assert_eq!(get(server.addr, &format!("{photo}/settings")).json(), all);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                let status = patch(&server, &photo, &[], &json!({ "title": "B" })).status;
                assert!(matches!(status, 200 | 404), "{status}");
            });
        }
        assert_eq!(request(server.addr, "DELETE", &photo, &[], &[]).status, 204);
    });
    assert_eq!(patch(&server, &photo, &[], &json!({})).status, 404);
}
