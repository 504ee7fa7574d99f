//! `--preset` and `--presets-only`.

use tmpi::server::{Preset, Presets};

use crate::key_fixture;
use crate::prelude::*;

/// A private server with presets.
fn with_presets(only: bool) -> Running {
    let presets = ["card=w=16&h=12&format=webp", "loop=path=orbit&frames=2&w=8&h=6", "small=max-size=40&planes=2&title=Small"];
    let presets: Vec<Preset> = presets.iter().map(|text| text.parse().unwrap()).collect();
    Running::configured(Arc::new(pipeline()), move |config| {
        let presets = Presets::new(&presets, only, &config.limits).unwrap();
        Config { private: true, presets, ..config }
    })
}

#[test]
fn presets_stand_for_their_options() {
    let server = with_presets(false);
    let ann = secret("a");
    let by = |method: &str, path: &str| ask(&server, method, path, &[("authorization", &ann), ("prefer", "wait=60")], &jpeg(1));
    let small = by("POST", "/v1/photos?preset=small").json();
    assert_eq!([&small["settings"]["title"], &small["options"]["planes"]], ["Small", "2"], "{small}");
    assert_eq!(small["width"], 40, "{small}");
    let (kind, body) = form(&[("preset", b"small"), ("photo", &jpeg(1)), ("quality", b"70")]);
    let headers = [("authorization", ann.as_str()), ("prefer", "wait=60"), ("content-type", &kind)];
    let by_form = ask(&server, "POST", "/v1/photos", &headers, &body).json();
    assert_eq!((&by_form["width"], &by_form["options"]["quality"]), (&json!(40), &json!("70")), "{by_form}");
    let at = format!("/v1/photos/{}", id(&small));
    let get = |path: &str| ask(&server, "GET", &format!("{at}{path}"), &[("authorization", &ann)], &[]);
    let (named, spelt) = (get("/view?preset=card"), get("/view?w=16&h=12&format=webp"));
    assert_eq!((named.status, named.header("content-type"), named.header("etag")), (200, Some("image/webp"), spelt.header("etag")));
    assert_ne!(get("/view?preset=card&tx=0.01").header("etag"), named.header("etag"), "with another option");
    for (path, field) in [
        ("/view?preset=cart", "preset"),
        ("/view?preset=small", "preset"),
        ("/view?preset=card&preset=card", "preset"),
        ("/view?preset=card&w=9", "w"),
    ] {
        assert_eq!(get(path).problem(400)["field"], field, "{path}");
    }
    for (query, field) in [("preset=card", "preset"), ("preset=small&planes=3", "planes"), ("preset=small&preset=small", "max-size")] {
        assert_eq!(by("POST", &format!("/v1/photos?{query}")).problem(400)["field"], field, "{query}");
    }
}

#[test]
fn with_presets_only_administrators_alone_give_options() {
    let server = with_presets(true);
    let [ann, boss] = ["ann", "boss"].map(|name| {
        let scopes = if name == "boss" { vec![Scope::Admin] } else { vec![Scope::Upload, Scope::Read] };
        key_fixture::add(server.data(), name, &scopes)
    });
    let made = |who: &str, query: &str| {
        ask(&server, "POST", &format!("/v1/photos{query}"), &[("authorization", who), ("prefer", "wait=60")], &jpeg(1))
    };
    let photo = id(&made(&ann, "?preset=small&visibility=link").json());
    assert_eq!(made(&ann, "?planes=2").problem(403)["field"], "planes");
    assert_eq!((made(&ann, "?title=Mine").status, made(&boss, "?planes=3").status), (201, 201));
    let at = format!("/v1/photos/{photo}");
    let get = |who: &str, path: &str| ask(&server, "GET", &format!("{at}{path}"), &[("authorization", who)], &[]);
    for path in ["/view", "/view?v=1", "/view?preset=card", "/view?preset=card&v=1"] {
        assert_eq!(get(&ann, path).status, 200, "{path}");
    }
    for (path, field) in
        [("/view?w=8", "w"), ("/view?preset=card&tx=0.01", "tx"), ("/view?format=jpeg", "format"), ("/view?w=1201&format=jpeg", "w")]
    {
        let refused = get(&ann, path).problem(403);
        assert_eq!((&refused["type"], &refused["field"]), (&json!("urn:tmpi:problem:presets-only"), &json!(field)), "{path}");
        assert_eq!(get(&boss, path).status, 200, "{path}");
    }
    let order = |who: &str, query: &str| ask(&server, "POST", &format!("{at}/exports?{query}"), &[("authorization", who)], &[]);
    assert_eq!(order(&ann, "path=orbit&frames=2").problem(403)["field"], "path");
    assert!(matches!(order(&ann, "preset=loop").status, 200 | 202) && matches!(order(&ann, "format=glb").status, 200 | 202));
    // pictures of which the server gives the address
    let patch = [("authorization", ann.as_str()), JSON];
    assert_eq!(ask(&server, "PATCH", &at, &patch, br#"{"poster": {"x": 0.5, "y": 0, "z": 0}}"#).status, 200);
    let state = get(&ann, "").json();
    let poster = state["links"]["poster"].as_str().unwrap();
    assert!(poster.contains("w=640") && poster.contains("tz=0."), "{poster}");
    assert_eq!(ask(&server, "GET", poster, &[], &[]).status, 200);
    assert_eq!(ask(&server, "GET", &poster.replace("tz=0.", "tz=1."), &[], &[]).status, 403, "another camera");
    let page = ask(&server, "GET", &format!("/view/{photo}"), &[], &[]).text().replace("&amp;", "&");
    let card = page.split("og:image\" content=\"http://photos.example").nth(1).unwrap().split('"').next().unwrap();
    assert_eq!(ask(&server, "GET", card, &[], &[]).header("content-type"), Some("image/jpeg"), "{card}");
}

#[test]
fn pages_learn_the_presets_and_whether_other_options_are_refused() {
    let named = |name: &str, kind: &str| json!({"name": name, "kind": kind});
    let all = [named("card", "view"), named("loop", "film"), named("small", "photo")];
    for only in [false, true] {
        let server = with_presets(only);
        let boss = key_fixture::add(server.data(), "boss", &[Scope::Admin]);
        for (headers, refused) in [(vec![], only), (vec![("authorization", boss.as_str())], false)] {
            let told = ask(&server, "GET", "/v1/presets", &headers, &[]).json();
            assert_eq!(told, json!({"presets": all, "only": refused}), "{headers:?}");
        }
    }
}
