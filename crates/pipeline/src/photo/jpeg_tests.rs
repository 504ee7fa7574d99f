//! JPEG variants that cameras and programs write and few decoders read.

use image::ImageFormat;
use tmpi_testing::jpeg::{Component, Jpeg, Scans, adobe, components, jfif, smooth, smooth_rgb, without_tables};

use super::tests::{file, ok, picture};
use super::*;

const W: u16 = 67;
const H: u16 = 45;
const SUBSAMPLED: [(u8, u8); 3] = [(2, 2), (1, 1), (1, 1)];
const END: [u8; 2] = [0xFF, 0xD9];

fn writer(sampling: &[(u8, u8)], scans: Scans) -> Jpeg {
    Jpeg { scans, segments: vec![jfif()], ..Jpeg::new(W, H, components(sampling)) }
}

/// Peak signal-to-noise ratio, in dB, of a photo decoded from a file of [`smooth`], with `scale` pixels of the file per pixel.
fn quality(photo: &Photo, scale: f64) -> f64 {
    quality_against(photo, |x, y| smooth_rgb(x * scale, y * scale))
}

fn quality_against(photo: &Photo, want: impl Fn(f64, f64) -> [f64; 3]) -> f64 {
    let at = |i: usize| ((i % photo.width as usize) as f64 + 0.5, (i / photo.width as usize) as f64 + 0.5);
    let error = |(i, got): (usize, &[u8; 3])| -> f64 {
        let want = want(at(i).0, at(i).1);
        (0..3).map(|c| (f64::from(got[c]) - want[c]).powi(2)).sum()
    };
    let sum: f64 = photo.rgb.iter().enumerate().map(error).sum();
    10.0 * (255.0f64.powi(2) / (sum / (3 * photo.rgb.len()) as f64)).log10()
}

/// What may follow a photo: nothing, a few bytes, what Samsung's phones append, and a film with a picture in it, which they append too.
fn trailers() -> [Vec<u8>; 5] {
    let samsung =
        b"\0\0\x01\x0a\x0e\0\0\0Image_UTC_Data1577836800000SEFHk\0\0\0\x01\0\0\0\0\0\x01\x0a\x23\0\0\0\x23\0\0\0\x18\0\0\0SEFT".to_vec();
    let film = [b"\0\0\0\x18ftypmp42\0\0\0\0isommp42\0\0\x01\0mdat".as_slice(), &file(picture(40, 24), ImageFormat::Jpeg)].concat();
    [Vec::new(), b"\n".to_vec(), vec![0; 3000], samsung, film]
}

#[test]
fn files_without_an_end_marker_are_whole() {
    for (sampling, scans) in [
        (SUBSAMPLED, Scans::Interleaved),
        (SUBSAMPLED, Scans::Progressive),
        (SUBSAMPLED, Scans::Separate),
        ([(1, 1); 3], Scans::Separate),
        ([(3, 1), (1, 1), (1, 1)], Scans::Interleaved),
    ] {
        for restart in [0, 2] {
            let whole = Jpeg { restart, ..writer(&sampling, scans) }.write(smooth);
            let (data, full) = (&whole[..whole.len() - 2], ok(&whole));
            assert!(quality(&full.photo, 1.0) > 40.0 && !full.damaged);
            for (end, trailer) in [&END[..], &[], &[0xFF]].into_iter().flat_map(|end| trailers().map(|trailer| (end, trailer))) {
                let got = ok(&[data, end, &trailer].concat());
                let of = format!("{sampling:?} {scans:?} every {restart}, end {end:?}, {} bytes after it", trailer.len());
                assert!(got.photo == full.photo && !got.damaged, "{of}");
                // without an end marker, what follows may hold more than the picture, so the file is not carried
                assert_eq!(got.stripped, full.stripped.as_ref().filter(|_| end == END).cloned(), "{of}");
            }
        }
    }
}

#[test]
fn files_cut_near_their_end_are_damaged_and_files_cut_earlier_are_refused() {
    for (sampling, scans) in
        [(SUBSAMPLED, Scans::Interleaved), ([(3, 1), (1, 1), (1, 1)], Scans::Interleaved), ([(1, 1), (2, 2), (2, 2)], Scans::Interleaved)]
    {
        let whole = Jpeg { height: 160, ..writer(&sampling, scans) }.write(smooth);
        let start = whole.windows(2).position(|w| w == [0xFF, 0xDA]).unwrap();
        let full = ok(&whole).photo;
        for end in [&END[..], &[]] {
            let cut = |share: f64| [&whole[..start + ((whole.len() - start) as f64 * share) as usize], end].concat();
            for share in [0.02, 0.3, 0.6] {
                assert!(decode(&cut(share), &Limits::default(), None).is_err(), "{sampling:?} cut at {share}");
                let reduced = decode(&cut(share), &Limits::default(), Some(20));
                assert!(reduced.is_err() || !end.is_empty(), "{sampling:?} cut at {share}, reduced");
            }
            for share in [0.85, 0.95] {
                let got =
                    decode(&cut(share), &Limits::default(), None).unwrap_or_else(|error| panic!("{sampling:?} cut at {share}: {error}"));
                assert!(got.damaged && got.stripped.is_none(), "{sampling:?} cut at {share}");
                let intact = usize::from(W) * 112;
                assert!(got.photo.rgb[..intact] == full.rgb[..intact] && got.photo.rgb != full.rgb, "{sampling:?} cut at {share}");
            }
        }
    }
}

