//! Files made of a photo, pages, and the headers of every answer.
#![allow(clippy::float_cmp, reason = "figures that must be exact")]

use tmpi::server::routes;

use crate::prelude::*;
use crate::process::large;

#[test]
fn the_atlas_whole_in_parts_and_not_at_all() {
    let (server, photo) = Running::with_photo();
    let path = format!("{photo}/atlas");
    let fetch = |method: &str, headers: &[(&str, &str)]| request(server.addr, method, &path, headers, &[]);
    let whole = fetch("GET", &[]).is(200);
    assert_eq!(whole.header("content-type"), Some("application/vnd.tmpi"));
    assert_eq!(whole.header("cache-control"), Some("no-cache"));
    assert_eq!(whole.header("accept-ranges"), Some("bytes"));
    assert!(whole.body.starts_with(b"TMPI"));
    assert!(tmpi_core::container::decode(&whole.body).is_ok());
    let etag = whole.header("etag").unwrap().to_owned();
    assert!(etag.starts_with('"') && etag.ends_with('"'), "strong: {etag}");
    let length = whole.body.len();

    let head = fetch("HEAD", &[]);
    assert_eq!((head.status, head.header("content-length"), head.body.len()), (200, Some(length.to_string().as_str()), 0));
    assert_eq!(head.header("etag"), Some(etag.as_str()));

    for tag in [etag.as_str(), "*", &format!("W/{etag}"), &format!("\"other\", {etag}")] {
        let same = fetch("GET", &[("if-none-match", tag)]);
        assert_eq!((same.status, same.body.len(), same.header("etag")), (304, 0, Some(etag.as_str())), "{tag}");
    }
    assert_eq!(fetch("GET", &[("if-none-match", "\"other\"")]).status, 200);

    let part = fetch("GET", &[("range", "bytes=4-11")]);
    assert_eq!((part.status, part.body.as_slice()), (206, &whole.body[4..12]));
    assert_eq!(part.header("content-range"), Some(format!("bytes 4-11/{length}").as_str()));
    assert_eq!(fetch("GET", &[("range", "bytes=-5")]).body, whole.body[length - 5..]);
    assert_eq!(fetch("GET", &[("range", "bytes=12-")]).body, whole.body[12..]);
    let last = length - 1;
    assert_eq!(fetch("GET", &[("range", &format!("bytes={last}-"))]).status, 206);
    let beyond = fetch("GET", &[("range", &format!("bytes={length}-"))]);
    beyond.problem(416);
    assert_eq!(beyond.header("content-range"), Some(format!("bytes */{length}").as_str()));
    assert_eq!(fetch("GET", &[("range", "bytes=0-1,3-4")]).status, 200);

    assert_eq!(fetch("GET", &[("range", "bytes=0-1"), ("if-range", &etag)]).status, 206);
    assert_eq!(fetch("GET", &[("range", "bytes=0-1"), ("if-range", "\"other\"")]).status, 200);
}

#[test]
fn smaller_levels_of_the_atlas() {
    let (server, photo) = Running::with_photo();
    let fetch = |query: &str| get(server.addr, &format!("{photo}/atlas{query}"));
    let whole = fetch("");
    assert_eq!(fetch("?level=0").body, whole.body);
    for (level, width) in [(1, 40), (2, 20), (3, 10)] {
        let small = fetch(&format!("?level={level}"));
        assert_eq!((small.status, small.header("content-type")), (200, Some("application/vnd.tmpi")));
        assert_ne!(small.header("etag"), whole.header("etag"));
        assert_eq!(tmpi_core::container::decode(&small.body).unwrap().grid.width, width);
    }
    for (fit, width) in [(1, 10), (10, 10), (11, 20), (40, 40), (41, 80), (5000, 80)] {
        assert_eq!(tmpi_core::container::decode(&fetch(&format!("?fit={fit}")).body).unwrap().grid.width, width, "{fit}");
    }
    for wrong in ["4", "-1", "x", ""] {
        assert_eq!(fetch(&format!("?level={wrong}")).problem(400)["field"], "level");
    }
    for wrong in ["0", "65536", "x"] {
        assert_eq!(fetch(&format!("?fit={wrong}")).problem(400)["field"], "fit");
    }
}

