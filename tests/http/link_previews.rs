//! Link previews: tags in the page's head, and oEmbed.

use std::collections::BTreeMap;

use crate::origins::start;
use crate::prelude::*;

/// A title that breaks out of unescaped HTML.
const HOSTILE: &str = "</title><script>alert(1)</script>\"'><meta http-equiv=refresh content=0;//evil.example> & \u{202e}ü";

fn call(server: &Running, path: &str, headers: &[(&str, &str)]) -> Response {
    request(server.addr, "GET", path, headers, &[])
}

fn rename(server: &Running, id: &str, title: &str) {
    let body = json!({ "title": title, "poster": { "x": 1 } }).to_string();
    request(server.addr, "PATCH", &format!("/v1/photos/{id}"), &[JSON], body.as_bytes()).is(200);
}

fn unescaped(text: &str) -> String {
    let mut text = text.to_owned();
    for (entity, c) in [("&lt;", "<"), ("&gt;", ">"), ("&quot;", "\""), ("&#39;", "'"), ("&amp;", "&")] {
        text = text.replace(entity, c);
    }
    text
}

/// Meta tags of a page by name.
fn tags(page: &str) -> BTreeMap<String, String> {
    let head = page.split("</head>").next().unwrap();
    head.split("<meta ")
        .skip(1)
        .filter_map(|tag| {
            let mut quoted = tag.split('"').skip(1).step_by(2);
            Some((quoted.next()?.to_owned(), unescaped(quoted.next()?)))
        })
        .collect()
}

/// Width and height from a JPEG's frame header.
fn jpeg_size(bytes: &[u8]) -> (u32, u32) {
    let at = bytes.windows(2).position(|w| w[0] == 0xff && matches!(w[1], 0xc0 | 0xc2)).expect("a frame header");
    let number = |i: usize| u32::from(bytes[at + i]) << 8 | u32::from(bytes[at + i + 1]);
    (number(7), number(5))
}

#[test]
fn a_link_has_a_title_and_a_picture() {
    let (server, id) = start();
    rename(&server, &id, "By the sea");
    let base = format!("http://{}", server.addr);
    let answer = get(server.addr, &format!("/view/{id}"));
    let page = answer.text();
    assert!(page.contains("<title>By the sea – tmpi</title>"), "{page}");
    let tags = tags(&page);
    let tag = |name: &str| tags.get(name).map(String::as_str);
    assert_eq!((tag("og:title"), tag("og:type"), tag("twitter:card")), (Some("By the sea"), Some("website"), Some("summary_large_image")));
    assert_eq!(tag("og:url"), Some(format!("{base}/view/{id}").as_str()));
    let picture = tag("og:image").unwrap().strip_prefix(&base).expect("an absolute address");
    assert!(picture.contains("tx=0.12"), "the owner's poster pose: {picture}");
    let drawn = get(server.addr, picture);
    assert_eq!((drawn.status, drawn.header("content-type")), (200, tag("og:image:type")));
    assert!(drawn.header("cache-control").unwrap().contains("immutable"));
    let size = (tag("og:image:width").unwrap().parse().unwrap(), tag("og:image:height").unwrap().parse().unwrap());
    assert_eq!((jpeg_size(&drawn.body), size), ((80, 60), (80, 60)));

    // a new title changes the page's entity tag
    let etag = answer.header("etag").unwrap().to_owned();
    assert_eq!(call(&server, &format!("/view/{id}"), &[("if-none-match", &etag)]).status, 304);
    rename(&server, &id, "By the lake");
    assert_eq!(call(&server, &format!("/view/{id}"), &[("if-none-match", &etag)]).status, 200);
    let none = get(server.addr, "/view/0123456789abcdef0123456789abcdef").text();
    assert!(none.contains("<title>3D photo – tmpi</title>") && !none.contains("og:"), "the page of an unknown photo has no tags");
}

#[test]
fn an_unfinished_photo_has_no_preview_picture() {
    let gate = Gate::new(0);
    let server = Running::with(Limits::default(), gate.clone());
    let id = server.upload(&jpeg(1));
    let tags = tags(&get(server.addr, &format!("/view/{id}")).text());
    assert_eq!((tags["twitter:card"].as_str(), tags["og:title"].as_str(), tags.get("og:image")), ("summary", "3D photo", None));
    let answer = get(server.addr, &format!("/oembed?url=http://localhost/view/{id}")).json();
    assert_eq!((&answer["type"], answer.get("thumbnail_url")), (&"rich".into(), None));
    gate.open(1);
}

#[test]
fn addresses_have_the_requested_host_and_the_proxy_scheme() {
    let (server, id) = start();
    let path = format!("/view/{id}");
    let url = |headers: &[(&str, &str)]| tags(&call(&server, &path, headers).text())["og:url"].clone();
    assert_eq!(url(&[("host", "localhost:99")]), format!("http://localhost:99/view/{id}"));
    assert_eq!(url(&[("host", "photos.example"), ("x-forwarded-proto", "https")]), format!("https://photos.example/view/{id}"));
    assert_eq!(url(&[("host", "localhost"), ("x-forwarded-host", "evil.example")]), format!("http://localhost/view/{id}"));
    call(&server, &path, &[("host", "evil.example")]).problem(421);
}

