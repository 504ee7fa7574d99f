use clap::Parser;
use tmpi_pipeline::photo::Limits as Photo;

use super::*;
use crate::live::Bounds;

#[derive(Parser)]
struct Cli {
    #[command(flatten)]
    serve: ServeArgs,
}

#[test]
fn without_arguments_the_limits_are_the_documented_ones() {
    let args = Cli::try_parse_from(["serve"]).unwrap().serve;
    let photo = args.limits().photo;
    assert_eq!((photo.bytes, photo.pixels), (tmpi_pipeline::photo::Limits::BYTES, tmpi_pipeline::photo::Limits::PIXELS));
    assert_eq!(args.limits(), Limits::default());
}

#[test]
fn every_limit_can_be_set() {
    let args = "--max-body 16 --max-pixels 20 --max-side 1000 --decoder-memory 100 --job-memory 1000 --header-timeout 11 --request-timeout 31 \
        --export-timeout 601 --body-timeout 31 --body-rate 9000 --changes 9 --uploads-beyond 5 \
        --rate-requests 1 --rate-uploads 1 --rate-views 1 --quota-photos 1 --quota-mib 1 --retain-days 1 --retain-mib 1 --retain-sweep 9 \
        --write-timeout 11 --write-rate 1025 --lame-duck 1 --drain 21 --queue 65 --workers 2 --attempts 4 --job-timeout 121 \
        --connections 1025 --connections-per-address 513 --streams 513 --views 3 --views-waiting 65 --exports 2 --exports-waiting 9 --exports-mib 1025 --exports-for 9 \
        --renders 481 --work-memory 1025 --view-pixels 9 --view-side 9 --scene-cache 257 --file-cache 65 --view-cache 65 --export-cache 1025 \
        --max-header 33 --streams-at-once 65 --least-free 65 --least-free-files 1025 --link-days 367 --hsts 9 \
        --rest 21 --look-over-first 61 --look-over 9 --look-over-rate 33 --lease 31 --page 201 --keep-alive 16";
    let set = Cli::try_parse_from(["serve"].into_iter().chain(args.split_whitespace())).unwrap().serve.limits();
    // names all fields, so that none is forgotten
    macro_rules! all_differ {
        ($of:ident, $set:expr, $usual:expr, $($field:ident)*) => {{
            let ($of { $($field),* }, usual) = ($set, $usual);
            $(assert_ne!($field, usual.$field, stringify!($field));)*
        }};
    }
    all_differ!(Photo, set.photo, Limits::default().photo, bytes pixels side decoder_memory memory);
    all_differ!(Limits, set, Limits::default(), photo body header header_read request export body_read body_rate changes uploads_beyond
        rate_requests rate_uploads rate_views quota_photos quota_bytes retain retain_bytes retain_sweep write write_rate
        lame_duck drain queue workers attempts job job_memory connections connections_per_address streams_at_once streams views views_waiting exports
        exports_waiting exports_bytes exports_for renders work_memory view_pixels view_side scene_cache file_cache view_cache export_cache rest look_over_first
        look_over look_over_rate lease reserve link hsts page keep_alive);
}

#[test]
fn every_bound_of_rooms_can_be_set() {
    let of = |args: &str| Cli::try_parse_from(["serve"].into_iter().chain(args.split_whitespace())).map(|c| c.serve.bounds.rooms());
    assert_eq!(of("").unwrap(), Bounds::default());
    let Bounds { rooms, viewers, frame, sound } = of("--live-rooms 17 --live-viewers 9 --live-frame 32 --live-sound 17").unwrap();
    assert_eq!((rooms, viewers, frame, sound), (17, 9, 32 << 10, 17 << 10));
    for wrong in
        ["--live-rooms 65", "--live-rooms 0", "--live-viewers 0", "--live-frame 1025", "--live-sound 65", "--max-header 7", "--hsts -1"]
    {
        assert!(of(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn a_node_that_works_has_a_database() {
    let of = |args: &[&str]| Cli::try_parse_from([&["serve"], args].concat()).unwrap().serve.at_work();
    assert!(of(&[]).unwrap_err().is::<Usage>());
    assert_eq!(of(&["--database", "postgres://db/tmpi"]).unwrap().role, Role::Work);
}

#[test]
fn who_comes_is_asked_beyond_loopback_and_under_another_name() {
    let of = |args: &[&str]| Cli::try_parse_from([&["serve"], args].concat()).unwrap().serve.is_private();
    assert!(!of(&[]) && !of(&["--addr", "[::1]:80"]), "on this machine all stays as it is");
    assert!(of(&["--addr", "0.0.0.0:80"]) && of(&["--host", "photos.example"]) && of(&["--access", "private"]));
    assert!(!of(&["--addr", "0.0.0.0:80", "--host", "photos.example", "--access", "open"]));
}

#[test]
fn rates_hold_where_strangers_come_by_themselves_or_are_given() {
    let of = |args: &[&str]| {
        let limits = Cli::try_parse_from([&["serve"], args].concat()).unwrap().serve.limits();
        (limits.rate_requests, limits.rate_uploads, limits.rate_views)
    };
    assert_eq!((of(&[]), of(&["--addr", "0.0.0.0:80", "--host", "photos.example"])), ((0, 0, 0), (0, 0, 0)));
    assert_eq!(of(&["--addr", "0.0.0.0:80"]), (Limits::RATE_REQUESTS, Limits::RATE_UPLOADS, Limits::RATE_VIEWS));
    assert_eq!(of(&["--addr", "0.0.0.0:80", "--rate-views", "0", "--rate-uploads", "7"]), (Limits::RATE_REQUESTS, 7, 0));
    assert_eq!(of(&["--rate-requests", "9"]), (9, 0, 0));
    let direct = ["--addr", "0.0.0.0:443", "--host", "photos.example", "--tls-cert", "c", "--tls-key", "k"];
    assert_eq!(of(&direct).0, Limits::RATE_REQUESTS, "no proxy is in between");
    assert_eq!(of(&["--host", "photos.example", "--trusted-proxies", "127.0.0.1"]).0, Limits::RATE_REQUESTS, "it tells clients apart");
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
fn a_node_that_advertises_an_address_shares_a_database() {
    let of = |args: &[&str]| Cli::try_parse_from([&["serve", "--advertise"], args].concat()).ok().and_then(|c| c.serve.advertise);
    let database = ["--database", "postgres://127.0.0.1/tmpi"];
    assert_eq!(of(&[&["http://10.0.0.3:8080"][..], &database].concat()).unwrap().host(), "10.0.0.3");
    assert_eq!((of(&["http://10.0.0.3:8080"]), of(&[&["10.0.0.3:8080"][..], &database].concat())), (None, None));
}

#[test]
fn a_server_for_others_says_goodbye_before_it_goes() {
    let of = |args: &[&str]| Cli::try_parse_from([&["serve"], args].concat()).unwrap().serve.limits().lame_duck;
    assert_eq!((of(&[]), of(&["--addr", "0.0.0.0:80"])), (Duration::ZERO, Limits::LAME_DUCK));
    assert_eq!(of(&["--lame-duck", "9"]), Duration::from_secs(9));
}

#[test]
fn photos_that_no_reader_takes_cannot_be_allowed() {
    assert!(Cli::try_parse_from(["serve", "--max-pixels", "50"]).is_ok());
    assert!(Cli::try_parse_from(["serve", "--max-pixels", "51"]).is_err());
}
