//! Uploads, states, the list, deletion.

use crate::prelude::*;

#[test]
fn raw_and_multipart_in_every_format() {
    let server = Running::open();
    for format in PictureFormat::ALL {
        let photo = picture(1, format);
        let raw = request(server.addr, "POST", "/v1/photos", &[("content-type", format.media_type())], &photo).is(202);
        let state = raw.json();
        let id = state["id"].as_str().unwrap();
        assert_eq!(raw.header("location"), Some(format!("/v1/photos/{id}").as_str()));
        assert_eq!(state["photo_bytes"], photo.len());
        assert_eq!(state["options"]["quality"], "90");
        let form = post_form(server.addr, &[], &[("photo", &photo)]);
        assert_eq!((form.status, form.json()["id"].as_str()), (202, Some(id)), "the same photo either way");
        let done = server.wait(id, "done");
        assert_eq!((done["width"].as_u64(), done["height"].as_u64()), (Some(80), Some(60)));
        assert!(done["atlas_bytes"].as_u64().unwrap() > 0 && done["finished"].is_string());
    }
    // a client without a useful content type, such as `curl --data-binary`
    request(server.addr, "POST", "/v1/photos", &[("content-type", "application/x-www-form-urlencoded")], &jpeg(9)).is(202);
}

#[test]
fn waiting_for_the_result() {
    let gate = Gate::new(1);
    let server = Running::with(Limits::default(), gate.clone());
    let done = request(server.addr, "POST", "/v1/photos", &[("prefer", "respond-async, wait=20")], &jpeg(1));
    assert_eq!((done.status, done.json()["state"].as_str()), (201, Some("done")));
    assert_eq!(done.header("preference-applied"), Some("wait=20"));
    assert!(done.header("location").is_some());
    let late = request(server.addr, "POST", "/v1/photos", &[("prefer", "wait=0")], &jpeg(2)).is(202).json();
    assert_ne!(late["state"], "done");
    gate.open(1);
}

#[test]
fn options_and_depth_are_part_of_the_photo() {
    let server = Running::open();
    let photo = jpeg(3);
    let plain = server.upload(&photo);
    let query = request(server.addr, "POST", "/v1/photos?quality=70&plane_method=lloyd", &[], &photo).json();
    assert_eq!((query["options"]["quality"].as_str(), query["options"]["plane-method"].as_str()), (Some("70"), Some("lloyd")));
    let field = post_form(server.addr, &[], &[("quality", b"70"), ("photo", &photo), ("plane-method", b"lloyd")]).json();
    assert_eq!(query["id"], field["id"]);
    let with_depth = post_form(server.addr, &[], &[("photo", &photo), ("depth", &depth_map())]).json();
    let ids = [plain.as_str(), query["id"].as_str().unwrap(), with_depth["id"].as_str().unwrap()];
    assert!(ids[0] != ids[1] && ids[1] != ids[2] && ids[0] != ids[2]);
    for id in ids {
        server.wait(id, "done");
    }
    let report = |id| get(server.addr, &format!("/v1/photos/{id}/report")).json();
    assert_eq!((report(ids[0])["depth_model"].as_str(), report(ids[2])["depth_model"].as_str()), (Some("ramp"), Some("given")));
}

