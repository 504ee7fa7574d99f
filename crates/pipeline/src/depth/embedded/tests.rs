//! Photos that carry depth, written as phones write them.

use base64::Engine as _;
use image::{GrayImage, ImageFormat, Luma, Rgb, RgbImage};
use tmpi_testing::jpeg::{multi_picture, segment, with_segments as with};
use tmpi_testing::pictures::encoded;

use super::*;
use crate::{Models, Options, Switch};
use tmpi_core::{DisparityMap, Photo};

const W: u32 = 64;
const H: u32 = 48;

fn photo() -> Vec<u8> {
    encoded(RgbImage::from_fn(W, H, |x, y| Rgb([(x * 3) as u8, (y * 4) as u8, 90])), ImageFormat::Jpeg)
}

/// A map with a quarter of the photo's pixels: a step from 51 to 204 between the left and the right half.
fn map() -> GrayImage {
    GrayImage::from_fn(W / 2, H / 2, |x, _| Luma([if x < W / 4 { 51 } else { 204 }]))
}

fn packet(description: &str) -> String {
    format!(
        "<?xpacket begin='\u{feff}' id='W5M0MpCehiHzreSzNTczkc9d'?><x:xmpmeta xmlns:x='adobe:ns:meta/'>\
         <rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-syntax-ns#'>{description}</rdf:RDF></x:xmpmeta><?xpacket end='w'?>"
    )
}

fn main(description: &str) -> Vec<u8> {
    segment(0xE1, &[b"http://ns.adobe.com/xap/1.0/\0", packet(description).as_bytes()].concat())
}

/// An extended packet in segments of 200 bytes; its name is 32 times the same letter.
fn extended(description: &str, name: u8) -> Vec<Vec<u8>> {
    let whole = packet(description);
    let part = |(i, bytes): (usize, &[u8])| {
        let (length, at) = (whole.len() as u32, (i * 200) as u32);
        let name = [name; 32];
        segment(0xE1, &[b"http://ns.adobe.com/xmp/extension/\0", &name[..], &length.to_be_bytes(), &at.to_be_bytes(), bytes].concat())
    };
    whole.as_bytes().chunks(200).enumerate().map(part).collect()
}

fn gdepth(format: &str, near: &str, far: &str) -> Vec<u8> {
    gdepth_with(&photo(), map(), format, near, far)
}

fn gdepth_with(photo: &[u8], map: GrayImage, format: &str, near: &str, far: &str) -> Vec<u8> {
    let properties = format!(
        "<rdf:Description xmlns:GDepth='http://ns.google.com/photos/1.0/depthmap/' GDepth:Format='{format}' GDepth:Near='{near}' \
         GDepth:Far='{far}' GDepth:Mime='image/png'/>"
    );
    with(photo, &[vec![main(&properties)], extended(&data(map), b'7')].concat())
}

/// The description of an extended packet with a map.
fn data(map: GrayImage) -> String {
    let data = base64::engine::general_purpose::STANDARD_NO_PAD.encode(encoded(map, ImageFormat::Png));
    format!("<rdf:Description xmlns:GDepth='http://ns.google.com/photos/1.0/depthmap/' GDepth:Data='{data}'/>")
}

/// A photo whose main packet refers to the extended packet `name`, with extended packets in this order.
fn extended_twice(name: &str, packets: &[(u8, GrayImage)]) -> Vec<u8> {
    let properties = format!(
        "<rdf:Description xmlns:GDepth='http://ns.google.com/photos/1.0/depthmap/' xmlns:xmpNote='http://ns.adobe.com/xmp/note/' \
         xmpNote:HasExtendedXMP='{name}' GDepth:Format='RangeInverse' GDepth:Near='1' GDepth:Far='5' GDepth:Mime='image/png'/>"
    );
    let packets = packets.iter().flat_map(|(name, map)| extended(&data(map.clone()), *name));
    with(&photo(), &[vec![main(&properties)], packets.collect()].concat())
}

fn dynamic(address: &str) -> Vec<u8> {
    dynamic_with(address, 0, &[])
}

