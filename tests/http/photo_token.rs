//! A photo's token, which grants this photo only, and the session cookie of an owner.

use crate::prelude::*;

/// The links of a photo that its owner can share.
fn links(server: &Running, who: &str, photo: &str) -> Value {
    ask(server, "POST", &format!("/v1/photos/{photo}/links"), &[("authorization", who)], &[]).is(200).json()
}

/// The photo's token in these links.
fn token_of(links: &Value, photo: &str) -> String {
    links["manage"].as_str().unwrap().strip_prefix(&format!("/view/{photo}#manage=")).unwrap().to_owned()
}

fn by(server: &Running, bearer: &str, method: &str, path: &str) -> Response {
    let authorization = format!("Bearer {bearer}");
    let body: &[u8] = if method == "PATCH" { b"{}" } else { b"" };
    ask(server, method, path, &[("authorization", &authorization), JSON], body)
}

#[test]
fn a_photos_token_can_be_passed_on_and_not_be_forged() {
    let server = private();
    let ann = secret("a");
    let one = id(&upload(&server, Some(&ann), 1));
    let told = links(&server, &ann, &one);
    assert!(!told.to_string().contains(&ann["Bearer ".len()..]), "not the owner's secret");
    let token = token_of(&told, &one);
    let at = |photo: &str, part: &str| format!("/v1/photos/{photo}{part}");
    // the token can be passed on; only the owner can revoke it
    assert_eq!(token_of(&by(&server, &token, "POST", &at(&one, "/links")).json(), &one), token);
    by(&server, &token, "DELETE", &at(&one, "/manage")).problem(404);
    assert_eq!(by(&server, &token, "GET", &at(&one, "")).status, 200);
    let (start, last) = token.split_at(token.len() - 1);
    let forged = format!("{start}{}", if last == "0" { "1" } else { "0" });
    by(&server, &forged, "GET", &at(&one, "")).problem(404);
    for none in [start, &token.to_uppercase(), &format!("{token}0"), "tmpi_m_", "tmpi_m_short"] {
        by(&server, none, "GET", &at(&one, "")).problem(401);
    }
    // it can delete the photo
    assert_eq!((by(&server, &token, "DELETE", &at(&one, "")).status, by(&server, &token, "GET", &at(&one, "")).status), (204, 404));
}

#[test]
fn a_browser_keeps_a_photos_token_and_stays_the_same_owner() {
    let server = private();
    let (ann, bob) = (secret("a"), secret("b"));
    let (one, two) = (id(&upload(&server, Some(&ann), 1)), id(&upload(&server, Some(&ann), 2)));
    let (token, other) = (token_of(&links(&server, &ann, &one), &one), token_of(&links(&server, &ann, &two), &two));
    let (at, keep) = (format!("/v1/photos/{one}"), format!("/v1/photos/{one}/manage"));
    // the browser of another owner opens the link
    let of_bob = format!("tmpi_owner={}", &bob["Bearer ".len()..]);
    let post = |token: &str, scheme: &str| {
        let bearer = format!("Bearer {token}");
        let headers =
            [("authorization", bearer.as_str()), ("cookie", &of_bob), ("x-forwarded-proto", scheme), ("sec-fetch-site", "same-origin")];
        ask(&server, "POST", &keep, &headers, &[])
    };
    let cookie = post(&token, "http").is(204).all("set-cookie");
    assert!(cookie.starts_with(&format!("tmpi_manage={token}; Path={at}; Max-Age=")), "{cookie}");
    assert!(cookie.ends_with("; HttpOnly; SameSite=Lax"), "{cookie}");
    let by_tls = post(&token, "https").all("set-cookie");
    assert!(by_tls.starts_with(&format!("__Secure-tmpi_manage={token}; Path={at};")), "{by_tls}");
    assert!(by_tls.ends_with("; HttpOnly; SameSite=Lax; Secure"), "{by_tls}");
    for wrong in [&other, &format!("tmpi_m_{}", "0".repeat(64))] {
        let refused = post(wrong, "http");
        assert!(refused.status == 404 && refused.header("set-cookie").is_none(), "{wrong}");
    }
    let pairs = format!("{of_bob}; {}", cookie.split(';').next().unwrap());
    let browser = |method: &str, path: &str, more: &[(&str, &str)], body: &[u8]| {
        ask(&server, method, path, &[&[("cookie", pairs.as_str()), JSON], more].concat(), body)
    };
    let own = [("sec-fetch-site", "same-origin")];
    assert_eq!((browser("GET", &at, &own, &[]).status, browser("PATCH", &at, &own, b"{\"title\": \"A\"}").status), (200, 200));
    browser("GET", &format!("/v1/photos/{two}"), &own, &[]).problem(404);
    browser("DELETE", &keep, &own, &[]).problem(404);
    // its own uploads and list are unaffected
    let mine = id(&browser("POST", "/v1/photos", &[("content-type", "image/jpeg")], &jpeg(3)).json());
    let list = browser("GET", "/v1/photos", &own, &[]).json();
    assert_eq!(list["photos"].as_array().unwrap().iter().map(id).collect::<Vec<_>>(), [mine.as_str()]);
    assert_eq!(ask(&server, "GET", &format!("/v1/photos/{mine}"), &[("authorization", &bob)], &[]).status, 200);
    // for pages of other sites the cookie does not count
    for site in ["cross-site", "same-site"] {
        browser("GET", &at, &[("sec-fetch-site", site)], &[]).problem(404);
        browser("PATCH", &at, &[("sec-fetch-site", site)], b"{}").problem(403);
    }
    // over TLS a cookie that was set without TLS does not count
    browser("GET", &at, &[("sec-fetch-site", "same-origin"), ("x-forwarded-proto", "https")], &[]).problem(404);
}