#[test]
fn files_with_missing_scans_are_damaged_or_refused() {
    let progressive = writer(&SUBSAMPLED, Scans::Progressive).write(smooth);
    let full = ok(&progressive).photo;
    let scans: Vec<usize> = (0..progressive.len() - 1).filter(|&i| progressive[i..].starts_with(&[0xFF, 0xDA])).collect();
    for end in [&END[..], &[]] {
        // after all scans but the last, and after the second
        for (at, least) in [(*scans.last().unwrap(), 30.0), (scans[2], 15.0)] {
            let got = ok(&[&progressive[..at], end].concat());
            assert!(got.damaged && got.photo != full && quality(&got.photo, 1.0) > least, "{end:?}: {}", quality(&got.photo, 1.0));
        }
        assert!(decode(&[&progressive[..scans[1] - 9], end].concat(), &Limits::default(), None).is_err());
    }
    // within the last scan
    let late = ok(&progressive[..progressive.len() - 12]);
    assert!(late.damaged && quality(&late.photo, 1.0) > 40.0);
    let separate = Jpeg { height: 160, ..writer(&SUBSAMPLED, Scans::Separate) }.write(smooth);
    let last = separate.windows(2).rposition(|w| w == [0xFF, 0xDA]).unwrap();
    for end in [&END[..], &[]] {
        let error = decode(&[&separate[..last], end].concat(), &Limits::default(), None).unwrap_err();
        assert!(error.to_string().contains("last scan"), "{error}");
        let late = ok(&[&separate[..separate.len() - 12], end].concat());
        assert!(late.damaged, "{end:?}");
    }
}

/// Samplings of three components, each of which is decoded in every order of scans.
const SAMPLINGS: [[(u8, u8); 3]; 16] = [
    [(1, 1); 3],
    [(2, 1), (1, 1), (1, 1)],
    [(1, 2), (1, 1), (1, 1)],
    SUBSAMPLED,
    [(4, 1), (1, 1), (1, 1)],
    [(4, 2), (1, 1), (1, 1)],
    [(2, 2), (2, 1), (2, 1)],
    [(2, 2), (1, 1), (1, 2)],
    [(2, 1); 3],
    [(3, 1), (1, 1), (1, 1)],
    [(1, 3), (1, 1), (1, 1)],
    [(3, 2), (1, 1), (3, 1)],
    [(1, 1), (2, 2), (2, 2)],
    [(1, 1), (1, 2), (1, 2)],
    [(1, 1), (1, 1), (2, 1)],
    [(1, 2), (2, 1), (2, 1)],
];

#[test]
fn every_sampling_decodes_in_every_order_of_scans() {
    for sampling in SAMPLINGS {
        for scans in [Scans::Interleaved, Scans::Separate, Scans::Progressive] {
            for (restart, (width, height)) in [(0, (W, H)), (3, (W, H)), (1, (17, 9)), (0, (64, 48)), (7, (130, 5))] {
                let file = Jpeg { width, height, restart, ..writer(&sampling, scans) }.write(smooth);
                let of = format!("{sampling:?} {scans:?} every {restart} at {width}×{height}");
                let got = decode(&file, &Limits::default(), None).unwrap_or_else(|error| panic!("{of}: {error}"));
                assert!(quality(&got.photo, 1.0) > 40.0 && !got.damaged, "{of}: {}", quality(&got.photo, 1.0));
                if let Some(stripped) = got.stripped {
                    let again = tmpi_core::container::EncodedPhoto { format: PhotoFormat::Jpeg, bytes: stripped }.decode();
                    assert_eq!(again.unwrap(), got.photo, "{of}: readers of the container see another photo");
                }
                let half = decode(&file, &Limits::default(), Some(u32::from(width) / 2)).unwrap().photo;
                assert!(quality(&half, f64::from(width) / f64::from(half.width)) > 30.0, "{of}, reduced");
            }
        }
    }
}