#[test]
fn regions_of_the_atlas() {
    let (server, photo) = Running::with_photo();
    let fetch = |query: &str| get(server.addr, &format!("{photo}/atlas{query}"));
    let whole = fetch("");
    let camera = |body: &[u8]| tmpi_core::container::decode(body).unwrap().intrinsics;
    let mut tags = vec![whole.header("etag").unwrap().to_owned()];
    for (query, size, corner) in [
        ("?region=0,0,10,10", (64, 60), 0.0),
        ("?region=70,0,10,60", (24, 60), 56.0),
        ("?region=70%2C50%2C1%2C1&level=1", (12, 30), 28.0),
        // the region's 10 pixels at level 0 are 5 at level 1
        ("?region=0,0,10,10&fit=5", (32, 30), 0.0),
        ("?region=0,0,10,10&fit=6", (64, 60), 0.0),
    ] {
        let part = fetch(query);
        assert_eq!((part.status, part.header("content-type")), (200, Some("application/vnd.tmpi")), "{query}");
        assert_eq!(part.header("cache-control"), whole.header("cache-control"));
        let scene = tmpi_core::container::decode(&part.body).unwrap();
        assert_eq!((scene.grid.width, scene.grid.height), size, "{query}");
        let scale = f64::from(scene.grid.size) / 64.0;
        assert_eq!(scene.intrinsics.cx, camera(&whole.body).cx * scale - corner, "{query}");
        tags.push(part.header("etag").unwrap().to_owned());
    }
    // regions over the same tiles are the same file
    assert_eq!(tags[1], tags[5]);
    assert_eq!(fetch("?region=3,4,5,6").header("etag"), Some(tags[1].as_str()));
    assert!((1..5).all(|i| !tags[..i].contains(&tags[i])), "{tags:?}");
    assert_eq!(fetch("?region=0,0,80,60").body, whole.body, "all tiles are the photo itself");
    let held = tmpi_core::container::sections(&fetch("?region=70,0,5,5&sections=photo").body).unwrap();
    assert_eq!(held.iter().map(|s| s.kind).collect::<Vec<_>>(), ["photo"]);

    let path = format!("{photo}/atlas?region=70,0,5,5");
    let all = get(server.addr, &path);
    let head = request(server.addr, "HEAD", &path, &[], &[]);
    assert_eq!((head.status, head.header("content-length")), (200, Some(all.body.len().to_string().as_str())));
    let part = request(server.addr, "GET", &path, &[("range", "bytes=4-11"), ("if-range", &tags[2])], &[]);
    assert_eq!((part.status, part.body.as_slice()), (206, &all.body[4..12]));
    assert_eq!(request(server.addr, "GET", &path, &[("if-none-match", &tags[2])], &[]).status, 304);

    for wrong in ["", "1,2,3", "1,2,3,4,5", "a,0,1,1", "-1,0,5,5", "0,0,0,5", "0,0,81,5", "79,59,2,1", "0,0,1.5,5", "0,0,4294967296,5"] {
        assert_eq!(fetch(&format!("?region={wrong}")).problem(400)["field"], "region", "{wrong}");
    }
}

