//! Links that an application signs with its key.

use std::process::Command;

use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::{Digest as _, Sha256};
use tmpi_library::hex;

use crate::access::plain;
use crate::key_fixture;
use crate::prelude::*;

/// `text` with its signature by a key in the form of `Authorization`.
fn signature(key: &str, text: &str) -> String {
    let secret = Sha256::digest(key.strip_prefix("Bearer ").unwrap());
    let mac = Hmac::<Sha256>::new_from_slice(&secret).unwrap().chain_update(text);
    format!("{text}&signature={}", hex(&mac.finalize().into_bytes()))
}

/// `address` with `key` and `expires`, unsigned.
fn unsigned(key: &str, address: &str, seconds: u64) -> String {
    let id = &hex(&Sha256::digest(key.strip_prefix("Bearer ").unwrap()))[..8];
    let expires = seconds_now() + seconds;
    format!("{address}{}key={id}&expires={expires}", if address.contains('?') { '&' } else { '?' })
}

/// `address` as an application signs it.
pub fn signed(key: &str, address: &str, seconds: u64) -> String {
    signature(key, &unsigned(key, address, seconds))
}

/// The link of an application to all of a photo, as a query.
pub fn link_to_all(key: &str, photo: &str, seconds: u64) -> String {
    signed(key, &format!("/v1/photos/{photo}"), seconds).split_once('?').unwrap().1.to_owned()
}

fn stranger(server: &Running, address: &str) -> Response {
    ask(server, "GET", address, &[], &[])
}

#[test]
fn an_application_signs_one_address_with_its_options() {
    let server = private();
    let key = |name: &str, scopes: &[Scope]| key_fixture::add(server.data(), name, scopes);
    let (up, sign) = (key("site", &[Scope::Upload, Scope::Read]), key("site", &[Scope::Sign]));
    let photo = id(&upload(&server, Some(&up), 1));
    let others = id(&upload(&server, Some(&key("other", &[Scope::Upload])), 2));
    let view = format!("/v1/photos/{photo}/view?w=8&format=png");
    let good = signed(&sign, &view, 600);
    let answer = stranger(&server, &good);
    assert_eq!((answer.status, answer.header("content-type")), (200, Some("image/png")));
    assert_eq!(answer.header("cache-control"), Some("private, no-cache"));
    assert_eq!(answer.header("etag"), ask(&server, "GET", &view, &[("authorization", &up)], &[]).header("etag"), "no part of cache keys");
    assert!(!answer.all("set-cookie").contains("tmpi_"), "it opens nothing else");
    let none = plain(&stranger(&server, &view), &photo);
    assert!(none.starts_with("404"), "{none}");
    let refused = |address: &str, what: &str| assert_eq!(plain(&stranger(&server, address), &photo), none, "{what}: {address}");
    // a change of any part
    let last = if good.ends_with('0') { "1" } else { "0" };
    let (text, ours) = good.split_once("&signature=").unwrap();
    let (before, expires) = text.split_once("&expires=").unwrap();
    let (options, id_of_key) = before.split_once("&key=").unwrap();
    let later = expires.parse::<u64>().unwrap() + 1;
    for (what, address) in [
        ("another path", good.replace("/view?", "/atlas?")),
        ("another option", good.replace("w=8", "w=9")),
        ("an option more", good.replace("&key=", "&fov=60&key=")),
        ("an option less", good.replace("&format=png", "")),
        ("an option after the signature", format!("{good}&fov=60")),
        ("another order", good.replace("w=8&format=png", "format=png&w=8")),
        ("another encoding", good.replace("w=8", "w=%38")),
        ("a later end", good.replace(expires, &later.to_string())),
        ("another signature", format!("{}{last}", &good[..good.len() - 1])),
        ("a signature in capitals", format!("{text}&signature={}", ours.to_uppercase())),
        ("no end", signature(&sign, &format!("{options}&key={id_of_key}"))),
        ("no key", format!("{options}&expires={expires}&signature={ours}")),
        ("two keys", good.replace("&expires=", &format!("&key={id_of_key}&expires="))),
        ("an end in the past", signature(&sign, &format!("{options}&key={id_of_key}&expires=1"))),
        ("another key's id", good.replace(id_of_key, &hex(&Sha256::digest(&up["Bearer ".len()..]))[..8])),
        ("a key without the scope", signed(&up, &view, 600)),
        ("another owner's key", signed(&key("other", &[Scope::Sign]), &view, 600)),
        ("an administrator's key", signed(&key("boss", &[Scope::Admin]), &view, 600)),
        ("an unknown key", signed("Bearer tmpi_k_0", &view, 600)),
    ] {
        refused(&address, what);
    }
    assert_eq!(stranger(&server, &signed(&sign, &format!("/v1/photos/{others}/view?w=8"), 600)).status, 404, "another owner's photo");
    assert_eq!(stranger(&server, &signed(&sign, &format!("/view/{photo}"), 600)).status, 404, "a page needs all of its photo");
    let short = signed(&sign, &view, 2);
    wait_until("the link has expired", || stranger(&server, &short).status == 404);
    refused(&short, "an expired link");
    // the key is removed while the server runs
    let own = key_fixture::read(server.data()).into_iter().find(|k| k.name == "site" && k.scopes == [Scope::Sign]).unwrap();
    assert_eq!((own.id.as_str(), stranger(&server, &good).status), (id_of_key, 200));
    key_fixture::remove(server.data(), "site", Some(&own.id));
    refused(&good, "a removed key");
    // with open access links have no effect
    let server = server.changed(Arc::new(pipeline()), |config| Config { private: false, ..config });
    assert_eq!(stranger(&server, &good).status, 200);
}