#[test]
fn wrong_uploads_are_refused_at_once_and_leave_nothing() {
    let server = Running::open();
    let photo = jpeg(1);
    let post = |path: &str, body: &[u8]| request(server.addr, "POST", path, &[], body);
    assert_eq!(post("/v1/photos", b"").problem(400)["field"], "photo");
    post("/v1/photos", b"GIF89a....").problem(415);
    // for HEIC the answer says what to do
    let heic = post("/v1/photos", b"\0\0\0\x24ftypheic\0\0\0\0mif1heic").problem(415);
    let told = heic["detail"].as_str().unwrap();
    assert!(told.contains("Settings > Camera > Formats > Most Compatible") && told.contains("sends this one as JPEG"), "{told}");
    assert!(told.contains("a portrait may lose its depth"), "{told}");
    // JPEGs cut later than this are checked by decoding
    assert_eq!(post("/v1/photos", &photo[..200]).problem(422)["type"], "urn:tmpi:problem:broken-photo");
    let png = picture(1, PictureFormat::Png);
    for cut in [200, png.len() / 2, png.len() - 40] {
        assert_eq!(post("/v1/photos", &png[..cut]).problem(422)["type"], "urn:tmpi:problem:broken-photo", "{cut} bytes");
    }
    assert_eq!(post("/v1/photos?quality=0", &photo).problem(400)["field"], "quality");
    assert_eq!(post("/v1/photos?colour=red", &photo).problem(400)["field"], "colour");
    assert_eq!(post_form(server.addr, &[], &[("quality", b"80")]).problem(400)["field"], "photo");
    assert_eq!(post_form(server.addr, &[], &[("photo", &photo), ("photo", &photo)]).problem(400)["field"], "photo");
    assert_eq!(post_form(server.addr, &[], &[("photo", &photo), ("picture", b"x")]).problem(400)["field"], "picture");
    let bare = request(server.addr, "POST", "/v1/photos", &[("content-type", "multipart/form-data")], &photo);
    bare.problem(400);
    let cut = request(server.addr, "POST", "/v1/photos", &[("content-type", "multipart/form-data; boundary=x")], b"--x\r\nnothing");
    cut.problem(400);
    request(server.addr, "POST", "/v1/photos", &[("sec-fetch-site", "cross-site")], &photo).problem(403);
    assert_eq!(server.listed().len(), 0);
    // temporary files are deleted after the answer
    wait_until("nothing is left", || incoming(server.data()) == 0 && contents(server.data(), "", "").is_empty());
}

#[test]
fn a_failed_photo_says_why_and_the_same_upload_tries_again() {
    let server = Running::open();
    let refused = post_form(server.addr, &[], &[("photo", &jpeg(1)), ("depth", b"not a map")]);
    assert_eq!(refused.problem(422)["field"], "depth");
    let wrong = post_form(server.addr, &[("prefer", "wait=20")], &[("photo", &jpeg(1)), ("depth", &spoilt_map())]);
    assert_eq!(wrong.problem(422)["field"], "depth");
    let id = wrong.header("location").unwrap().rsplit('/').next().unwrap().to_owned();
    let state = server.state(&id);
    assert_eq!((state["state"].as_str(), state["problem"]["status"].as_u64()), (Some("failed"), Some(422)));
    get(server.addr, &format!("/v1/photos/{id}/atlas")).problem(422);

    let broken = MakeError::Photo(tmpi_pipeline::photo::PhotoError::Broken("the first time".into()));
    let server = Running::with(Limits::default(), failing(vec![broken.into()]));
    let id = server.upload(&jpeg(1));
    server.wait(&id, "failed");
    assert_eq!(server.upload(&jpeg(1)), id);
    server.wait(&id, "done");
}

#[test]
fn a_panic_in_a_job_fails_only_that_photo() {
    let server = Running::with(
        Limits::default(),
        Arc::new(Does(|photo: &[u8], sink: &dyn Sink| {
            assert_ne!(photo, jpeg(66), "on purpose");
            Maker::make(&pipeline(), photo, None, &Options::default(), sink)
        })),
    );
    let (bad, good) = (server.upload(&jpeg(66)), server.upload(&jpeg(1)));
    assert_eq!(server.wait(&bad, "failed")["problem"]["status"], 500);
    server.wait(&good, "done");
}

#[test]
fn parallel_uploads_of_one_photo_make_it_once() {
    let gate = Gate::new(0);
    let server = Running::with(Limits::default(), gate.clone());
    let photo = jpeg(5);
    let ids: Vec<String> = std::thread::scope(|scope| {
        let all: Vec<_> = (0..8).map(|_| scope.spawn(|| server.upload(&photo))).collect();
        all.into_iter().map(|t| t.join().unwrap()).collect()
    });
    assert!(ids.iter().all(|id| *id == ids[0]));
    gate.open(8);
    server.wait(&ids[0], "done");
    server.upload(&photo);
    assert_eq!(gate.started.load(Ordering::SeqCst), 1);
    assert_eq!(server.listed().len(), 1);
}