#[test]
fn chosen_sections_of_the_atlas() {
    let (server, photo) = Running::with_photo();
    let fetch = |query: &str| get(server.addr, &format!("{photo}/atlas{query}"));
    let whole = fetch("");
    let mut tags = vec![whole.header("etag").unwrap().to_owned()];
    for (query, kinds) in [
        ("?sections=index", &[][..]),
        ("?sections=index,photo", &["photo"]),
        ("?sections=labels,planes", &["planes", "labels"]),
        ("?level=1&sections=photo", &["photo"]),
        ("?sections=photo%2Chidden", &["photo"]),
    ] {
        let some = fetch(query);
        assert_eq!((some.status, some.header("cache-control")), (200, whole.header("cache-control")), "{query}");
        let held = tmpi_core::container::sections(&some.body).unwrap();
        assert_eq!(held.iter().map(|s| s.kind).collect::<Vec<_>>(), kinds, "{query}");
        tags.push(some.header("etag").unwrap().to_owned());
    }
    // the last query selects the same sections as the second
    assert_eq!(tags.pop().unwrap(), tags[2]);
    assert!((1..tags.len()).all(|i| !tags[..i].contains(&tags[i])), "{tags:?}");
    let path = format!("{photo}/atlas?sections=photo");
    let part = request(server.addr, "GET", &path, &[("range", "bytes=0-3")], &[]);
    assert_eq!((part.status, part.body.as_slice()), (206, &b"TMPI"[..]));
    for wrong in ["", "photo,", "depth", "photo,pixels"] {
        let problem = fetch(&format!("?sections={wrong}")).problem(400);
        assert_eq!(problem["field"], "sections");
        assert!(problem["detail"].as_str().unwrap().contains("there are index, photo, planes, labels, alpha, hidden"));
    }
}

#[test]
fn views_in_every_format_with_their_timing() {
    let (server, photo) = Running::with_photo();
    let view = |query: &str, headers: &[(&str, &str)]| request(server.addr, "GET", &format!("{photo}/view?{query}"), headers, &[]);
    let identity = view("", &[]);
    assert_eq!((identity.status, identity.header("content-type")), (200, Some("image/png")));
    let picture = image::load_from_memory(&identity.body).unwrap().to_rgb8();
    let carried = tmpi_core::container::decode(&get(server.addr, &format!("{photo}/atlas")).body).unwrap().photo;
    assert_eq!(picture.dimensions(), (80, 60));
    assert!(picture.as_raw() == carried.rgb.as_flattened(), "the view from the reference camera is the photo as it is carried");
    // it is close to the uploaded photo
    let uploaded = image::load_from_memory(&crate::fixture::picture(1, PictureFormat::Png)).unwrap().to_rgb8();
    let psnr = tmpi_render::difference::psnr(picture.as_raw(), uploaded.as_raw());
    assert!(psnr > 30.0, "{psnr} dB");
    let timing = identity.all("server-timing");
    for phase in ["decode;dur=", "render;dur=", "encode;dur=", "total;dur="] {
        assert!(timing.contains(phase), "{phase} is missing in {timing}");
    }
    assert_eq!(view("", &[("if-none-match", identity.header("etag").unwrap())]).status, 304);

    let moved = view("tx=0.03&ty=-0.02&tz=0.01&yaw=1&pitch=-1&roll=2&fov=60", &[]).is(200);
    assert_ne!(moved.body, identity.body);
    assert_ne!(moved.header("etag"), identity.header("etag"));

    for (query, accept, media_type) in [
        ("format=jpeg", "*/*", "image/jpeg"),
        ("format=jpg", "*/*", "image/jpeg"),
        ("format=webp", "image/png", "image/webp"),
        ("w=40", "image/jpeg", "image/jpeg"),
        ("w=40", "image/webp,image/*;q=0.5", "image/webp"),
    ] {
        let answer = view(query, &[("accept", accept)]);
        assert_eq!((answer.status, answer.header("content-type")), (200, Some(media_type)), "{query} {accept}");
        assert_eq!(answer.header("vary").map(|v| v.to_lowercase().contains("accept")), Some(true));
        assert!(image::load_from_memory(&answer.body).is_ok());
    }
    view("", &[("accept", "text/html")]).problem(406);
    let size = |query: &str| {
        let p = image::load_from_memory(&view(query, &[]).body).unwrap();
        (p.width(), p.height())
    };
    assert_eq!((size("w=40"), size("h=30"), size("w=10&h=50")), ((40, 30), (40, 30), (10, 50)));
    assert_eq!((size("stereo=sbs&w=40"), size("stereo=anaglyph&w=40"), size("quilt=3x2&w=40")), ((80, 30), (40, 30), (120, 60)));
    let pair = view("stereo=sbs&format=mpo&w=40", &[]);
    assert_eq!(pair.header("content-type"), Some("image/mpo"));
    let eyes = pair.body.windows(4).filter(|w| w == b"\xff\xd8\xff\xe2").count();
    assert_eq!((eyes, image::load_from_memory_with_format(&pair.body, image::ImageFormat::Jpeg).unwrap().width()), (2, 40));
    assert_eq!((size("stereo=half-sbs&w=40"), size("stereo=top-bottom&w=40"), size("stereo=crossed&w=40")), ((40, 30), (40, 60), (80, 30)));
    assert_eq!(view("tx=0.0200001", &[]).body, view("tx=0.02", &[]).body, "poses that look the same");
    assert!(!view("tx=0.02", &[]).all("server-timing").contains("render;dur="), "kept, not drawn again");
    assert_eq!(view("w=16384&h=16384", &[]).problem(400)["field"], "w");
    // extreme but finite cameras give a view or an error, and never crash the server
    for query in ["tz=1e300", "tx=-1e308", "yaw=180", "tz=0.999", "fov=0.1", "fov=179", "roll=1e17", "w=1&h=1", "w=16384&h=1"] {
        let status = view(query, &[]).status;
        assert!(matches!(status, 200 | 400 | 422), "{query}: {status}");
    }
    assert_eq!(get(server.addr, "/healthz").status, 200);
}