/// With `padding` bytes after the photo, and `behind` at the end of the file.
fn dynamic_with(address: &str, padding: usize, behind: &[u8]) -> Vec<u8> {
    let (confidence, map) = (vec![7; 99], encoded(map(), ImageFormat::Jpeg));
    let item = |address: &str, length: usize| {
        format!(
            "<rdf:li><rdf:Description><Container:Item Item:Mime='image/jpeg' Item:Length='{length}' Item:DataURI='{address}'/></rdf:Description></rdf:li>"
        )
    };
    let primary = item("primary_image", 0).replace(" Item:Length", &format!(" Item:Padding='{padding}' Item:Length"));
    let list = [primary, item("android/depthmap", map.len()), item("android/confidencemap", confidence.len())].concat();
    let description = format!(
        "<rdf:Description xmlns:Container='http://ns.google.com/photos/dd/1.0/container/' xmlns:Item='http://ns.google.com/photos/dd/1.0/item/' \
         xmlns:DepthMap='http://ns.google.com/photos/dd/1.0/depthmap/'><Container:Directory><rdf:Seq>{list}</rdf:Seq></Container:Directory>\
         <DepthMap:Format>RangeLinear</DepthMap:Format><DepthMap:Near>1</DepthMap:Near><DepthMap:Far>5</DepthMap:Far>\
         <DepthMap:DepthURI>{address}</DepthMap:DepthURI></rdf:Description>"
    );
    [with(&photo(), &[main(&description)]), vec![0; padding], map, confidence, behind.to_vec()].concat()
}

fn apple(fields: &[(&str, &str)]) -> String {
    let fields = fields.iter().fold(String::new(), |all, (name, value)| all + &format!("<apdi:{name}>{value}</apdi:{name}>"));
    format!("<rdf:Description xmlns:apdi='http://ns.apple.com/pixeldatainfo/1.0/'>{fields}</rdf:Description>")
}

const PORTRAIT: [(&str, &str); 4] =
    [("AuxiliaryImageType", "disparity"), ("FloatMinValue", "0.5"), ("FloatMaxValue", "2"), ("NativeFormat", "1751411059")];

/// A photo followed by a matte and a map.
fn multi(fields: &[(&str, &str)]) -> Vec<u8> {
    let behind = |d: &str| with(&encoded(map(), ImageFormat::Jpeg), &[main(d)]);
    let matte = behind(&apple(&[("AuxiliaryImageType", "depth"), ("AuxiliaryImageSubType", "portraiteffectsmatte")]));
    let map = behind(&apple(fields));
    multi_picture(&photo(), &[(0, &matte), (0, &map)])
}

/// Disparity δ at the left and right of a photo's map; coding as JPEG leaves a small error.
fn ends(file: &[u8]) -> (f32, f32) {
    let found = embedded_depth(file).unwrap().unwrap();
    let Read { map, size, .. } = found.read(&Limits::default(), W, H).unwrap();
    assert_eq!((map.width, map.height, size), (W, H, (W / 2, H / 2)));
    assert!(map.delta.iter().all(|d| (0.0..=1.0).contains(d)));
    (map.delta[(H / 2 * W + 3) as usize], map.delta[(H / 2 * W + W - 4) as usize])
}

fn near(got: (f32, f32), want: (f64, f64)) {
    assert!((f64::from(got.0) - want.0).abs() < 0.01 && (f64::from(got.1) - want.1).abs() < 0.01, "{got:?}, {want:?} wanted");
}

#[test]
fn values_are_read_as_each_format_defines_them() {
    // v is .2 and .8; distances 1 to 5: 1/z from 1 to .2 in even steps, or z in even steps
    near(ends(&gdepth("RangeInverse", "1", "5")), (1.0 - 0.2 * 0.8, 1.0 - 0.8 * 0.8));
    near(ends(&gdepth("RangeLinear", "1.0", "5.0")), (1.0 / 1.8, 1.0 / 4.2));
    near(ends(&gdepth("RangeInverse", "0.5", "inf")), (0.8, 0.2));
    near(ends(&dynamic("android/depthmap")), (1.0 / 1.8, 1.0 / 4.2));
    near(ends(&multi(&PORTRAIT)), (0.8 / 2.0, 1.7 / 2.0));
    let depth = [("AuxiliaryImageType", "depth"), ("FloatMinValue", "1"), ("FloatMaxValue", "5"), ("NativeFormat", "1751410032")];
    near(ends(&multi(&depth)), (1.0 / 1.8, 1.0 / 4.2));
    assert_eq!(embedded_depth(&gdepth("RangeLinear", "1", "5")).unwrap().unwrap().format, "gdepth");
    assert_eq!(embedded_depth(&dynamic("android/depthmap")).unwrap().unwrap().format, "dynamic-depth");
    assert_eq!(embedded_depth(&multi(&PORTRAIT)).unwrap().unwrap().format, "multi-picture");
}