#[test]
fn revoked_links_stay_revoked() {
    let server = private();
    let (ann, bob) = (secret("a"), secret("b"));
    let photo = id(&upload(&server, Some(&ann), 1));
    let at = format!("/v1/photos/{photo}");
    let status = |server: &Running, links: &Value| {
        let token = token_of(links, &photo);
        let by_link = ask(server, "GET", &format!("{at}?{}", links["query"].as_str().unwrap()), &[], &[]).status;
        let by_cookie = ask(server, "GET", &at, &[("cookie", &format!("tmpi_manage={token}"))], &[]).status;
        [by(server, &token, "GET", &at).status, by(server, &token, "PATCH", &at).status, by_cookie, by_link]
    };
    let back = |server: &Running, who: &str| ask(server, "DELETE", &format!("{at}/manage"), &[("authorization", who)], &[]).status;
    let first = links(&server, &ann, &photo);
    assert_eq!((status(&server, &first), back(&server, &bob)), ([200; 4], 404));
    assert_eq!((status(&server, &first), back(&server, &ann)), ([200; 4], 204));
    assert_eq!(status(&server, &first), [404; 4]);
    // the owner can create new links; the state does not tell how often links were revoked
    let second = links(&server, &ann, &photo);
    assert_eq!(status(&server, &second), [200; 4]);
    let own = |server: &Running, path: &str| ask(server, "GET", path, &[("authorization", &ann)], &[]);
    let (state, settings) = (own(&server, &at).json(), own(&server, &format!("{at}/settings")).json());
    assert!(!state.to_string().contains("generation") && !settings.to_string().contains("generation"), "{state} {settings}");
    // neither a change of the settings nor a restart restores revoked links
    let headers = [("authorization", ann.as_str()), JSON];
    assert_eq!(ask(&server, "PATCH", &at, &headers, b"{\"title\": \"A\"}").status, 200);
    assert_eq!((status(&server, &first), status(&server, &second)), ([404; 4], [200; 4]));
    let server = server.restarted();
    assert_eq!((status(&server, &first), status(&server, &second)), ([404; 4], [200; 4]));
    // neither does uploading the same photo again, which has the same id
    assert_eq!(ask(&server, "DELETE", &at, &[("authorization", &ann)], &[]).status, 204);
    assert_eq!(id(&upload(&server, Some(&ann), 1)), photo);
    assert_eq!((status(&server, &first), status(&server, &second)), ([404; 4], [404; 4]));
}

