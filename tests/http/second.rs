//! Photos with a second picture, from beside: a file of its own, behind the first in the same file, or the other half of the picture.

use tmpi_pipeline::depth::{DepthKind, from_map};
use tmpi_pipeline::{Stereo, photo};
use tmpi_testing::jpeg::{EYE, multi_picture};
use tmpi_testing::pictures::noise;

use crate::prelude::*;

const W: u32 = 160;
const H: u32 = 120;
/// Disparity of the upper and of the lower half, in pixels.
const FAR: u32 = 3;
const NEAR: u32 = 9;

/// What an eye sees whose upper half is `far` and whose lower half `near` pixels further to the left.
fn seen(width: u32, height: u32, far: u32, near: u32) -> View {
    let at = |i: u32| {
        let (x, y) = (i % width, i / width);
        let shift = if y < height / 2 { far } else { near };
        // spots of three pixels
        let v = (256.0 * noise((x + shift) / 3, y / 3)) as u8;
        [v, v / 2 + 60, 255 - v, 255]
    };
    View { width, height, rgba: (0..width * height).map(at).collect() }
}

fn file(view: &View, format: PictureFormat) -> Vec<u8> {
    encode(view, format, 95).unwrap()
}

fn first() -> Vec<u8> {
    file(&seen(W, H, 0, 0), PictureFormat::Png)
}

fn second() -> Vec<u8> {
    file(&seen(W, H, FAR, NEAR), PictureFormat::Png)
}

/// Both beside one another, or one above the other.
fn halves(above: bool) -> Vec<u8> {
    let [a, b] = [seen(W, H, 0, 0), seen(W, H, FAR, NEAR)].map(|view| view.rgba);
    let (width, height) = if above { (W, 2 * H) } else { (2 * W, H) };
    let rows = a.chunks(W as usize).zip(b.chunks(W as usize)).flat_map(|(a, b)| [a, b].concat());
    let rgba = if above { [a.clone(), b.clone()].concat() } else { rows.collect() };
    file(&View { width, height, rgba }, PictureFormat::Png)
}

/// Sends a form and waits for the photo.
fn sent(addr: SocketAddr, parts: &[(&str, &[u8])]) -> Response {
    post_form(addr, &[("prefer", "wait=30")], parts)
}

/// The report of a photo that was just made.
#[track_caller]
fn report(addr: SocketAddr, made: &Response) -> Value {
    assert_eq!(made.status, 201, "{}", String::from_utf8_lossy(&made.body));
    get(addr, &format!("/v1/photos/{}/report", made.json()["id"].as_str().unwrap())).json()
}

/// Holds the report and the served map against the disparities that the pair was made with.
#[track_caller]
fn is_measured(addr: SocketAddr, made: &Response) {
    let report = report(addr, made);
    let (stereo, input) = (&report["error"]["stereo"], &report["input"]);
    assert_eq!((&report["width"], &report["height"]), (&W.into(), &H.into()));
    assert_eq!((&report["depth_model"], &input["depth"]["source"]), (&"stereo".into(), &"stereo".into()));
    assert_eq!((&input["depth_problem"], &stereo["crossed"]), (&Value::Null, &false.into()));
    let figure = |name: &str| stereo[name].as_f64().unwrap();
    assert!(figure("measured") > 0.8 && figure("estimated") < 0.2, "{stereo}");
    // the ends are those of a few pixels, which may be a pixel off
    assert!((figure("nearest_px") - f64::from(NEAR)).abs() < 1.1 && (figure("farthest_px") - f64::from(FAR)).abs() < 1.1, "{stereo}");
    assert!(figure("rows_px") < 0.5 && figure("infinity_px") <= figure("farthest_px"), "{stereo}");

    let map = get(addr, &format!("/v1/photos/{}/depth", made.json()["id"].as_str().unwrap())).body;
    let (map, _) = from_map(&map, DepthKind::Disparity, &photo::Limits::default(), W, H).unwrap();
    let infinity = figure("infinity_px");
    let delta = |px: u32| (f64::from(px) - infinity) / (figure("nearest_px") - infinity);
    for (y, want) in [(15, delta(FAR)), (40, delta(FAR)), (80, delta(NEAR)), (105, delta(NEAR))] {
        for x in [30, 80, 130] {
            let got = f64::from(map.delta[(y * W + x) as usize]);
            assert!((got - want).abs() < 0.1, "{got} at {x}, {y} in place of {want}");
        }
    }
}