#[test]
fn titles_are_escaped() {
    let (server, id) = start();
    let plain = get(server.addr, &format!("/view/{id}")).text();
    rename(&server, &id, HOSTILE);
    let page = get(server.addr, &format!("/view/{id}")).text();
    for tag in ["<script", "</title", "<meta", "<link", "</head"] {
        assert_eq!(page.matches(tag).count(), plain.matches(tag).count(), "{tag}");
    }
    assert_eq!(tags(&page)["og:title"], HOSTILE);
    let answer = get(server.addr, &format!("/oembed?url=http://localhost/view/{id}")).json();
    assert_eq!(answer["title"], HOSTILE);
    let html = answer["html"].as_str().unwrap();
    assert_eq!((html.matches('<').count(), html.matches('>').count()), (2, 2), "{html}");
    let title = html.split("title=\"").nth(1).unwrap().split('"').next().unwrap();
    assert_eq!(unescaped(title), HOSTILE);
}

#[test]
fn oembed_answers_a_frame() {
    let (server, id) = start();
    let base = format!("http://{}", server.addr);
    let page = get(server.addr, &format!("/view/{id}")).text();
    let link = page.split("application/json+oembed\" href=\"").nth(1).unwrap().split('"').next().unwrap();
    let found = unescaped(link);
    let answer = get(server.addr, found.strip_prefix(&base).unwrap());
    assert_eq!(answer.header("content-type"), Some("application/json"));
    assert_eq!(answer.header("access-control-allow-origin"), Some("*"));
    let all = answer.json();
    assert_eq!((&all["version"], &all["width"], &all["height"]), (&json!("1.0"), &json!(80), &json!(60)));
    assert!(all["html"].as_str().unwrap().starts_with(&format!("<iframe src=\"{base}/embed/{id}\" width=\"80\" height=\"60\"")));
    let small = get(server.addr, &format!("/oembed?url={base}/embed/{id}&maxwidth=40&maxheight=1000&dnt=1")).json();
    assert_eq!((&small["width"], &small["height"], &small["thumbnail_width"]), (&json!(40), &json!(30), &json!(40)));
    let picture = get(server.addr, small["thumbnail_url"].as_str().unwrap().strip_prefix(&base).unwrap());
    assert_eq!(jpeg_size(&picture.body), (40, 30));

    let refused = |query: &str| get(server.addr, &format!("/oembed?{query}"));
    assert_eq!(refused("").problem(400)["field"], "url");
    assert_eq!(refused(&format!("url={base}/view/{id}&maxwidth=0")).problem(400)["field"], "maxwidth");
    refused(&format!("url={base}/view/{id}&format=xml")).problem(501);
    for url in [
        format!("http://evil.example/view/{id}"),
        format!("javascript://localhost/view/{id}"),
        format!("/view/{id}"),
        format!("{base}/v1/photos/{id}"),
        format!("{base}/view/0123456789abcdef0123456789abcdef"),
        "x y".into(),
    ] {
        refused(&format!("url={}", url.replace(' ', "%20"))).problem(404);
    }
}

#[test]
fn previews_of_a_page_opened_by_a_link_contain_the_link() {
    const BASE: &str = "http://photos.example";
    let server = private();
    let ann = secret("a");
    let photo = id(&upload(&server, Some(&ann), 1));
    let stranger = |address: &str| ask(&server, "GET", address.strip_prefix(BASE).unwrap_or(address), &[], &[]);
    let links = ask(&server, "POST", &format!("/v1/photos/{photo}/links"), &[("authorization", &ann)], &[]).json();
    let query = links["query"].as_str().unwrap();
    let page = stranger(links["page"].as_str().unwrap()).text();
    let tags = tags(&page);
    assert_eq!(tags["og:url"], format!("{BASE}/view/{photo}?{query}"), "with the link, or a preview would lead to 404");
    let picture = stranger(&tags["og:image"]);
    assert_eq!((picture.status, picture.header("content-type")), (200, Some("image/jpeg")));
    let told = unescaped(page.split("application/json+oembed\" href=\"").nth(1).unwrap().split('"').next().unwrap());
    let told = stranger(&told);
    assert_eq!((told.status, told.header("cache-control")), (200, Some("private, no-cache")));
    let told = told.json();
    assert_eq!(stranger(told["thumbnail_url"].as_str().unwrap()).status, 200);
    let frame = unescaped(told["html"].as_str().unwrap().split('"').nth(1).unwrap());
    assert_eq!(frame, format!("{BASE}/embed/{photo}?{query}"));
    let kept = stranger(&frame);
    assert!(kept.status == 200 && kept.all("set-cookie").starts_with("tmpi_link="), "a frame that navigates keeps access by a cookie");
    // without a valid link, neither tags nor oEmbed
    let forged = format!("{}{}", &query[..query.len() - 1], if query.ends_with('0') { '1' } else { '0' });
    for query in ["", &format!("?{forged}")] {
        let page = stranger(&format!("/view/{photo}{query}")).text();
        assert!(!page.contains("og:") && !page.contains("signature"), "{page}");
        let url: String =
            form_urlencoded::Serializer::new(String::new()).append_pair("url", &format!("{BASE}/view/{photo}{query}")).finish();
        stranger(&format!("/oembed?{url}")).problem(404);
        assert!(stranger(&format!("/embed/{photo}{query}")).header("set-cookie").is_none());
    }
    // the owner's own page has tags without the link
    let own = ask(&server, "GET", links["page"].as_str().unwrap(), &[("authorization", &ann)], &[]).text();
    assert!(own.contains("og:image") && !own.contains("signature"));
}

#[test]
fn signed_links_still_work_on_an_open_server() {
    let (server, id) = start();
    for path in ["", "/atlas", "/settings"] {
        assert_eq!(get(server.addr, &format!("/v1/photos/{id}{path}?expires=1&signature=5e")).status, 200, "{path}");
    }
    get(server.addr, &format!("/v1/photos/{id}?expires=1&signature=5e&halo=1")).problem(400);
}