#[test]
fn unreadable_depth_is_an_error_and_other_pictures_are_not() {
    assert_eq!(embedded_depth(&photo()).unwrap(), None);
    assert_eq!(embedded_depth(&encoded(map(), ImageFormat::Png)).unwrap(), None);
    assert_eq!(embedded_depth(b"").unwrap(), None);
    let matte = [
        ("AuxiliaryImageType", "depth"),
        ("AuxiliaryImageSubType", "portraiteffectsmatte"),
        ("FloatMinValue", "0"),
        ("FloatMaxValue", "1"),
    ];
    assert_eq!(embedded_depth(&multi(&matte)).unwrap(), None);
    let fault = |file: &[u8]| embedded_depth(file).unwrap_err().to_string();
    assert!(fault(&gdepth("Sideways", "1", "5")).contains("Sideways"));
    for (near, far) in [("0", "5"), ("5", "1"), ("nan", "5"), ("1", "x"), ("-1", "5")] {
        let fault = fault(&gdepth("RangeLinear", near, far));
        assert!(fault.contains("not form a range") || fault.contains("missing"), "{near} to {far}: {fault}");
    }
    assert!(fault(&gdepth("RangeLinear", "1", "inf")).contains("not form a range"));
    assert!(fault(&dynamic("android/other")).contains("android/other"));
    assert!(fault(&multi(&[("AuxiliaryImageType", "disparity")])).contains("ends"));
    // listed pictures that are longer than the file
    assert!(fault(&cut_list()).contains("longer"));
}

/// A photo that lists a picture that was cut off.
fn cut_list() -> Vec<u8> {
    let description = "<rdf:Description xmlns:Item='http://ns.google.com/photos/dd/1.0/item/' \
         xmlns:DepthMap='http://ns.google.com/photos/dd/1.0/depthmap/' DepthMap:Format='RangeLinear' DepthMap:Near='1' DepthMap:Far='5' \
         DepthMap:DepthURI='d'><rdf:li Item:Mime='image/jpeg'/><rdf:li Item:Mime='image/jpeg' Item:Length='99999999' Item:DataURI='d'/></rdf:Description>";
    with(&photo(), &[main(description)])
}

#[test]
fn the_extended_packet_named_by_the_main_one_is_read() {
    let stale = || GrayImage::from_pixel(W / 2, H / 2, Luma([255]));
    let name = |letter: &str| letter.repeat(32);
    for order in [vec![(b'A', map())], vec![(b'B', stale()), (b'A', map())], vec![(b'A', map()), (b'B', stale())]] {
        near(ends(&extended_twice(&name("A"), &order)), (1.0 - 0.2 * 0.8, 1.0 - 0.8 * 0.8));
        near(ends(&extended_twice(&format!(" {} ", name("a")), &order)), (1.0 - 0.2 * 0.8, 1.0 - 0.8 * 0.8));
        let fault = embedded_depth(&extended_twice(&name("C"), &order)).unwrap_err().to_string();
        assert!(fault.contains("incomplete"), "{fault}");
    }
}

#[test]
fn depth_is_found_whatever_follows_the_last_picture() {
    let want = (1.0 / 1.8, 1.0 / 4.2);
    let samsung = b"\0\0\x01\x0a\x0e\0\0\0Image_UTC_Data1577836800000SEFHk\0\0\0\x01\0\0\0SEFT";
    let picture = photo();
    for behind in [&b""[..], b"\n", samsung, &[0; 5000], &[0xFF; 7], &picture] {
        for padding in [0, 12] {
            near(ends(&dynamic_with("android/depthmap", padding, behind)), want);
        }
        near(ends(&[&multi(&PORTRAIT), behind].concat()), (0.8 / 2.0, 1.7 / 2.0));
        near(ends(&[&gdepth("RangeLinear", "1.0", "5.0"), behind].concat()), want);
    }
}

#[test]
fn a_map_is_turned_upright_with_its_photo() {
    let file = oriented(&gdepth("RangeInverse", "1", "5"), 6);
    let found = embedded_depth(&file).unwrap().unwrap();
    let Read { map, size, .. } = found.read(&Limits::default(), H, W).unwrap();
    assert_eq!(size, (H / 2, W / 2));
    let at = |x: u32, y: u32| map.delta[(y * H + x) as usize];
    // columns of the stored map are rows now, with its left at the top
    near((at(H / 2, 3), at(H / 2, W - 4)), (1.0 - 0.2 * 0.8, 1.0 - 0.8 * 0.8));
    near((at(3, 3), at(H - 4, 3)), (1.0 - 0.2 * 0.8, 1.0 - 0.2 * 0.8));
}