#[test]
fn grey_and_cmyk_decode_in_any_sampling() {
    let grey = |x: f64, y: f64| [smooth(0, x, y); 3];
    let inks = |x: f64, y: f64| [0, 1, 2].map(|c| smooth(c, x, y) * smooth(3, x, y) / 255.0);
    for scans in [Scans::Interleaved, Scans::Separate, Scans::Progressive] {
        for sampling in [(1, 1), (2, 2), (3, 1), (4, 4)] {
            let photo = ok(&writer(&[sampling], scans).write(smooth)).photo;
            assert!(quality_against(&photo, grey) > 45.0, "{sampling:?} {scans:?}");
        }
        for sampling in [[(1, 1); 4], [(2, 2), (1, 1), (1, 1), (2, 2)], [(1, 1), (1, 1), (1, 1), (2, 2)]] {
            let segments = vec![adobe(0)];
            let photo = ok(&Jpeg { segments, ..writer(&sampling, scans) }.write(smooth)).photo;
            assert!(quality_against(&photo, inks) > 40.0, "{sampling:?} {scans:?}");
        }
    }
}

#[test]
fn jfif_outranks_adobe_and_adobe_outranks_component_names() {
    let stored = |x: f64, y: f64| [0, 1, 2].map(|c| smooth(c, x, y));
    for (segments, names, is_rgb) in [
        (vec![jfif()], *b"\x01\x02\x03", false),
        (vec![jfif(), adobe(0)], *b"\x01\x02\x03", false),
        (vec![adobe(0), jfif()], *b"\x01\x02\x03", false),
        (vec![jfif(), adobe(0)], *b"RGB", false),
        (vec![jfif()], *b"RGB", false),
        (vec![adobe(1)], *b"RGB", false),
        (vec![adobe(0)], *b"\x01\x02\x03", true),
        (vec![adobe(0)], *b"RGB", true),
        (vec![], *b"RGB", true),
        (vec![], *b"\x01\x02\x03", false),
        (vec![], *b"\x00\x01\x02", false),
        (vec![], *b"rgb", false),
        (vec![adobe(2)], *b"\x01\x02\x03", false),
        (vec![adobe(9)], *b"\x01\x02\x03", false),
        (vec![(0xEE, b"Adobe\0".to_vec())], *b"\x01\x02\x03", false),
    ] {
        let components = names.map(|id| Component { id, h: 1, v: 1 }).to_vec();
        let file = Jpeg { segments: segments.clone(), ..Jpeg::new(W, H, components) }.write(smooth);
        let got = ok(&file);
        let found = if is_rgb { quality_against(&got.photo, stored) } else { quality(&got.photo, 1.0) };
        assert!(found > 45.0, "{segments:?} {names:?}: {found}");
        let half = decode(&file, &Limits::default(), Some(33)).unwrap().photo;
        let want = resize(&got.photo, half.width, half.height);
        let off = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b));
        let mean = half.rgb.as_flattened().iter().zip(want.rgb.as_flattened()).map(off).sum::<f64>() / want.rgb.len() as f64;
        assert!(mean < 9.0, "{segments:?} {names:?}: the reduced picture differs: {mean}");
    }
}

#[test]
fn missing_code_tables_default_to_those_of_the_standard() {
    let grey = image::DynamicImage::from(picture(W.into(), H.into())).to_luma8();
    for whole in [file(picture(W.into(), H.into()), ImageFormat::Jpeg), file(grey, ImageFormat::Jpeg)] {
        let full = ok(&whole);
        for kept in [&[][..], &[0x00], &[0x10], &[0x00, 0x10], &[0x01, 0x11]] {
            let frame = without_tables(&whole, kept);
            assert!(frame.len() < whole.len() || kept.len() == 2, "{kept:?}");
            let got = ok(&frame);
            assert!(got.photo == full.photo && !got.damaged && (got.stripped.is_none() || frame.len() == whole.len()), "{kept:?} kept");
            let cut = ok(&frame[..frame.len() - 2]);
            assert!(cut.photo == full.photo && !cut.damaged, "{kept:?} kept, no end marker");
        }
    }
}

#[test]
fn files_of_rare_layout_are_never_carried() {
    for (sampling, scans, common) in [
        (SUBSAMPLED, Scans::Interleaved, true),
        (SUBSAMPLED, Scans::Progressive, true),
        ([(1, 1); 3], Scans::Separate, false),
        (SUBSAMPLED, Scans::Separate, false),
        ([(3, 1), (1, 1), (1, 1)], Scans::Interleaved, false),
        ([(1, 1), (2, 1), (2, 1)], Scans::Interleaved, false),
    ] {
        assert_eq!(ok(&writer(&sampling, scans).write(smooth)).stripped.is_some(), common, "{sampling:?} {scans:?}");
    }
}