#[test]
fn depth_is_measured_against_a_second_picture_and_the_report_says_so() {
    let server = Running::open();
    let (first, second) = (first(), second());
    let made = sent(server.addr, &[("photo", &first), ("second", &second)]);
    is_measured(server.addr, &made);
    let state = made.json();
    assert_eq!((&state["options"]["stereo"], &state["depth_bytes"]), (&"beside".into(), &second.len().into()));
    // the same upload in another order is the same photo; without the second picture it is another
    let again = sent(server.addr, &[("second", &second), ("photo", &first)]).json();
    assert_eq!(again["id"], state["id"]);
    let alone = sent(server.addr, &[("photo", &first)]);
    assert_ne!(alone.json()["id"], state["id"]);
    assert_eq!(report(server.addr, &alone)["depth_model"], "ramp");
    // the second picture is kept as it came
    let kept = contents(server.data(), state["id"].as_str().unwrap(), "depth");
    assert!(kept.len() == 1 && std::fs::read(&kept[0]).unwrap() == second, "{kept:?}");
}

#[test]
fn depth_is_measured_between_halves_and_behind_one_another() {
    let server = Running::open();
    for (stereo, above) in [(&b"left-right"[..], false), (b"top-bottom", true)] {
        is_measured(server.addr, &sent(server.addr, &[("stereo", stereo), ("photo", &halves(above))]));
    }
    let [a, b] = [seen(W, H, 0, 0), seen(W, H, FAR, NEAR)].map(|view| file(&view, PictureFormat::Jpeg));
    let both = multi_picture(&a, &[(EYE, &b)]);
    is_measured(server.addr, &sent(server.addr, &[("photo", &both)]));
    let none = sent(server.addr, &[("stereo", b"none"), ("photo", &both)]);
    assert_eq!(report(server.addr, &none)["depth_model"], "ramp");
}

#[test]
fn the_right_half_may_be_the_depth_map() {
    let server = Running::open();
    let grey = |x: u32| if x < W / 2 { 51 } else { 204 };
    let photo = seen(W, H, 0, 0).rgba;
    let map: Vec<_> = (0..W).map(|x| [grey(x), grey(x), grey(x), 255]).collect();
    let rgba = photo.chunks(W as usize).flat_map(|row| [row, &map].concat()).collect();
    // the map is grey; JPEG carries some colour of the photo into it
    let both = file(&View { width: 2 * W, height: H, rgba }, PictureFormat::Jpeg);
    for (kind, left) in [(&b"disparity"[..], 0.2), (b"inverted", 0.8)] {
        let made = sent(server.addr, &[("stereo", b"rgbd"), ("depth_kind", kind), ("photo", &both)]);
        let report = report(server.addr, &made);
        assert_eq!((&report["width"], &report["input"]["depth"]["source"]), (&W.into(), &"rgbd".into()));
        let map = get(server.addr, &format!("/v1/photos/{}/depth", made.json()["id"].as_str().unwrap())).body;
        let (map, _) = from_map(&map, DepthKind::Disparity, &photo::Limits::default(), W, H).unwrap();
        let [first, last] = [20, W - 20].map(|x| f64::from(map.delta[(H / 2 * W + x) as usize]));
        assert!((first - left).abs() < 0.02 && (last - (1.0 - left)).abs() < 0.02, "{first} {last}");
    }
    // two eyes are no photo with its map
    let eyes = sent(server.addr, &[("stereo", b"rgbd"), ("photo", &halves(false))]).problem(422);
    assert!(eyes["field"] == "depth" && eyes["detail"].as_str().unwrap().contains("right half is in colour"), "{eyes}");
}

#[test]
fn a_job_is_admitted_by_what_measuring_takes_wherever_the_second_picture_is() {
    let maker = way_within(photo::Limits::default());
    let [a, b] = [seen(W, H, 0, 0), seen(W, H, FAR, NEAR)].map(|view| file(&view, PictureFormat::Jpeg));
    let options = |stereo| Options { stereo, ..Options::default() };
    let (auto, none) = (options(Stereo::Auto), options(Stereo::None));
    let beside = maker.memory(&a, Some(&b), &options(Stereo::Beside));
    assert!(beside > maker.memory(&a, None, &auto));
    let both = multi_picture(&a, &[(EYE, &b)]);
    assert_eq!(maker.memory(&both, None, &auto), beside);
    assert_eq!(maker.memory(&both, None, &none), maker.memory(&a, None, &auto));
    assert_eq!(maker.memory(&halves(false), None, &options(Stereo::LeftRight)), beside);
}

#[test]
fn a_second_picture_that_cannot_be_read_is_refused_by_its_name() {
    let server = Running::open();
    let (first, second) = (first(), second());
    let refused = |file: &[u8]| {
        let problem = post_form(server.addr, &[], &[("photo", &first), ("second", file)]).problem(422);
        assert_eq!((&problem["field"], &problem["type"]), (&"second".into(), &"urn:tmpi:problem:broken-second-picture".into()));
        problem["detail"].as_str().unwrap().to_owned()
    };
    refused(b"no picture at all");
    refused(b"GIF89a............");
    refused(&second[..40]);
    refused(&second[..second.len() / 2]);
    assert!(refused(b"\0\0\0\x24ftypheic\0\0\0\0mif1heic").contains("second eye"));
    assert_eq!(server.listed().len(), 0);
    wait_until("nothing is left", || incoming(server.data()) == 0 && contents(server.data(), "", "").is_empty());
    // damage that only decoding finds fails the photo
    assert_eq!(sent(server.addr, &[("photo", &first), ("second", &spoilt(second))]).problem(422)["field"], "second");
    // one over the limits is refused as one that cannot be read; the photo itself is not at fault
    let larger = file(&seen(2 * W, 2 * H, FAR, NEAR), PictureFormat::Png);
    let server =
        Running::with(Limits::default(), Arc::new(way_within(photo::Limits { pixels: u64::from(W * H), ..photo::Limits::default() })));
    let problem = post_form(server.addr, &[], &[("photo", &first), ("second", &larger)]).problem(422);
    assert!(problem["field"] == "second" && problem["detail"].as_str().unwrap().contains("limit"), "{problem}");
}

