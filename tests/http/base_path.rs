//! A server at a path of its host, behind a proxy that passes the path on or removes it.

use std::collections::BTreeSet;

use tmpi::server::AddressPolicy;
use tmpi_testing::Answer;

use crate::key_fixture;
use crate::prelude::*;
use crate::receiver::{Delivery as _, Receiver};
use crate::signed_links::signed;

/// A private server at `/3d`.
fn below() -> Running {
    Running::configured(Arc::new(pipeline()), |config| Config {
        private: true,
        base_path: "/3d".parse().unwrap(),
        webhook_addresses: AddressPolicy::Any,
        ..config
    })
}

/// Addresses in a page's attributes that begin with `/`, without fragments.
fn addresses(page: &str) -> BTreeSet<&str> {
    page.split("=\"").skip(1).filter(|rest| rest.starts_with('/')).filter_map(|rest| rest.split(['"', '#']).next()).collect()
}

#[test]
fn pages_name_addresses_below_the_path() {
    let server = below();
    let ann = secret("a");
    let photo = id(&upload(&server, Some(&ann), 1));
    let page = |path: &str| ask(&server, "GET", path, &[("authorization", &ann), ("accept", "text/html")], &[]);
    let mut named = BTreeSet::new();
    for path in ["", "/", "/demo", "/view/ID", "/embed/ID", "/live/attic", "/live/attic/publish", "/nothing"] {
        let path = path.replace("ID", &photo);
        let shown = page(&format!("/3d{path}")).text();
        let all = addresses(&shown);
        assert!(all.contains("/3d/static/app/icon.svg"), "{path}: {shown}");
        named.extend(all.into_iter().map(str::to_owned));
        if !path.is_empty() {
            assert_eq!(page(&path).text(), shown, "{path}: the proxy may remove the path");
        }
    }
    assert!(named.contains("/3d/") && named.contains("/3d/tmpi-viewer.js") && named.len() > 50, "{named:?}");
    for address in &named {
        assert!(address.starts_with("/3d/"), "{address}");
        assert_eq!(page(address).status, 200, "{address}");
    }
    assert_eq!((page("/3dx").status, page("/3d/3d/").status, page("/healthz").status), (404, 404, 200));
    let shown = page(&format!("/3d/view/{photo}"));
    let known = [("authorization", ann.as_str()), ("if-none-match", shown.header("etag").unwrap())];
    assert_eq!(ask(&server, "GET", &format!("/3d/view/{photo}"), &known, &[]).status, 304);
    // relative to itself
    let manifest = page("/3d/static/app/manifest.json").json();
    let named = [&manifest["start_url"], &manifest["scope"], &manifest["share_target"]["action"]];
    assert_eq!(named, ["../../", "../../", "share/"]);
    // previews of other sites
    let at = format!("http://photos.example/3d/view/{photo}");
    assert!(shown.text().contains(&format!("<meta property=\"og:url\" content=\"{at}\" />")));
    let told = page(&format!("/3d/oembed?url={at}")).json();
    assert_eq!(told["provider_url"], "http://photos.example/3d");
    assert!(told["html"].as_str().unwrap().contains(&format!("src=\"http://photos.example/3d/embed/{photo}\"")), "{told}");
    let picture = told["thumbnail_url"].as_str().unwrap().strip_prefix("http://photos.example").unwrap();
    assert!(picture.starts_with("/3d/") && page(picture).status == 200, "{picture}");
}