/// Sets an orientation. With 6, the stored top is the upright right.
fn oriented(file: &[u8], orientation: u8) -> Vec<u8> {
    let exif = [b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".as_slice(), &[orientation, 0, 0, 0, 0, 0, 0]].concat();
    with(file, &[segment(0xE1, &exif)])
}

#[test]
fn a_map_lies_as_its_photo_does_in_all_eight_orientations_wherever_it_is() {
    let models = Models { depth: std::sync::Arc::new(("none", |_: &Photo| Err(DepthError::NotEmbedded))), theta: None, psi: None };
    let plain = Options { denoise: crate::Denoise::Off, snap: Switch::Off, ..Options::default() };
    // the quarters of the upright picture lie at four distances
    let quarter = |x: u32, y: u32| [51, 102, 153, 204][usize::from(x >= W / 2) + 2 * usize::from(y >= H / 2)];
    let upright = GrayImage::from_fn(W, H, |x, y| Luma([quarter(x, y)]));
    let both =
        RgbImage::from_fn(2 * W, H, |x, y| if x < W { Rgb([(x * 3) as u8, (y * 4) as u8, 90]) } else { Rgb([quarter(x - W, y); 3]) });
    let check = |what: &str, orientation: u8, file: &[u8], given: Option<&[u8]>, stereo| {
        let options = Options { stereo, ..plain.clone() };
        let made = crate::make(&models, &Limits::default(), file, given, &options, &crate::Silent).unwrap();
        assert_eq!((made.disparity.width, made.disparity.height), (W, H), "{what}, {orientation}");
        for (x, y) in [(5, 5), (W - 6, 5), (5, H - 6), (W - 6, H - 6)] {
            let (got, want) = (made.disparity.delta[(y * W + x) as usize], f32::from(quarter(x, y)) / 255.0);
            assert!((got - want).abs() < 0.02, "{what}, {orientation}: {got} for {want} at {x}, {y}");
        }
    };
    for orientation in 1..=8 {
        // a picture as a camera stores it: turned the other way
        let stored = |image: &image::DynamicImage| match orientation {
            2 => image.fliph(),
            3 => image.rotate180(),
            4 => image.flipv(),
            5 => image.rotate90().fliph(),
            6 => image.rotate270(),
            7 => image.rotate270().fliph(),
            8 => image.rotate90(),
            _ => image.clone(),
        };
        let jpeg = |image: &RgbImage| oriented(&encoded(stored(&image.clone().into()), ImageFormat::Jpeg), orientation);
        let photo = RgbImage::from_fn(W, H, |x, y| *both.get_pixel(x, y));
        let map = encoded(upright.clone(), ImageFormat::Png);
        check("pair", orientation, &jpeg(&photo), Some(&map), crate::Stereo::Auto);
        let stored_map = stored(&upright.clone().into());
        if orientation >= 5 {
            // turned by 90°, its shape tells
            check("stored pair", orientation, &jpeg(&photo), Some(&encoded(stored_map.clone(), ImageFormat::Png)), crate::Stereo::Auto);
        }
        let mut far_is_white = stored_map.to_luma8();
        far_is_white.pixels_mut().for_each(|p| p.0[0] = 255 - p.0[0]);
        let file = gdepth_with(&jpeg(&photo), far_is_white, "RangeInverse", "1", "inf");
        check("embedded", orientation, &file, None, crate::Stereo::Auto);
        check("rgbd", orientation, &jpeg(&both), None, crate::Stereo::Rgbd);
    }
}

#[test]
fn a_map_turns_with_its_photo_unless_its_shape_shows_that_it_is_upright() {
    // stored columns: if the map was turned, each row is uniform
    let columns = |w: u32, h: u32| GrayImage::from_fn(w, h, |x, _| Luma([if x < w / 2 { 51 } else { 204 }]));
    let colours = |w: u32, h: u32| encoded(RgbImage::from_pixel(w, h, Rgb([9, 99, 50])), ImageFormat::Jpeg);
    // stored size of the photo and of its map
    for (photo, map, turns) in [
        ((48, 48), (24, 24), true),
        ((48, 48), (24, 18), true),
        ((48, 48), (18, 24), true),
        ((64, 48), (24, 24), true),
        ((64, 48), (32, 24), true),
        ((64, 48), (24, 32), false),
    ] {
        let file = oriented(&gdepth_with(&colours(photo.0, photo.1), columns(map.0, map.1), "RangeInverse", "1", "5"), 6);
        let found = embedded_depth(&file).unwrap().unwrap();
        let upright = found.read(&Limits::default(), photo.1, photo.0).unwrap().map;
        let (left, right) = (upright.delta[0], upright.delta[photo.1 as usize - 1]);
        assert_eq!((left - right).abs() < 0.1, turns, "a photo of {photo:?} with a map of {map:?}: {left} and {right}");
    }
}

#[test]
fn a_map_may_be_larger_than_its_photo_but_not_than_memory_allows() {
    let with =
        |w, h| gdepth_with(&photo(), GrayImage::from_fn(w, h, |x, _| Luma([if x < w / 2 { 51 } else { 204 }])), "RangeInverse", "1", "5");
    let read = |file: &[u8], limits: &Limits, w, h| embedded_depth(file).unwrap().unwrap().read(limits, w, h);
    for (w, h) in [(W, H), (W, H + 1), (3 * W, 3 * H), (1000, 750)] {
        let Read { map, size, .. } = read(&with(w, h), &Limits::default(), W, H).unwrap();
        assert_eq!((size, map.width, map.height), ((w, h), W, H));
        near((map.delta[3], map.delta[W as usize - 4]), (1.0 - 0.2 * 0.8, 1.0 - 0.8 * 0.8));
    }
    // for a reduced photo, the size of its file still counts
    assert!(read(&with(W, H), &Limits::default(), 8, 6).is_ok());
    let fault = read(&with(2000, 1001), &Limits::default(), W, H).unwrap_err();
    assert!(fault.to_string().contains(&SMALL.to_string()), "{fault}");
    assert!(read(&with(W, H + 1), &Limits { pixels: u64::from(W * H), ..Limits::default() }, W, H).is_err());
}

#[test]
fn carried_depth_is_used_unless_a_map_is_given_or_it_is_switched_off() {
    let flat = |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |_, _| 0.5));
    let models = Models { depth: std::sync::Arc::new(("flat", flat)), theta: None, psi: None };
    let make = |file: &[u8], given: Option<&[u8]>, photo_depth| {
        let options = Options { photo_depth, ..Options::default() };
        crate::make(&models, &Limits::default(), file, given, &options, &crate::Silent).map(|made| made.report)
    };
    let file = gdepth("RangeInverse", "1", "5");
    let report = make(&file, None, Switch::Auto).unwrap();
    let depth = report.input.depth.unwrap();
    assert_eq!((report.depth_model.as_str(), depth.source.as_str(), depth.width, depth.stretched), ("embedded", "gdepth", W / 2, false));
    assert_eq!(make(&file, None, Switch::Off).unwrap().depth_model, "flat");
    let square = encoded(GrayImage::from_pixel(8, 8, Luma([9])), ImageFormat::Png);
    let report = make(&file, Some(&square), Switch::Auto).unwrap();
    assert!(report.depth_model == "given" && report.input.depth.unwrap().stretched);
    // a map in the photo's stored orientation fits once it is turned
    let lying = encoded(GrayImage::from_fn(W, H, |x, _| Luma([if x < W / 2 { 0 } else { 200 }])), ImageFormat::Png);
    let depth = make(&oriented(&photo(), 6), Some(&lying), Switch::Auto).unwrap().input.depth.unwrap();
    assert_eq!((depth.width, depth.height, depth.stretched), (H, W, false));
    // unreadable depth is reported, and is an error only if nothing else may replace it
    let broken = gdepth("RangeInverse", "5", "1");
    let report = make(&broken, None, Switch::Auto).unwrap();
    assert!(report.depth_model == "flat" && report.input.depth_problem.unwrap().contains("not form a range"));
    assert!(make(&broken, None, Switch::On).is_err() && make(&photo(), None, Switch::On).is_err());
}

/// These photos as files, for fuzzing and for trying them out; `TMPI_BLESS=embedded_depth` writes them anew.
#[test]
fn the_stored_files_equal_those_written_here() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds/embedded_depth");
    let files = [
        ("gdepth.jpg", gdepth("RangeInverse", "1", "5")),
        ("dynamic-depth.jpg", dynamic("android/depthmap")),
        ("multi-picture.jpg", multi(&PORTRAIT)),
    ];
    for (name, file) in files {
        let path = folder.join(name);
        if std::env::var("TMPI_BLESS").is_ok_and(|b| b == "embedded_depth") {
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(&path, &file).unwrap();
        }
        let kept = ends(&std::fs::read(&path).unwrap());
        let want = ends(&file);
        near(kept, (want.0.into(), want.1.into()));
    }
}
