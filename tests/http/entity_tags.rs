//! Versions in addresses, entity tags, ranges, and checks of queries.

use crate::prelude::*;

const PARTS: [&str; 9] = [
    "atlas",
    "atlas?level=1",
    "atlas?region=0,0,9,9",
    "atlas?sections=photo",
    "depth",
    "report",
    "thumbnail",
    "view?w=20",
    "export?format=glb",
];

#[test]
fn only_addresses_with_the_version_are_immutable() {
    let server = Running::open();
    let id = server.upload(&picture(1, PictureFormat::Png));
    let version = server.wait(&id, "done")["version"].as_str().unwrap().to_owned();
    for part in PARTS {
        let path = format!("/v1/photos/{id}/{part}");
        let and = if part.contains('?') { '&' } else { '?' };
        let plain = get(server.addr, &path);
        let etag = plain.header("etag").unwrap().to_owned();
        assert_eq!((plain.status, plain.header("cache-control")), (200, Some("no-cache")), "{part}");
        let named = get(server.addr, &format!("{path}{and}v={version}"));
        assert_eq!((named.status, named.header("cache-control")), (200, Some("public, max-age=31536000, immutable")), "{part}");
        assert_eq!((named.header("etag"), &named.body), (Some(etag.as_str()), &plain.body), "{part}");
        let old = get(server.addr, &format!("{path}{and}v=0123456789abcdef"));
        assert_eq!((old.status, old.header("cache-control")), (200, Some("no-cache")), "{part}");
        let same = request(server.addr, "GET", &path, &[("if-none-match", &etag)], &[]);
        assert_eq!((same.status, same.header("etag")), (304, Some(etag.as_str())), "{part}");
    }
    let state = server.state(&id);
    for link in ["atlas", "depth", "report", "thumbnail", "poster"] {
        let answer = get(server.addr, state["links"][link].as_str().unwrap());
        assert!(answer.status == 200 && answer.header("cache-control").unwrap().contains("immutable"), "{link}");
    }
}

#[test]
fn a_better_network_makes_the_photo_again() {
    let server = Running::with(Limits::default(), Arc::new(pipeline().with_identity("a network")));
    let first = server.make(&jpeg(1));
    let server = server.again(Limits::default(), Arc::new(pipeline().with_identity("a better network")));
    let second = server.upload(&jpeg(1));
    assert_ne!(first, second);
    server.wait(&second, "done");
    assert_eq!(server.upload(&jpeg(1)), second);
    assert_eq!(get(server.addr, &format!("/v1/photos/{first}/atlas")).status, 200, "the old photo stays");
}

#[test]
fn a_photo_made_anew_has_another_version() {
    let server = Running::open();
    let id = server.upload(&jpeg(1));
    let before = server.wait(&id, "done")["version"].clone();
    assert_eq!(request(server.addr, "DELETE", &format!("/v1/photos/{id}"), &[], &[]).status, 204);
    assert_eq!(server.upload(&jpeg(1)), id);
    assert_ne!(server.wait(&id, "done")["version"], before);
}

#[test]
fn ranges_apply_to_get_only() {
    let server = Running::open();
    let id = server.make(&jpeg(1));
    let path = format!("/v1/photos/{id}/atlas");
    let whole = get(server.addr, &path);
    let head = request(server.addr, "HEAD", &path, &[("range", "bytes=0-3")], &[]);
    assert_eq!((head.status, head.header("content-range")), (200, None));
    assert_eq!(head.header("content-length"), whole.header("content-length"));
    assert_eq!(request(server.addr, "GET", &path, &[("range", "bytes=0-3")], &[]).body, whole.body[..4]);
    // `*` matches a view that was never drawn
    let any = request(server.addr, "GET", &format!("/v1/photos/{id}/view?w=9"), &[("if-none-match", "*")], &[]);
    assert!(any.status == 304 && any.header("etag").is_some());
}

#[test]
fn unknown_and_repeated_query_parameters_are_refused_on_every_route() {
    let server = Running::open();
    let id = server.make(&picture(1, PictureFormat::Png));
    let photo = format!("/v1/photos/{id}");
    for part in ["", "/atlas", "/depth", "/report", "/thumbnail", "/view", "/export", "/settings", "/events"] {
        assert_eq!(get(server.addr, &format!("{photo}{part}?zz=1")).problem(400)["field"], "zz", "{part}");
    }
    for path in ["/v1/photos", "/healthz", "/readyz", "/metrics", "/openapi.json"] {
        assert_eq!(get(server.addr, &format!("{path}?zz=1")).problem(400)["field"], "zz", "{path}");
    }
    for (query, field) in
        [("zz=1", "zz"), ("tile=64&tile=64", "tile"), ("max-size=50&max_size=60", "max_size"), ("title=A%20title&title=A%20title", "title")]
    {
        let path = format!("/v1/photos?{query}");
        assert_eq!(request(server.addr, "POST", &path, &[], &jpeg(1)).problem(400)["field"], field, "{query}");
    }
    let twice = [("quality", b"80".as_slice()), ("photo", &jpeg(1)), ("quality", b"90")];
    assert_eq!(post_form(server.addr, &[], &twice).problem(400)["field"], "quality");
    let (content_type, body) = form(&[("photo", &jpeg(1)), ("quality", b"90")]);
    let both = request(server.addr, "POST", "/v1/photos?quality=80", &[("content-type", &content_type)], &body);
    assert_eq!(both.problem(400)["field"], "quality", "in the query and in the form");
    for method in ["DELETE", "PATCH"] {
        assert_eq!(request(server.addr, method, &format!("{photo}?zz=1"), &[], &[]).problem(400)["field"], "zz");
    }
    for (query, field) in [
        ("atlas?lev%65l=9", "level"),
        ("atlas?level=1&level=1", "level"),
        ("atlas?level=1&l%65vel=2", "level"),
        ("thumbnail?v=a&v=a", "v"),
        ("export?format=zip&f%6Frmat=zip", "format"),
        ("view?w=9&%77=9", "w"),
    ] {
        assert_eq!(get(server.addr, &format!("{photo}/{query}")).problem(400)["field"], field, "{query}");
    }
    let small = get(server.addr, &format!("{photo}/atlas?lev%65l=1"));
    assert_eq!(tmpi_core::container::decode(&small.body).unwrap().grid.width, 40);
    assert_eq!(get(server.addr, "/v1/photos?limit=1&limit=2").problem(400)["field"], "limit");
}