#[test]
fn depth_report_and_thumbnail() {
    let (server, photo) = Running::with_photo();
    let depth = get(server.addr, &format!("{photo}/depth"));
    assert_eq!((depth.status, depth.header("content-type")), (200, Some("image/png")));
    let image::DynamicImage::ImageLuma16(map) = image::load_from_memory(&depth.body).unwrap() else { panic!("16-bit grey") };
    assert_eq!(map.dimensions(), (80, 60));
    assert!(map.get_pixel(40, 55).0[0] > map.get_pixel(40, 5).0[0], "the ramp is nearer at the bottom");
    let report = get(server.addr, &format!("{photo}/report"));
    assert_eq!(report.header("content-type"), Some("application/json"));
    let report = report.json();
    for field in ["stages", "total_ms", "peak_rss_bytes", "tiles", "planes", "planes_per_tile", "left_out", "bytes", "error"] {
        assert!(!report[field].is_null(), "{field}");
    }
    assert_eq!(report["input"]["width"], 80);
    let thumbnail = get(server.addr, &format!("{photo}/thumbnail"));
    assert_eq!((thumbnail.status, thumbnail.header("content-type")), (200, Some("image/jpeg")));
    let small = image::load_from_memory(&thumbnail.body).unwrap();
    assert!(small.width().max(small.height()) <= 320);
    for answer in [&depth, &thumbnail] {
        assert!(answer.header("etag").is_some() && answer.header("cache-control") == Some("no-cache"));
    }
}