#[test]
fn the_list_has_pages_newest_first() {
    let server = Running::with(Limits::default(), Gate::new(0));
    let mut ids: Vec<String> = (0..5).map(|seed| server.upload(&jpeg(seed))).collect();
    ids.reverse();
    let page = |path: &str| {
        let page = get(server.addr, path).json();
        let ids: Vec<String> = page["photos"].as_array().unwrap().iter().map(id).collect();
        (ids, page["next"].as_str().map(str::to_owned))
    };
    // uploads of the same millisecond are ordered by id
    let (mut all, next) = page("/v1/photos");
    assert_eq!(next, None);
    let listed = all.clone();
    all.sort();
    ids.sort();
    assert_eq!(all, ids);
    let (first, next) = page("/v1/photos?limit=2");
    assert_eq!(first, listed[..2]);
    let (second, next) = page(&next.unwrap());
    assert_eq!(second, listed[2..4]);
    let (third, next) = page(&next.unwrap());
    assert_eq!((third.as_slice(), next), (&listed[4..], None));
    assert_eq!(page(&format!("/v1/photos?after={}", listed[2])).0, listed[3..]);
    for (query, field) in [("limit=0", "limit"), ("limit=201", "limit"), ("limit=x", "limit"), ("after=zz", "after"), ("page=2", "page")] {
        assert_eq!(get(server.addr, &format!("/v1/photos?{query}")).problem(400)["field"], field);
    }
    assert_eq!(get(server.addr, "/v1/photos?limit=200").status, 200);
}

#[test]
fn deletion_while_queued_while_running_and_when_done() {
    let gate = Gate::new(1);
    let server = Running::with(Limits::default(), gate.clone());
    let delete = |id: &str| request(server.addr, "DELETE", &format!("/v1/photos/{id}"), &[], &[]);
    let done = server.make(&jpeg(1));
    let running = server.upload(&jpeg(2));
    gate.wait_started(2);
    let queued = server.upload(&jpeg(3));
    assert_eq!(server.state(&queued)["position"], 0);
    for id in [&queued, &running, &done] {
        assert_eq!(delete(id).status, 204);
        delete(id).problem(404);
        get(server.addr, &format!("/v1/photos/{id}")).problem(404);
        get(server.addr, &format!("/v1/photos/{id}/atlas")).problem(404);
    }
    // the worker is free, and the deleted photo can be uploaded again
    gate.open(2);
    assert_eq!(server.upload(&jpeg(2)), running);
    server.wait(&running, "done");
    wait_until("only one is left", || contents(server.data(), "", "upload").len() == 1);
    assert_eq!(incoming(server.data()), 0);
}

#[test]
fn finished_failed_and_queued_photos_survive_a_restart() {
    let gate = Gate::new(1);
    let limits = || Limits { drain: std::time::Duration::from_millis(200), ..Limits::default() };
    let server = Running::with(limits(), gate.clone());
    let done = server.upload(&jpeg(1));
    let before = server.wait(&done, "done");
    let failed = id(&post_form(server.addr, &[], &[("photo", &jpeg(1)), ("depth", &spoilt_map())]).json());
    gate.open(1);
    server.wait(&failed, "failed");
    let atlas = get(server.addr, &format!("/v1/photos/{done}/atlas"));
    let unfinished: Vec<String> = (2..6).map(|seed| server.upload(&jpeg(seed))).collect();
    gate.wait_started(3);

    let gate = Gate::new(99);
    let server = server.again(limits(), gate.clone());
    for id in &unfinished {
        server.wait(id, "done");
    }
    assert_eq!(gate.started.load(Ordering::SeqCst), unfinished.len(), "none is made twice");
    assert_eq!(server.state(&done), before);
    let again = get(server.addr, &format!("/v1/photos/{done}/atlas"));
    assert_eq!((atlas.header("etag"), &atlas.body), (again.header("etag"), &again.body));
    assert_eq!(server.state(&failed)["problem"]["status"], 422);
}

/// Sends a form: fields, then a photo with a file name.
fn named_form(server: &Running, fields: &[(&str, &str)], file: &str, photo: &[u8]) -> Response {
    let mut body = Vec::new();
    for (name, value) in fields {
        body.extend(format!("--x\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n{value}\r\n").bytes());
    }
    body.extend(format!("--x\r\ncontent-disposition: form-data; name=\"photo\"; filename=\"{file}\"\r\n\r\n").bytes());
    body.extend(photo);
    body.extend(b"\r\n--x--\r\n");
    request(server.addr, "POST", "/v1/photos", &[("content-type", "multipart/form-data; boundary=x")], &body)
}

