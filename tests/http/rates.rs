//! Rate limits per key and per address.

use tmpi::server::{Network, Proxies, Rates, Server};

use crate::fixture::rooms;
use crate::key_fixture;
use crate::prelude::*;

/// The parameter of an item in a list of RFC 9651, such as `r` of `"uploads"` in `"requests";r=1, "uploads";r=2`.
fn parameter(answer: &Response, header: &str, item: &str, name: &str) -> u64 {
    let all = answer.header(header).unwrap_or_else(|| panic!("{header} is missing"));
    let item = all.split(", ").find_map(|one| one.strip_prefix(&format!("\"{item}\";"))).unwrap_or_else(|| panic!("{item} in {all}"));
    item.split(';').find_map(|p| p.strip_prefix(name)?.strip_prefix('=')?.parse().ok()).unwrap()
}

#[test]
fn a_key_over_its_rate_gets_429_and_other_keys_do_not() {
    let limits = Limits { rates: Rates { requests: 1000, uploads: 2, views: 3 }, ..Limits::default() };
    let server = private_with(limits, Arc::new(pipeline()));
    let key = |name: &str| key_fixture::add(server.data(), name, &[Scope::Upload, Scope::Read]);
    let (site, second_of_site, other) = (key("site"), key("site"), key("other"));
    let upload = |key: &str, seed| ask(&server, "POST", "/v1/photos", &[("authorization", key), ("prefer", "wait=60")], &jpeg(seed));
    let first = upload(&site, 1).is(201);
    assert_eq!(first.header("ratelimit-policy"), Some("\"requests\";q=1000;w=60, \"uploads\";q=2;w=60"));
    assert_eq!((parameter(&first, "ratelimit", "uploads", "r"), parameter(&first, "ratelimit", "requests", "r")), (1, 999));
    assert!(matches!(upload(&second_of_site, 2).status, 201 | 202));
    let refused = upload(&site, 3);
    let wait: u64 = refused.header("retry-after").unwrap().parse().unwrap();
    assert!((1..=30).contains(&wait) && parameter(&refused, "ratelimit", "uploads", "t") == wait, "{wait}");
    assert_eq!(parameter(&refused, "ratelimit", "uploads", "r"), 0);
    let problem = refused.problem(429);
    assert_eq!(problem["type"], "https://iana.org/assignments/http-problem-types#quota-exceeded");
    assert!(problem["detail"].as_str().unwrap().contains("uploads are 2 a minute"), "{problem}");
    assert!(matches!(upload(&other, 3).status, 201 | 202), "another key has its own bucket");
    // views have a bucket, too; states and thumbnails do not count as views
    let id = id(&first.json());
    let see = |part: &str| ask(&server, "GET", &format!("/v1/photos/{id}{part}"), &[("authorization", &site)], &[]).status;
    assert_eq!([see("/view?w=8"), see("/view?w=9"), see("/export?format=glb"), see("/view?w=8")], [200, 200, 200, 429]);
    assert_eq!((see(""), see("/thumbnail")), (200, 200));
}

#[test]
fn other_nodes_are_not_counted_but_whoever_has_another_credential_is() {
    let rates = Rates { requests: 2, uploads: 0, views: 0 };
    let server = Running::owning(|data| {
        let proxies = Proxies::new(&["127.0.0.1".parse::<Network>().unwrap()]);
        let config = Config { proxies, limits: Limits { rates, ..Limits::default() }, ..usual(data) };
        let shared = |server: Server| server.with_rooms(rooms().shared("http://127.0.0.1:9".parse().unwrap()));
        Running::launch(config, Arc::new(pipeline()), drawn_by_cpu(), shared)
    });
    let sign = |room: &str, seconds| key_fixture::of_node(server.data(), room, seconds);
    let statuses = |from: &str, path: &str, credential: &str| {
        let headers = [("x-forwarded-for", from), ("authorization", credential)];
        [(); 4].map(|()| request(server.addr, "GET", path, &headers, &[]).status)
    };
    let (room, node) = ("/v1/live/attic", sign("attic", 3600));
    assert_eq!(statuses("192.0.2.1", room, &node), [200; 4]);
    assert_eq!(statuses("192.0.2.2", "/openapi.json", &node), [200, 200, 429, 429], "it counts for its room only");
    for (from, wrong) in [("192.0.2.3", sign("cellar", 3600)), ("192.0.2.4", sign("attic", -1)), ("192.0.2.5", format!("{node}0"))] {
        assert_eq!(statuses(from, room, &wrong), [403, 403, 429, 429], "{wrong}");
    }
}