#[test]
fn exports_to_download() {
    let (server, photo) = Running::with_photo();
    let fetch = |query: &str, headers: &[(&str, &str)]| request(server.addr, "GET", &format!("{photo}/export{query}"), headers, &[]);
    let id = photo.rsplit('/').next().unwrap();
    let mut tags = Vec::new();
    for (query, media_type, ending, first) in [
        ("", "text/html; charset=utf-8", "html", b"<!do"),
        ("?format=glb", "model/gltf-binary", "glb", b"glTF"),
        ("?format=ora", "image/openraster", "ora", b"PK\x03\x04"),
        ("?format=rgbd", "image/png", "rgbd.png", b"\x89PNG"),
        ("?format=zip", "application/zip", "zip", b"PK\x03\x04"),
    ] {
        let answer = fetch(query, &[]);
        assert_eq!((answer.status, answer.header("content-type")), (200, Some(media_type)));
        assert_eq!(answer.header("content-disposition"), Some(format!("attachment; filename=\"{id}.{ending}\"").as_str()));
        assert_eq!(&answer.body[..4], first);
        assert!(answer.all("server-timing").contains("export;dur="));
        let etag = answer.header("etag").unwrap();
        assert_eq!(fetch(query, &[("if-none-match", etag)]).status, 304);
        let part = fetch(query, &[("range", "bytes=2-9"), ("if-range", etag)]);
        assert_eq!((part.status, part.body.as_slice()), (206, &answer.body[2..10]));
        tags.push(etag.to_owned());
    }
    tags.sort();
    tags.dedup();
    assert_eq!(tags.len(), 5, "each format has its own tag");
    assert_eq!(fetch("?format=gltf", &[]).problem(400)["field"], "format");
}

#[test]
fn missing_photos_and_photos_that_are_not_ready() {
    let server = Running::with(Limits::default(), Gate::new(0));
    let id = server.upload(&jpeg(1));
    for part in ["atlas", "view", "depth", "report", "thumbnail", "export"] {
        let early = get(server.addr, &format!("/v1/photos/{id}/{part}"));
        early.problem(409);
        assert!(early.header("retry-after").is_some());
        get(server.addr, &format!("/v1/photos/00000000000000000000000000000000/{part}")).problem(404);
        get(server.addr, &format!("/v1/photos/nonsense/{part}")).problem(404);
    }
    get(server.addr, "/v1/photos/..%2F..%2Fetc").problem(404);
    get(server.addr, "/nothing").problem(404);
    // a browser's navigation gets a page
    for (header, is_page) in [
        (("sec-fetch-dest", "document"), true),
        (("sec-fetch-dest", "empty"), false),
        (("accept", "text/html,application/xhtml+xml,*/*;q=0.8"), true),
        (("accept", "application/json"), false),
    ] {
        let answer = request(server.addr, "GET", "/nothing", &[header], b"");
        let page = answer.header("content-type").is_some_and(|t| t.starts_with("text/html"));
        assert_eq!((answer.status, page), (404, is_page), "{header:?}");
    }
    request(server.addr, "POST", "/nothing", &[("accept", "text/html")], b"").problem(404);
    get(server.addr, "/static/../Cargo.toml").problem(404);
    get(server.addr, "/static/%2e%2e/Cargo.toml").problem(404);
    let wrong = request(server.addr, "PUT", "/v1/photos", &[], &[]);
    wrong.problem(405);
    let allow = wrong.header("allow").unwrap_or_default().to_uppercase();
    assert!(allow.contains("POST") && allow.contains("GET"), "{allow:?}");
}

#[test]
fn options_names_the_methods_of_every_address() {
    let server = Running::open();
    for route in routes() {
        let path =
            route.path.replace("{id}", "0123456789abcdef0123456789abcdef").replace("{room}", "attic").replace("{*name}", "app/style.css");
        let answer = request(server.addr, "OPTIONS", &path, &[], &[]);
        assert!(matches!(answer.status, 200 | 204), "{path}: {}", answer.status);
        let allow = answer.header("allow").unwrap_or_else(|| panic!("{path} names no method")).to_uppercase();
        let named: Vec<_> = allow.split(',').map(str::trim).collect();
        for method in &route.methods {
            assert!(named.contains(&method.as_str()), "{path}: {method} is not among {allow}");
        }
    }
    request(server.addr, "OPTIONS", "/nothing", &[], &[]).problem(404);
}

