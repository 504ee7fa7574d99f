//! Uploads that are refused by their first bytes, before the client has sent the rest.

use std::io::Write;

use tmpi::server::PipelineMaker;
use tmpi_pipeline::photo;

use crate::prelude::*;

/// The real pipeline without the early check of a photo's header.
struct Late(PipelineMaker);

impl Maker for Late {
    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError> {
        self.0.check(photo, depth, options)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        self.0.make(photo, depth, options, sink)
    }
}

/// Limits under which no body is too slow.
fn patient() -> Limits {
    Limits { body_read: Duration::from_hours(1), ..Limits::default() }
}

fn start(photo: photo::Limits) -> Running {
    Running::with(patient(), Arc::new(way_within(photo)))
}

/// The first bytes of a picture that claims a size.
fn claims(format: PictureFormat, side: u16) -> Vec<u8> {
    let wide = u32::from(side).to_be_bytes();
    match format {
        PictureFormat::Png => [b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".as_slice(), &wide, &wide, &[8, 2, 0, 0, 0, 1, 2, 3, 4]].concat(),
        PictureFormat::Jpeg | PictureFormat::Mpo => {
            let frame = [&[0xFF, 0xC0, 0, 17, 8][..], &side.to_be_bytes(), &side.to_be_bytes(), &[3, 1, 0x11, 0, 2, 0x11, 1, 3, 0x11, 1]];
            [&[0xFF, 0xD8][..], &frame.concat()].concat()
        }
        PictureFormat::WebP => {
            let canvas = (u32::from(side) - 1).to_le_bytes();
            [b"RIFF\0\0\x10\0WEBPVP8X\x0a\0\0\0\0\0\0\0".as_slice(), &canvas[..3], &canvas[..3]].concat()
        }
    }
}

/// Announces a body of 20 MB to `target`, and sends only `first`.
fn stalled(addr: SocketAddr, target: &str, content_type: &str, first: &[u8]) -> Response {
    let head = format!("POST {target} HTTP/1.1\r\nhost: localhost\r\ncontent-type: {content_type}\r\ncontent-length: 20000000\r\n\r\n");
    send_raw(addr, &[head.as_bytes(), first].concat())
}

/// A form without its closing boundary.
fn open_form(parts: &[(&str, &[u8])]) -> (String, Vec<u8>) {
    let (content_type, mut body) = form(parts);
    body.truncate(body.len() - b"\r\n--a-boundary-that-is-in-no-part--\r\n".len());
    (content_type, body)
}

/// A problem without its request id.
fn says(mut problem: Value) -> Value {
    problem.as_object_mut().unwrap().remove("request_id");
    problem
}

#[test]
fn a_header_of_a_picture_that_is_too_large_is_refused_while_the_client_sends_no_more() {
    let server = start(patient().photo());
    for format in PictureFormat::ALL {
        let first = claims(format, 60_000);
        let raw = stalled(server.addr, "/v1/photos", format.media_type(), &first);
        assert_eq!(raw.header("connection"), Some("close"), "the rest of the body is still to come");
        let raw = raw.problem(413);
        assert_eq!((&raw["type"], &raw["field"]), (&"urn:tmpi:problem:photo-too-large".into(), &"photo".into()), "{format:?}");
        let (content_type, body) = open_form(&[("title", b"Large"), ("photo", &first)]);
        assert_eq!(says(stalled(server.addr, "/v1/photos", &content_type, &body).problem(413)), says(raw));
        let (content_type, body) = open_form(&[("photo", &jpeg(1)), ("depth", &first)]);
        assert_eq!(stalled(server.addr, "/v1/photos", &content_type, &body).problem(422)["field"], "depth");
    }
    // a client that sends the whole body gets the same answer
    let all = [claims(PictureFormat::Png, 60_000), vec![0; 2_000_000]].concat();
    request(server.addr, "POST", "/v1/photos", &[], &all).problem(413);
    wait_until("nothing is left", || incoming(server.data()) == 0);
    assert!(contents(server.data(), "", "").is_empty());
}

#[test]
fn a_file_that_is_no_picture_is_refused_by_its_first_bytes() {
    let server = start(patient().photo());
    let page = b"<!doctype html><title>A photo</title>";
    assert_eq!(stalled(server.addr, "/v1/photos", "image/jpeg", page).problem(415)["field"], "photo");
    let heic = stalled(server.addr, "/v1/photos", "image/jpeg", b"\0\0\0\x24ftypheic\0\0\0\0mif1heic").problem(415);
    assert!(heic["detail"].as_str().unwrap().contains("Most Compatible"), "{heic}");
    let (content_type, body) = open_form(&[("photo", page)]);
    assert_eq!(stalled(server.addr, "/v1/photos", &content_type, &body).problem(415)["field"], "photo");
    wait_until("nothing is left", || incoming(server.data()) == 0);
}

#[test]
fn a_header_that_comes_byte_by_byte_is_read_as_one_that_comes_at_once() {
    let server = start(patient().photo());
    let chunked = |bytes: &[u8], ends: bool| {
        let mut connection = Connection::open(server.addr);
        let raw = connection.raw();
        raw.write_all(b"POST /v1/photos HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n").unwrap();
        for byte in bytes {
            // the server may have refused the upload by now
            let _ = raw.write_all(&[b"1\r\n", &[*byte][..], b"\r\n"].concat());
        }
        if ends {
            raw.write_all(b"0\r\n\r\n").unwrap();
        }
        connection.receive("POST").unwrap()
    };
    for format in PictureFormat::ALL {
        chunked(&claims(format, 60_000), false).problem(413);
        let photo = picture(2, format);
        let taken = chunked(&photo, true);
        assert_eq!(taken.status, 202, "{format:?}");
        assert_eq!(taken.json()["id"], server.upload(&photo));
    }
}

#[test]
fn a_picture_whose_size_comes_late_is_checked_once_it_is_whole() {
    let server = start(patient().photo());
    let metadata = [&[0xFF, 0xE1, 0xFF, 0xFF][..], &vec![7; 0xFFFF - 2]].concat().repeat(5);
    let behind = |file: &[u8]| [&file[..2], &metadata, &file[2..]].concat();
    let photo = behind(&jpeg(3));
    let frame = photo.windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
    assert!(frame > 256 << 10, "it stands at {frame}");
    assert_eq!(post_form(server.addr, &[], &[("photo", &photo)]).status, 202);
    let large = behind(&claims(PictureFormat::Jpeg, 60_000));
    assert_eq!(request(server.addr, "POST", "/v1/photos", &[], &large).problem(413)["field"], "photo");
}

#[test]
fn memory_is_counted_by_the_header_as_far_as_the_options_are_known() {
    let server = start(photo::Limits { memory: 138 << 20, ..patient().photo() });
    let large = claims(PictureFormat::Png, 4000);
    let raw = stalled(server.addr, "/v1/photos", "image/png", &large).problem(413);
    assert!(raw["detail"].as_str().unwrap().contains(&(138 << 20).to_string()), "{raw}");
    let (content_type, body) = open_form(&[("photo", &large)]);
    assert_eq!(says(stalled(server.addr, "/v1/photos", &content_type, &body).problem(413)), says(raw), "no option makes room for it");
    // this photo fits only if it is reduced, and a form may send `max-size` after the photo
    let view = View { width: 640, height: 480, rgba: vec![[90, 80, 70, 255]; 640 * 480] };
    let photo = encode(&view, PictureFormat::Png, 90).unwrap();
    stalled(server.addr, "/v1/photos", "image/png", &photo[..40]).problem(413);
    stalled(server.addr, "/v1/photos?planes=64&tile=8", "image/png", &claims(PictureFormat::Png, 100)).problem(413);
    post_form(server.addr, &[], &[("photo", &photo)]).problem(413);
    assert_eq!(post_form(server.addr, &[], &[("photo", &photo), ("max-size", b"100")]).status, 202);
}

#[test]
fn early_and_late_checks_agree() {
    let photo = || photo::Limits { pixels: 6_000_000, side: 4000, memory: 400 << 20, decoder_memory: 20_000_000, ..patient().photo() };
    let early = start(photo());
    let late = Running::with(patient(), Arc::new(Late(way_within(photo()))));
    let mut bodies =
        vec![b"<svg xmlns='http://www.w3.org/2000/svg'/>".to_vec(), b"GIF89a\x50\0\x3c\0\x80\0\0".to_vec(), vec![0; 5], jpeg(4)];
    for format in PictureFormat::ALL {
        bodies.extend([1, 60, 2000, 2400, 3000, 4000, 4001, 60_000].map(|side| claims(format, side)));
        bodies.extend([picture(5, format), picture(5, format)[..30].to_vec()]);
    }
    for query in ["", "?planes=64&tile=8", "?max-size=40"] {
        for body in &bodies {
            let target = format!("/v1/photos{query}");
            let [a, b] = [&early, &late].map(|server| request(server.addr, "POST", &target, &[], body));
            assert_eq!(a.status, b.status, "{query} {:?}", &body[..body.len().min(30)]);
            if a.status != 202 {
                assert_eq!(says(a.json()), says(b.json()), "{query}");
            }
        }
    }
    let map = depth_map();
    let maps = bodies.iter().filter(|body| body.len() < 60).chain([&map]);
    for body in maps {
        let [a, b] = [&early, &late].map(|server| post_form(server.addr, &[], &[("photo", &jpeg(6)), ("depth", body)]));
        assert_eq!(a.status, b.status);
        if a.status != 202 {
            assert_eq!(says(a.json()), says(b.json()));
        }
    }
}
