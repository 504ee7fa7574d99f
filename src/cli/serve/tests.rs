use clap::Parser;

use super::*;

#[derive(Parser)]
struct Cli {
    #[command(flatten)]
    serve: ServeArgs,
}

fn limits(args: &[&str]) -> Limits {
    Cli::try_parse_from([&["serve"], args].concat()).unwrap().serve.limits().unwrap()
}

#[test]
fn without_arguments_the_limits_have_their_documented_defaults() {
    assert_eq!(limits(&[]), Limits::default());
    let photo = limits(&[]).photo();
    assert_eq!((photo.bytes, photo.pixels), (tmpi_pipeline::photo::Limits::BYTES, tmpi_pipeline::photo::Limits::PIXELS));
}

#[test]
fn explicit_settings_override_those_implied_by_flags() {
    let shared = limits(&["--memory", "256", "--set", "cache.scenes=9", "--workers", "3"]);
    assert_eq!((shared.cache.scenes, shared.cache.files, shared.job_memory, shared.workers), (9 << 20, 4 << 20, 240 << 20, 3));
}

#[test]
fn access_is_private_beyond_loopback_and_with_host_names() {
    let of = |args: &[&str]| Cli::try_parse_from([&["serve"], args].concat()).unwrap().serve.is_private();
    assert!(!of(&[]) && !of(&["--addr", "[::1]:80"]), "loopback is open by default");
    assert!(of(&["--addr", "0.0.0.0:80"]) && of(&["--host", "photos.example"]) && of(&["--access", "private"]));
    assert!(!of(&["--addr", "0.0.0.0:80", "--host", "photos.example", "--access", "open"]));
    let users = ["--trusted-proxies", "127.0.0.1", "--login-header", "Remote-User"];
    assert!(of(&users) && Cli::try_parse_from([&["serve"], &users[2..]].concat()).is_err(), "only with proxies that are trusted");
    let open = Cli::try_parse_from([&["serve", "--access", "open"], &users[..]].concat()).unwrap().serve;
    assert!(open.check().unwrap_err().to_string().contains("--login-header"));
}

#[test]
fn rates_apply_to_direct_clients_or_if_set() {
    let of = |args: &[&str]| limits(args).rates;
    assert_eq!((of(&[]), of(&["--addr", "0.0.0.0:80", "--host", "photos.example"])), (Rates::default(), Rates::default()));
    assert_eq!(of(&["--addr", "0.0.0.0:80"]), Rates::FOR_STRANGERS);
    let set = of(&["--addr", "0.0.0.0:80", "--set", "rates.views=0", "--set", "rates.uploads=7"]);
    assert_eq!(set, Rates { uploads: 7, views: 0, ..Rates::FOR_STRANGERS });
    assert_eq!(of(&["--set", "rates.requests=9"]), Rates { requests: 9, ..Rates::default() });
    let direct = ["--addr", "0.0.0.0:443", "--host", "photos.example", "--tls-cert", "c", "--tls-key", "k"];
    assert_eq!(of(&direct), Rates::FOR_STRANGERS, "no proxy in front");
    assert_eq!(of(&["--host", "photos.example", "--trusted-proxies", "127.0.0.1"]), Rates::FOR_STRANGERS, "the proxy tells clients apart");
}

#[test]
fn zero_workers_are_refused() {
    assert!(Cli::try_parse_from(["serve", "--workers", "0"]).is_err());
    assert!(Cli::try_parse_from(["serve", "--addr", "nowhere"]).is_err());
}

#[test]
fn addresses_are_written_as_people_write_them() {
    for text in ["8080", ":8080", "localhost:8080", "127.0.0.1:8080"] {
        assert_eq!(address(text).unwrap().to_string(), "127.0.0.1:8080", "{text}");
    }
    assert_eq!(address("[::1]:80").unwrap().to_string(), "[::1]:80");
    assert_eq!(address("0").unwrap().port(), 0);
    for text in ["", ":", "nowhere", "localhost", "70000", ":70000", "127.0.0.1", "example.org:80"] {
        assert!(address(text).unwrap_err().contains("127.0.0.1:8080"), "{text}");
    }
}

#[test]
fn a_node_with_a_shared_address_needs_a_shared_database() {
    let of = |args: &[&str]| Cli::try_parse_from([&["serve", "--advertise"], args].concat()).ok().and_then(|c| c.serve.advertise);
    let database = ["--database", "postgres://127.0.0.1/tmpi"];
    assert_eq!(of(&[&["http://10.0.0.3:8080"][..], &database].concat()).unwrap().host(), "10.0.0.3");
    assert_eq!((of(&["http://10.0.0.3:8080"]), of(&[&["10.0.0.3:8080"][..], &database].concat())), (None, None));
}

#[test]
fn a_public_server_has_a_lame_duck_period() {
    let of = |args: &[&str]| limits(args).lame_duck.as_secs();
    assert_eq!((of(&[]), of(&["--addr", "0.0.0.0:80"]), of(&["--set", "limits.lame-duck=9"])), (0, 5, 9));
}