#[test]
fn isolated_pages_may_frame_a_photo() {
    let server = Running::open();
    for path in ["/embed/0123456789abcdef0123456789abcdef", "/static/decode/worker.js", "/static/live/worker.js"] {
        let answer = get(server.addr, path);
        let said = |name: &str| answer.header(name).map(str::to_owned);
        assert_eq!(said("cross-origin-embedder-policy").as_deref(), Some("require-corp"), "{path}");
        assert_eq!(said("cross-origin-resource-policy").as_deref(), Some("cross-origin"), "{path}");
    }
    assert_eq!(get(server.addr, "/").header("cross-origin-embedder-policy"), None);
}

#[test]
fn an_open_server_creates_no_expiring_link() {
    let (server, photo) = Running::with_photo();
    let links = |query: &str| request(server.addr, "POST", &format!("{photo}/links{query}"), &[], &[]);
    assert_eq!(links("").status, 200);
    let refused = links("?seconds=3600").problem(400);
    assert_eq!(refused["field"], "seconds");
    assert!(refused["detail"].as_str().unwrap().contains("do not expire"), "{refused}");
}

#[test]
fn pages_and_the_headers_of_every_answer() {
    let server = Running::open();
    for path in ["/view/0123456789abcdef0123456789abcdef", "/view/no-id", "/embed/0123456789abcdef0123456789abcdef"] {
        let page = request(server.addr, "GET", path, &[("if-none-match", "*"), ("range", "bytes=0-5")], &[]);
        assert_eq!((page.status, page.header("content-type")), (404, Some("text/html; charset=utf-8")), "{path}");
        assert!(page.text().contains("</html>"), "{path}: a page, not a problem");
    }
    for path in ["/", "/demo"] {
        let page = get(server.addr, path);
        assert_eq!((page.status, page.header("content-type")), (200, Some("text/html; charset=utf-8")));
        let policy = page.header("content-security-policy").unwrap();
        assert!(policy.contains("default-src 'self'") && !policy.contains(" 'unsafe-eval'"), "{policy}");
        let etag = page.header("etag").unwrap();
        assert_eq!(request(server.addr, "GET", path, &[("if-none-match", etag)], &[]).status, 304);
    }
    let shader = get(server.addr, "/static/draw/tmpi.wgsl");
    assert_eq!((shader.status, shader.header("content-type")), (200, Some("text/plain; charset=utf-8")));
    let script = get(server.addr, "/tmpi-viewer.js");
    assert_eq!((script.status, script.header("content-type")), (200, Some("text/javascript; charset=utf-8")));

    for path in ["/", "/healthz", "/v1/photos", "/nothing"] {
        let answer = request(server.addr, "GET", path, &[("origin", "https://example.org"), ("x-request-id", "mine-1")], &[]);
        assert_eq!(answer.header("x-content-type-options"), Some("nosniff"), "{path}");
        assert_eq!(answer.header("x-request-id"), Some("mine-1"));
        assert!(answer.header("referrer-policy").is_some() && answer.header("content-security-policy").is_some());
        assert!(answer.all("server-timing").contains("total;dur="));
    }
}