#[test]
fn an_application_signs_a_photo_with_its_pages() {
    let server = private();
    let key = key_fixture::add(server.data(), "site", &[Scope::Upload, Scope::Sign]);
    let photo = id(&upload(&server, Some(&key), 1));
    let link = link_to_all(&key, &photo, 600);
    for path in ["/v1/photos/ID?", "/v1/photos/ID/atlas?level=1&", "/v1/photos/ID/view?w=8&", "/view/ID?", "/embed/ID?"] {
        assert_eq!(stranger(&server, &format!("{path}{link}").replace("ID", &photo)).status, 200, "{path}");
    }
    let change = ask(&server, "PATCH", &format!("/v1/photos/{photo}?{link}"), &[JSON], b"{}");
    assert_eq!((change.status, stranger(&server, &format!("/v1/photos?{link}")).json()["photos"].as_array().unwrap().len()), (404, 0));
    // the page's card and its cookie have the link
    let page = stranger(&server, &format!("/view/{photo}?{link}"));
    let text = String::from_utf8_lossy(&page.body).replace("&amp;", "&");
    let picture = text.split("og:image\" content=\"http://photos.example").nth(1).unwrap().split('"').next().unwrap();
    assert_eq!(stranger(&server, picture).status, 200, "{picture}");
    let cookie = page.all("set-cookie");
    let pair = cookie.split(';').next().unwrap();
    let kept = |pair: &str| ask(&server, "GET", &format!("/v1/photos/{photo}"), &[("cookie", pair)], &[]).status;
    assert_eq!((kept(pair), kept(&pair.replace("signature=", "signature=0"))), (200, 404), "{cookie}");
    let url: String = form_urlencoded::byte_serialize(format!("http://photos.example/view/{photo}?{link}").as_bytes()).collect();
    assert_eq!(stranger(&server, &format!("/oembed?url={url}")).status, 200);
}

/// The code block after the line `title` of a page.
fn block(page: &str, title: &str) -> String {
    let lines = page.lines().skip_while(|line| *line != title).skip(2);
    lines
        .take_while(|line| line.is_empty() || line.starts_with("    "))
        .flat_map(|line| [line.get(4..).unwrap_or_default(), "\n"])
        .collect()
}

#[test]
fn documented_examples_sign_links() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/operating/access.md")).unwrap();
    let server = private();
    let key = key_fixture::add(server.data(), "site", &[Scope::Upload, Scope::Sign]);
    let photo = id(&upload(&server, Some(&key), 1));
    let mut ran = 0;
    for (title, program) in
        [("Python:", &["python3", "-c"][..]), ("Node:", &["node", "--input-type=module", "-e"]), ("PHP:", &["php", "-r"])]
    {
        let code = block(&page, title).replace("/ID/", &format!("/{photo}/"));
        assert!(code.contains(&photo), "{title} {code}");
        let run = Command::new(program[0]).args(&program[1..]).arg(&code).env("TMPI_KEY", &key["Bearer ".len()..]).output();
        let Ok(out) = run else {
            println!("{title} it is not installed");
            continue;
        };
        assert!(out.status.success(), "{title} {}", String::from_utf8_lossy(&out.stderr));
        let address = String::from_utf8(out.stdout).unwrap();
        assert_eq!(stranger(&server, address.trim()).header("content-type"), Some("image/webp"), "{title} {address}");
        ran += 1;
    }
    assert!(ran > 0, "no language is installed");
}