#[test]
fn one_of_depth_and_second_is_given_and_once() {
    let server = Running::open();
    let (first, second, map) = (first(), second(), depth_map());
    let field = |parts: &[(&str, &[u8])]| post_form(server.addr, &[], parts).problem(400)["field"].as_str().unwrap().to_owned();
    assert_eq!(field(&[("photo", &first), ("depth", &map), ("second", &second)]), "second");
    assert_eq!(field(&[("photo", &first), ("second", &second), ("depth", &map)]), "depth");
    assert_eq!(field(&[("photo", &first), ("second", &second), ("second", &second)]), "second");
    assert_eq!(field(&[("second", &second)]), "photo");
    // where the other eye is, is said once
    assert_eq!(field(&[("stereo", b"left-right"), ("photo", &first), ("second", &second)]), "stereo");
    assert_eq!(field(&[("photo", &first), ("second", &second), ("stereo", b"none")]), "stereo");
    assert_eq!(field(&[("photo", &first), ("stereo", b"beside")]), "stereo");
    assert_eq!(field(&[("photo", &first), ("stereo", b"both")]), "stereo");
    assert_eq!(server.listed().len(), 0);
}

#[test]
fn what_tells_no_depth_leaves_it_to_the_network_unless_no_other_will_do() {
    let server = Running::open();
    let first = first();
    let tall = file(&seen(H, W, FAR, NEAR), PictureFormat::Png);
    let other = file(&View { rgba: seen(W, H, 0, 0).rgba.into_iter().rev().collect(), width: W, height: H }, PictureFormat::Png);
    for (second, told) in [(&tall, "another shape (120×160)"), (&first, "no parallax"), (&other, "too few"), (&jpeg(1), "too few")] {
        let report = report(server.addr, &sent(server.addr, &[("photo", &first), ("second", second)]));
        let problem = report["input"]["depth_problem"].as_str().unwrap_or_default();
        assert!(problem.contains(told), "{told}: {problem}");
        assert_eq!((&report["depth_model"], &report["error"]["stereo"]), (&"ramp".into(), &Value::Null), "{told}");
        let only = sent(server.addr, &[("photo", &first), ("second", second), ("photo-depth", b"on")]).problem(422);
        assert!(only["field"] == "second" && only["detail"].as_str().unwrap().contains(told), "{only}");
    }
}

#[test]
fn pictures_of_all_directions_are_refused_with_what_helps() {
    let server = Running::open();
    let packet = "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'><rdf:Description \
                  xmlns:GPano='http://ns.google.com/photos/1.0/panorama/' GPano:ProjectionType='equirectangular'/></rdf:RDF></x:xmpmeta>";
    let body = [b"http://ns.adobe.com/xap/1.0/\0", packet.as_bytes()].concat();
    let plain = jpeg(1);
    let sphere = [&plain[..2], &[0xFF, 0xE1], &((body.len() + 2) as u16).to_be_bytes(), &body, &plain[2..]].concat();
    let refused = |answer: Response| {
        let problem = answer.problem(400);
        assert!(problem["field"] == "stereo" && problem["detail"].as_str().unwrap().contains("stereo none"), "{problem}");
    };
    for stereo in ["left-right", "top-bottom"] {
        refused(request(server.addr, "POST", &format!("/v1/photos?stereo={stereo}"), &[], &sphere));
    }
    // by the name of the file
    let named = |fields: &[u8]| {
        let head = b"--x\r\ncontent-disposition: form-data; name=\"photo\"; filename=\"walk.360.top-bottom.jpg\"\r\n\r\n";
        let body = [fields, head, &plain, b"\r\n--x--\r\n"].concat();
        request(server.addr, "POST", "/v1/photos", &[("content-type", "multipart/form-data; boundary=x"), ("prefer", "wait=30")], &body)
    };
    refused(named(b""));
    let flat = named(b"--x\r\ncontent-disposition: form-data; name=\"stereo\"\r\n\r\nnone\r\n");
    assert_eq!(report(server.addr, &flat)["depth_model"], "ramp");
    refused(sent(server.addr, &[("photo", &sphere)]));
    assert_eq!(sent(server.addr, &[("photo", &sphere), ("stereo", b"none")]).status, 201);
}