#[test]
fn health_and_metrics() {
    let (server, photo) = Running::with_photo();
    for path in ["/healthz", "/readyz"] {
        let health = get(server.addr, path);
        assert_eq!((health.status, health.json()["status"].as_str()), (200, Some("ok")));
    }
    assert_eq!(get(server.addr, &format!("{photo}/view?w=8")).status, 200);
    let metrics = get(server.addr, "/metrics");
    assert!(metrics.header("content-type").unwrap().starts_with("application/openmetrics-text"));
    let text = metrics.text();
    let value = |name: &str| {
        text.lines().find_map(|l| l.strip_prefix(name)?.trim().parse::<f64>().ok()).unwrap_or_else(|| panic!("{name} in\n{text}"))
    };
    assert_eq!(value("tmpi_jobs_total{class=\"interactive\",outcome=\"done\"}"), 1.0);
    assert_eq!(value("tmpi_photos_done "), 1.0);
    assert_eq!(value("tmpi_queue_depth "), 0.0);
    assert_eq!(value("tmpi_view_seconds_count{phase=\"render\"}"), 1.0);
    assert!(value("tmpi_scene_cache_bytes ") > 0.0 && value("tmpi_uploaded_bytes_total ") > 0.0);
    assert!(text.contains("route=\"/v1/photos/{id}/view\""), "routes are counted by their pattern");
    // the limits that alerts compare with
    let usual = Limits::default();
    for (name, limit) in [
        ("queue", usual.queue),
        ("connections", usual.connections),
        ("views_waiting", usual.views_waiting),
        ("exports_waiting", usual.exports.waiting),
    ] {
        assert_eq!(value(&format!("tmpi_{name}_limit ")), limit as f64, "{name}");
    }
    assert_eq!(value("tmpi_job_memory_limit_bytes "), usual.job_memory as f64);
    if cfg!(target_os = "linux") {
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs_f64();
        assert!((now - 600.0..=now).contains(&value("process_start_time_seconds ")), "{text}");
        assert!(value("process_cpu_seconds_total ") > 0.0 && value("process_resident_memory_bytes ") > 1e6, "{text}");
        assert!((5.0..value("process_max_fds ")).contains(&value("process_open_fds ")), "{text}");
        assert!(text.contains("# TYPE process_cpu_seconds counter\n"));
    }
}

#[test]
fn text_is_compressed_if_accepted_and_pictures_and_containers_never_are() {
    use std::io::Read as _;
    let server = Running::open();
    // a large report, and a list
    let [id, ..] = [large(1), jpeg(1), jpeg(2)].map(|photo| server.make(&photo));
    let photo = format!("/v1/photos/{id}");
    let ask = |path: &str, coding: &str| request(server.addr, "GET", path, &[("accept-encoding", coding)], &[]);
    let report = format!("{photo}/report");
    let texts =
        ["/", "/tmpi-viewer.js", "/static/view/viewer.js", "/static/decode/decoder.wasm", "/openapi.json", "/v1/photos", &photo, &report];
    for path in texts.into_iter().chain(["/metrics"]) {
        let (plain, coded) = (ask(path, "identity"), ask(path, "br, gzip"));
        assert_eq!((coded.status, coded.header("content-encoding"), plain.header("content-encoding")), (200, Some("gzip"), None), "{path}");
        assert_eq!(coded.header("content-type"), plain.header("content-type"), "{path}");
        assert!(coded.all("vary").contains("accept-encoding") && plain.all("vary").contains("accept-encoding"), "{path}");
        let mut text = Vec::new();
        flate2::read::GzDecoder::new(coded.body.as_slice()).read_to_end(&mut text).unwrap();
        // metrics change between two answers
        assert!(path == "/metrics" || text == plain.body, "{path}");
        assert!(coded.body.len() < plain.body.len(), "{path}: {} of {} bytes", coded.body.len(), plain.body.len());
        if let Some(tag) = coded.header("etag") {
            assert_ne!(Some(tag), plain.header("etag"), "{path}");
            let known = request(server.addr, "GET", path, &[("accept-encoding", "gzip"), ("if-none-match", tag)], &[]);
            assert_eq!(known.status, 304, "{path}");
        }
    }
    for part in ["atlas", "thumbnail", "depth", "view?w=400&format=png", "export?format=html"] {
        let answer = ask(&format!("{photo}/{part}"), "gzip");
        assert_eq!((answer.status, answer.header("content-encoding")), (200, None), "{part}");
    }
    // `If-Match` accepts the tag of a compressed answer
    let seen = ask(&photo, "gzip").header("etag").unwrap().to_owned();
    assert_eq!(request(server.addr, "PATCH", &photo, &[JSON, ("if-match", &seen)], br#"{"title": "A"}"#).status, 200);
}