/// Browsers send empty fields of a form, and empty files for unused file inputs.
#[test]
fn empty_fields_of_a_form_count_as_absent() {
    let server = Running::open();
    let part =
        |head: &str, body: &[u8]| [format!("--x\r\ncontent-disposition: form-data; {head}\r\n\r\n").as_bytes(), body, b"\r\n"].concat();
    let file = |name: &str| part(&format!("name=\"{name}\"; filename=\"\"\r\ncontent-type: application/octet-stream"), b"");
    let text = |name: &str, value: &str| part(&format!("name=\"{name}\""), value.as_bytes());
    let photo = part("name=\"photo\"; filename=\"my %22best%22.jpg\"", &jpeg(1));
    let send = |parts: &[&[u8]]| {
        let body = [&parts.concat()[..], b"--x--\r\n"].concat();
        request(server.addr, "POST", "/v1/photos", &[("content-type", "multipart/form-data; boundary=x")], &body)
    };
    let alone = send(&[&photo]).json();
    assert_eq!(alone["settings"]["title"], "my \"best\"");
    let options = ["title", "visibility", "class", "max-size", "fov-x", "depth-kind"].map(|name| text(name, ""));
    let around = [file("photo"), photo.clone(), file("depth"), file("photo"), text("title", "  "), options.concat()];
    let all = send(&around.iter().map(Vec::as_slice).collect::<Vec<_>>());
    assert!(all.status < 300, "{}", String::from_utf8_lossy(&all.body));
    assert_eq!((&all.json()["id"], &all.json()["settings"]["title"]), (&alone["id"], &alone["settings"]["title"]));
    assert_eq!(send(&[&file("photo"), &file("depth")]).problem(400)["field"], "photo");
    // fields that are not empty are still checked, and may occur once
    assert_eq!(send(&[&photo, &text("title", ""), &text("max-size", "x")]).problem(400)["field"], "max-size");
    assert_eq!(send(&[&photo, &photo]).problem(400)["field"], "photo");
    assert!(contents(server.data(), alone["id"].as_str().unwrap(), "depth").is_empty());
}

#[test]
fn a_photos_title_is_its_file_name_or_the_uploads_title() {
    let server = Running::open();
    let title = |state: &serde_json::Value| state["settings"]["title"].as_str().map(str::to_owned);
    let by_file = named_form(&server, &[], "Söhne am Meer.jpeg", &jpeg(1)).json();
    assert_eq!(title(&by_file).as_deref(), Some("Söhne am Meer"));
    let said = named_form(&server, &[("title", " Zwei & <drei> ")], "IMG_1.jpg", &jpeg(2)).json();
    assert_eq!(title(&said).as_deref(), Some("Zwei & <drei>"));
    let raw = request(server.addr, "POST", "/v1/photos?title=By%20the%20sea", &[], &jpeg(3)).json();
    assert_eq!(title(&raw).as_deref(), Some("By the sea"));
    // decomposed characters, as in file names of macOS
    let apart = named_form(&server, &[], "A\u{308}gypten a\u{300} la plage.jpg", &jpeg(6)).json();
    assert_eq!(title(&apart).as_deref(), Some("Ägypten à la plage"));
    let nameless = named_form(&server, &[], "image.jpg", &jpeg(4)).json();
    assert_eq!(title(&nameless), None);

    // the same photo under another file name keeps its title; an explicit title replaces it
    let again = named_form(&server, &[], "mine.jpg", &jpeg(1)).json();
    assert_eq!((&again["id"], title(&again).as_deref()), (&by_file["id"], Some("Söhne am Meer")));
    let renamed = named_form(&server, &[("title", "Mine")], "mine.jpg", &jpeg(1)).json();
    assert_eq!((&renamed["id"], title(&renamed).as_deref()), (&by_file["id"], Some("Mine")));
    // the photo is listed first, with its old creation time
    let list = get(server.addr, "/v1/photos").json();
    assert_eq!((&list["photos"][0]["id"], &list["photos"][0]["created"]), (&by_file["id"], &by_file["created"]), "{list}");

    for (fields, field) in [(&[("title", "a"), ("title", "b")][..], "title"), (&[("file", "x")], "file")] {
        assert_eq!(named_form(&server, fields, "a.jpg", &jpeg(5)).problem(400)["field"], field);
    }
    // an unknown field is refused before its value is read
    let large = "x".repeat(100_000);
    let detail = named_form(&server, &[("picture", &large)], "a.jpg", &jpeg(5)).problem(400)["detail"].to_string();
    assert!(detail.contains("no such field"), "{detail}");
    let long = "é".repeat(201);
    assert_eq!(named_form(&server, &[("title", &long)], "a.jpg", &jpeg(5)).problem(400)["field"], "title");

    let server = server.restarted();
    assert_eq!(title(&server.state(by_file["id"].as_str().unwrap())).as_deref(), Some("Mine"), "after a restart");
}