#[test]
fn a_link_changes_a_browsers_owner_only_after_confirmation() {
    let server = private();
    let (ann, bob) = (secret("a"), secret("b"));
    let of = |who: &str| format!("tmpi_owner={}", &who["Bearer ".len()..]);
    let keep = |query: &str, cookie: Option<&str>| {
        let own = ("sec-fetch-site", "same-origin");
        let headers: Vec<_> = [("authorization", ann.as_str()), own].into_iter().chain(cookie.map(|c| ("cookie", c))).collect();
        ask(&server, "POST", &format!("/v1/owner{query}"), &headers, &[])
    };
    for query in ["", "?replace=false"] {
        let refused = keep(query, Some(&of(&bob)));
        assert_eq!(refused.problem(409)["type"], "urn:tmpi:problem:another-owner");
        assert!(refused.header("set-cookie").is_none(), "the browser stays the same owner");
    }
    let kept = |answer: &Response| answer.status == 204 && answer.all("set-cookie").starts_with(&of(&ann));
    assert!(kept(&keep("?replace=true", Some(&of(&bob)))), "the user confirmed");
    assert!(kept(&keep("", Some(&of(&ann)))) && kept(&keep("", None)), "nothing is lost");
    assert!(kept(&keep("", Some("tmpi_owner=none"))), "an invalid cookie counts as none");
    assert_eq!(keep("?replace=yes", None).problem(400)["field"], "replace");
    assert_eq!(keep("?force=true", None).problem(400)["field"], "force");
}

#[test]
fn a_ticket_makes_another_browser_the_same_owner_and_nothing_else() {
    let server = private();
    let (ann, bob) = (secret("a"), secret("b"));
    let photo = id(&upload(&server, Some(&ann), 1));
    let at = format!("/v1/photos/{photo}");
    let ask_for = |headers: &[(&str, &str)]| ask(&server, "POST", "/v1/owner/ticket", headers, &[]);
    assert_eq!(ask_for(&[]).problem(403)["type"], "urn:tmpi:problem:no-owner");
    let told = ask_for(&[("authorization", &ann)]);
    assert_eq!((told.status, told.header("cache-control")), (200, Some("private, no-store")));
    let (told, text) = (told.json(), told.text());
    assert!(!text.contains(&"a".repeat(40)), "the answer does not contain the secret");
    let now = seconds_now();
    assert!((now + 800..now + 1000).contains(&told["expires"].as_u64().unwrap()));
    let ticket = told["ticket"].as_str().unwrap();
    // a ticket is offered to the owner only
    let offered = |who: &str| links(&server, who, &photo)["ticket"].as_str().map(str::to_owned);
    assert_eq!(offered(&ann).as_deref(), Some("/v1/owner/ticket"));
    let token = token_of(&links(&server, &ann, &photo), &photo);
    assert_eq!(offered(&format!("Bearer {token}")), None);
    by(&server, ticket, "GET", &at).problem(404);
    by(&server, ticket, "DELETE", &at).problem(404);
    by(&server, ticket, "POST", "/v1/owner/ticket").problem(403);
    let exchange = |ticket: &str, query: &str, cookie: &str| {
        let bearer = format!("Bearer {ticket}");
        ask(&server, "POST", &format!("/v1/owner{query}"), &[("authorization", &bearer), ("cookie", cookie)], &[])
    };
    let of_bob = format!("tmpi_owner={}", &bob["Bearer ".len()..]);
    exchange(ticket, "", &of_bob).problem(409);
    exchange(&format!("{ticket}0"), "", "").problem(401);
    let other = if ticket.ends_with('0') { "1" } else { "0" };
    exchange(&format!("{}{other}", &ticket[..ticket.len() - 1]), "", "").problem(401);
    for cookie in [exchange(ticket, "?replace=true", &of_bob), exchange(ticket, "", "")] {
        assert_eq!(cookie.status, 204);
        let kept = cookie.all("set-cookie");
        assert!(kept.starts_with("tmpi_owner=tmpi_s_") && kept.ends_with("; HttpOnly; SameSite=Lax"), "{kept}");
        let pair = kept.split(';').next().unwrap();
        let browser = |method: &str, path: &str, cookie: &str| ask(&server, method, path, &[("cookie", cookie), JSON], b"");
        assert_eq!(browser("GET", &at, pair).status, 200);
        assert_eq!(ids(&browser("GET", "/v1/photos", pair))[0], photo);
        // the session stays, cannot be forged, and counts as a cookie only
        assert!(browser("GET", "/", pair).all("set-cookie").starts_with(pair));
        assert_eq!(exchange(ticket, "", pair).status, 204, "it is the same owner");
        browser("GET", &at, &pair[..pair.len() - 1]).problem(404);
        let bearer = pair.trim_start_matches("tmpi_owner=");
        by(&server, bearer, "GET", &at).problem(401);
        assert_eq!(browser("POST", "/v1/owner/ticket", pair).status, 200);
    }
}