#[test]
fn answers_name_addresses_below_the_path() {
    let (server, receiver) = (below(), Receiver::start(|_| Answer::of(204)));
    let ann = secret("a");
    let call =
        |method: &str, path: &str, body: &[u8]| ask(&server, method, path, &[("authorization", &ann), ("prefer", "wait=60"), JSON], body);
    let hook = call("POST", "/3d/v1/webhooks", json!({ "url": receiver.url }).to_string().as_bytes());
    let hook = hook.header("location").unwrap().to_owned();
    assert!(hook.starts_with("/3d/v1/webhooks/") && call("GET", &hook, &[]).status == 200, "{hook}");
    let made = ask(&server, "POST", "/3d/v1/photos", &[("authorization", &ann), ("prefer", "wait=60")], &jpeg(1));
    let state = made.json();
    let photo = id(&state);
    assert_eq!((made.status, made.header("location")), (201, Some(format!("/3d/v1/photos/{photo}").as_str())));
    for (name, address) in state["links"].as_object().unwrap() {
        let address = address.as_str().unwrap();
        assert!(address.starts_with("/3d/"), "{name}: {address}");
        assert_eq!(call("HEAD", address, &[]).status, 200, "{name}: {address}");
    }
    let done = receiver.wait("photo.done", 1)[0].json()["data"].clone();
    assert_eq!((&done["path"], &done["page"]), (&state["links"]["self"], &state["links"]["page"]));
    let order = call("POST", &format!("/3d/v1/photos/{photo}/exports?format=glb"), &[]);
    assert!(order.header("location").unwrap().starts_with(&format!("/3d/v1/photos/{photo}/exports/")));
    let written = receiver.wait("export.done", 1)[0].json()["data"]["file"].clone();
    assert!(call("GET", written.as_str().unwrap(), &[]).body.starts_with(b"glTF"), "{written}");
    upload(&server, Some(&ann), 2);
    let next = call("GET", "/3d/v1/photos?limit=1", &[]).json()["next"].clone();
    let next = next.as_str().unwrap();
    assert!(next.starts_with("/3d/v1/photos?") && ids(&call("GET", next, &[])) == [photo], "{next}");
    assert_eq!(call("GET", "/3d/openapi.json", &[]).json()["servers"][0]["url"], "/3d");
}

#[test]
fn links_and_cookies_are_for_the_path_only() {
    let server = below();
    let key = key_fixture::add(server.data(), "site", &[Scope::Upload, Scope::Sign]);
    let (ann, photo) = (secret("a"), id(&upload(&server, Some(&secret("a")), 1)));
    let stranger = |path: &str| ask(&server, "GET", path, &[], &[]);
    let links = ask(&server, "POST", &format!("/3d/v1/photos/{photo}/links"), &[("authorization", &ann)], &[]).json();
    let of = |name: &str| links[name].as_str().unwrap().to_owned();
    assert!(of("page").starts_with(&format!("/3d/view/{photo}?")) && of("ticket") == "/3d/v1/owner/ticket", "{links}");
    let (page, atlas) = (stranger(&of("page")), stranger(&of("atlas")));
    assert_eq!((page.status, atlas.status, stranger(&format!("/3d/view/{photo}")).status), (200, 200, 404));
    let for_photo = format!("; Path=/3d/v1/photos/{photo};");
    assert!(page.all("set-cookie").contains(&for_photo), "{}", page.all("set-cookie"));
    let token = of("manage").strip_prefix(&format!("/3d/view/{photo}#manage=")).unwrap().to_owned();
    let kept = ask(&server, "POST", &format!("/3d/v1/photos/{photo}/manage"), &[("authorization", &format!("Bearer {token}"))], &[]);
    assert!(kept.status == 204 && kept.all("set-cookie").contains(&for_photo), "{}", kept.all("set-cookie"));
    // applications sign addresses without the path
    let own = id(&upload(&server, Some(&key), 2));
    let good = signed(&key, &format!("/v1/photos/{own}/view?w=8"), 600);
    assert_eq!((stranger(&format!("/3d{good}")).status, stranger(&good).status), (200, 200));
    // browsers accept `__Host-` for the path `/` only
    let tls = ("x-forwarded-proto", "https");
    for path in ["/3d", "/3d/", "/"] {
        let plain = stranger(path).all("set-cookie");
        assert!(plain.starts_with("tmpi_owner=tmpi_o_") && plain.contains("; Path=/3d;"), "{path}: {plain}");
        let secure = ask(&server, "GET", path, &[tls], &[]).all("set-cookie");
        assert!(
            secure.starts_with("__Secure-tmpi_owner=") && secure.contains("; Path=/3d;") && secure.ends_with("; Secure"),
            "{path}: {secure}"
        );
    }
    let by = |name: &str| {
        let pair = format!("{name}={}", &ann["Bearer ".len()..]);
        ask(&server, "GET", &format!("/3d/v1/photos/{photo}"), &[("cookie", &pair), tls], &[]).status
    };
    assert_eq!((by("__Secure-tmpi_owner"), by("tmpi_owner")), (200, 404));
}
