#![allow(clippy::unwrap_used, reason = "test")]

use super::fixtures::{bare_in, discs as scene, matted, rough};
use super::*;
use crate::{Geometry, Grid, Inpainter, MATTE_BAND, Photo, Scene};

fn container((geometry, s): &(Geometry, Scene)) -> Vec<u8> {
    let photo = EncodedPhoto::from_photo(&s.photo, 90).unwrap();
    let (bytes, parts) = encode(geometry, s, &photo, OptionalSections { alpha: true, hidden: Some(HiddenCodec::Jpeg(90)) }).unwrap();
    assert_eq!(parts.total, bytes.len());
    assert_eq!(parts.index + parts.photo + parts.alpha + parts.hidden, bytes.len());
    bytes
}

/// A container with only photo (lossless), planes and labels.
fn bare(made: &(Geometry, Scene)) -> Vec<u8> {
    bare_in(None, made)
}

#[test]
fn derived_hidden_colours_are_exact() {
    for (w, h) in [(150, 100), (1, 1), (65, 63)] {
        let (geometry, scene) = scene(w, h);
        let filled: Vec<_> = Inpainter::new(&scene.photo, &geometry).fill_all(&geometry.masks()).into_iter().flatten().flatten().collect();
        let bytes = bare(&(geometry, scene));
        assert!(sections(&bytes).unwrap().iter().all(|s| s.kind != "hidden"));
        assert_eq!(decode(&bytes).unwrap().texels.hidden, filled);
    }
}

#[test]
fn everything_but_lossy_pictures_round_trips_exactly() {
    for (w, h) in [(150, 100), (64, 64), (1, 1), (65, 63), (1, 200)] {
        let made = scene(w, h);
        let (s, d) = (&made.1, decode(&container(&made)).unwrap());
        assert_eq!((&d.grid, &d.intrinsics, &d.view_box, &d.layers), (&s.grid, &s.intrinsics, &s.view_box, &s.layers));
        assert_eq!((&d.texels.class, &d.texels.alpha), (&s.texels.class, &s.texels.alpha));
        assert_eq!(d.texels.hidden.len(), s.texels.hidden.len());
        assert!(d.texels.hidden.iter().zip(&s.texels.hidden).all(|(a, b)| a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) <= 3)));
    }
    assert!(scene(150, 100).1.texels.hidden.len() > 1000);
    let (geometry, scene) = scene(150, 100);
    let photo = EncodedPhoto::from_photo(&scene.photo, 90).unwrap();
    for how in [HiddenCodec::Png, HiddenCodec::Webp] {
        let bytes = encode(&geometry, &scene, &photo, OptionalSections { alpha: true, hidden: Some(how) }).unwrap().0;
        assert_eq!(decode(&bytes).unwrap().texels, scene.texels);
    }
}

#[test]
fn a_photo_is_encoded_only_if_its_file_is_shorter_than_the_limit() {
    let photo = scene(150, 100).1.photo;
    let whole = EncodedPhoto::from_photo(&photo, 90).unwrap().bytes;
    let shorter_than = |limit| EncodedPhoto::shorter_than(limit, &photo, 90).unwrap().map(|file| file.bytes);
    assert_eq!(shorter_than(whole.len() + 1), Some(whole.clone()));
    for limit in [0, 1, 300, whole.len() / 2, whole.len()] {
        assert_eq!(shorter_than(limit), None, "{limit} of {}", whole.len());
    }
    assert!(EncodedPhoto::shorter_than(0, &Photo::default(), 90).is_err());
}

/// Checks a golden container, which the tests of the browser's decoder share. `TMPI_BLESS=1` writes it.
fn golden(name: &str, write: impl Fn() -> Vec<u8>, exact: bool) {
    use sha2::Digest;
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden");
    let (container, json) = (folder.join(format!("{name}.tmpi")), folder.join(format!("{name}.json")));
    let bless = std::env::var_os("TMPI_BLESS").is_some();
    if bless {
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(&container, write()).unwrap();
    }
    let s = decode(&std::fs::read(&container).unwrap()).unwrap();
    let hash = |data: &[u8]| sha2::Sha256::digest(data).iter().fold(String::new(), |s, b| s + &format!("{b:02x}"));
    let row = |l: &crate::Layer| [l.plane.a, l.plane.b, l.plane.c, l.rect.x.into(), l.rect.y.into(), l.rect.w.into(), l.rect.h.into()];
    let mut got = serde_json::json!({
        "width": s.grid.width,
        "height": s.grid.height,
        "layers": s.layers.iter().map(row).collect::<Vec<_>>(),
        "classes": hash(&s.texels.class),
        "alpha": hash(&s.texels.alpha),
        "hidden": s.texels.hidden.len(),
    });
    if exact {
        got["colours"] = hash(s.texels.hidden.as_flattened()).into();
    }
    if bless {
        std::fs::write(&json, format!("{got}\n")).unwrap();
    }
    let want: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
    assert_eq!(got, want);
}

#[test]
fn golden_containers_stay_readable() {
    golden("v1_carried", || container(&scene(70, 40)), false);
    golden("v1_derived", || bare(&scene(150, 100)), true);
    golden("v1_bands", || bare_in(Some(1), &rough(scene(150, 100))), true);
    golden("v1_matted", || bare_in(Some(1), &matted(rough(scene(150, 100)))), true);
}

/// Seeds of the fuzzer: small containers of every kind, and their contents. `TMPI_BLESS=1` writes them.
#[test]
fn seeds_of_the_fuzzer_are_readable() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/seeds");
    let small = [
        ("carried", container(&scene(70, 40))),
        ("derived", bare(&scene(66, 40))),
        ("pixel", bare(&scene(1, 1))),
        ("bands", bare_in(Some(1), &rough(scene(70, 130)))),
        ("matted", bare(&matted(scene(70, 40)))),
    ];
    if std::env::var_os("TMPI_BLESS").is_some() {
        let write = |kind: &str, name: &str, data: &[u8]| {
            std::fs::create_dir_all(folder.join(kind)).unwrap();
            std::fs::write(folder.join(kind).join(name), data).unwrap();
        };
        for (name, bytes) in &small {
            write("container", &format!("{name}.tmpi"), bytes);
        }
        write("container", "level.tmpi", &level(&bare(&scene(131, 90)), 2).unwrap());
        for (w, h) in [(70, 40), (130, 90)] {
            let b = scene(w, h).0;
            let counts: Vec<u8> = b.tiles.iter().map(|t| t.planes.len() as u8).collect();
            let all: Vec<u8> = b.tiles.iter().flat_map(|t| &t.labels).copied().collect();
            let head = [w as u8 - 1, h as u8 - 1, 63];
            write("labels", &format!("{w}x{h}"), &[&head[..], &[2; 5], &labels::encode(&b.grid, &counts, &all)].concat());
            write("planes", &format!("{w}x{h}"), &[&head[..], &[0], &columns::write(&b.tiles)].concat());
        }
    }
    for (name, bytes) in &small {
        let file = std::fs::read(folder.join("container").join(format!("{name}.tmpi"))).unwrap();
        assert_eq!(decode(&file).unwrap(), decode(bytes).unwrap(), "{name}");
    }
}

#[test]
fn a_smaller_level_shows_the_surface_of_most_pixels() {
    for (w, h) in [(151, 100), (64, 63), (1, 1), (2, 200)] {
        let whole = bare(&scene(w, h));
        assert_eq!(level(&whole, 0).unwrap(), whole);
        let mut large = decode::read(&whole).unwrap().1;
        for n in 1..=LEVELS {
            let file = level(&whole, n).unwrap();
            assert_eq!(decode(&file).unwrap().validate(), Ok(()));
            let small = decode::read(&file).unwrap().1;
            let side = |s: u32| (0..n).fold(s, |s, _| s.div_ceil(2));
            assert_eq!((small.grid.width, small.grid.height, small.grid.size), (side(w), side(h), 64 >> n));
            assert_eq!(small.grid.tiles(), Grid::new(w, h, 64).tiles());
            shows_a_surface_below(&small, &large);
            large = small;
        }
        assert_eq!(level(&whole, 200).unwrap(), level(&whole, LEVELS).unwrap());
    }
}

/// Asserts that each pixel of each tile lies on the plane of most of the 2×2 pixels that it replaces; of equals, on the nearest, whose
/// label is the highest.
fn shows_a_surface_below(small: &Geometry, large: &Geometry) {
    for (t, (tile, below)) in (0..).zip(small.tiles.iter().zip(&large.tiles)) {
        let (r, under) = (small.grid.rect(t), large.grid.rect(t));
        for i in 0..r.area() as u32 {
            let at = |x: u32, y: u32| below.labels[(y.min(under.h - 1) * under.w + x.min(under.w - 1)) as usize];
            let (x, y) = (2 * (i % r.w), 2 * (i / r.w));
            let four = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
            let votes = |l: u8| four.iter().filter(|k| **k == l).count();
            let most = four.into_iter().max_by_key(|l| (votes(*l), *l)).unwrap();
            assert_eq!(tile.planes[usize::from(tile.labels[i as usize])], below.planes[usize::from(most)], "tile {t}, pixel {i}");
        }
    }
}

#[test]
fn selected_sections_form_a_container() {
    let whole = container(&scene(70, 40));
    assert_eq!(select(&whole, &SECTIONS).unwrap(), whole);
    let all = sections(&whole).unwrap();
    for wanted in [&["photo"][..], &["planes", "labels"], &["hidden", "index"], &[]] {
        let some = select(&whole, wanted).unwrap();
        let held = sections(&some).unwrap();
        assert_eq!(held.iter().map(|s| s.kind).collect::<Vec<_>>(), {
            let kinds = all.iter().map(|s| s.kind);
            kinds.filter(|k| wanted.contains(k)).collect::<Vec<_>>()
        });
        for s in &held {
            let was = all.iter().find(|w| w.kind == s.kind).unwrap();
            let bytes = |file: &[u8], s: &SectionInfo| file[s.offset as usize..(s.offset + s.length) as usize].to_vec();
            assert_eq!(bytes(&some, s), bytes(&whole, was));
        }
        assert!(matches!(decode(&some), Err(ContainerError::Broken(_))));
    }
    assert!(select(&whole[..20], &["photo"]).is_err());
}

#[test]
fn an_unused_section_past_the_end_is_an_error() {
    use prost::Message;
    let whole = bare(&scene(70, 40));
    let (mut index, body) = decode::split(&whole).unwrap();
    index.sections.push(schema::Section { kind: 77, offset: 1 << 40, length: 1, ..schema::Section::default() });
    let bytes = [select_sections::header(&whole[4..8], &index.encode_to_vec()), body.to_vec()].concat();
    assert!(matches!(super::decode(&bytes), Err(ContainerError::Broken(_))) && sections(&bytes).is_err());
}

#[test]
fn an_index_has_a_maximum_length() {
    use prost::Message;
    let whole = bare(&scene(70, 40));
    let (index, body) = decode::split(&whole).unwrap();
    let index = index.encode_to_vec();
    // padded with an unknown field: number 2 047, of type bytes
    let of_length = |length: usize| {
        let mut filled = index.clone();
        let room = length - index.len() - 2 - 3;
        assert!((1 << 14..1 << 21).contains(&room), "three bytes for its length");
        filled.extend([0xfa, 0x7f, room as u8 | 0x80, (room >> 7) as u8 | 0x80, (room >> 14) as u8]);
        filled.resize(length, 0);
        super::decode(&[select_sections::header(&whole[4..8], &filled), body.to_vec()].concat())
    };
    assert_eq!(of_length(bounds::INDEX).unwrap(), decode(&whole).unwrap());
    assert!(of_length(bounds::INDEX + 1).unwrap_err().to_string().contains("too long"));
}

#[test]
fn planes_use_the_smaller_of_two_codecs() {
    let codec = |made: &(Geometry, Scene)| sections(&bare(made)).unwrap().iter().find(|s| s.kind == "planes").unwrap().codec;
    let made = scene(150, 300);
    assert_eq!(codec(&made), "zstd");
    // the second is the golden scene
    for made in [rough(made), rough(scene(150, 100))] {
        assert_eq!(codec(&made), "range");
        assert_eq!(decode::read(&bare(&made)).unwrap().1, made.0);
    }
}

#[test]
fn a_container_with_its_sections_unpacked_is_the_same_scene() {
    let codecs = |bytes: &[u8]| sections(bytes).unwrap().into_iter().map(|s| (s.kind, s.codec)).collect::<Vec<_>>();
    let packed = container(&scene(150, 300));
    assert!([("planes", "zstd"), ("alpha", "zstd")].iter().all(|s| codecs(&packed).contains(s)));
    let plain = unpacked(&packed).unwrap();
    assert!(codecs(&plain).iter().all(|(_, codec)| *codec != "zstd"), "{:?}", codecs(&plain));
    assert_eq!(decode(&plain).unwrap(), decode(&packed).unwrap());
    // a container without zstd sections does not change
    let range = bare(&rough(scene(150, 100)));
    assert_eq!(unpacked(&range).unwrap(), range);
}

#[test]
fn the_number_of_planes_bounds_unpacked_sections() {
    use prost::Message;
    let packed = container(&scene(150, 300));
    let (index, body) = decode::split(&packed).unwrap();
    let (planes, tiles) = (u64::from(index.planes), u64::from(Grid::new(150, 300, 64).tiles()));
    for (kind, most) in [(schema::Kind::Planes, tiles + 6 * planes), (schema::Kind::Alpha, 64 * 64 * planes)] {
        let with_length = |length| {
            let mut index = index.clone();
            index.sections.iter_mut().find(|s| s.kind() == kind).unwrap().raw_length = length;
            unpacked(&[select_sections::header(&packed[4..8], &index.encode_to_vec()), body.to_vec()].concat()).map(drop)
        };
        assert!(with_length(most).is_ok(), "{kind:?}");
        assert!(with_length(most + 1).unwrap_err().to_string().ends_with("has the wrong length"), "{kind:?}");
    }
}

#[test]
fn bands_hold_the_same_labels_as_one_stream() {
    let made = scene(150, 300);
    let (one, bands) = (bare(&made), bare_in(Some(2), &made));
    assert_eq!(decode(&one).unwrap(), decode(&bands).unwrap());
    let codec = |bytes: &[u8]| sections(bytes).unwrap().iter().find(|s| s.kind == "labels").unwrap().codec;
    assert_eq!((codec(&one), codec(&bands)), ("range", "range-bands"));
}

#[test]
fn matting_is_a_flag_and_needs_no_section() {
    let (plain, made) = (scene(150, 100), matted(scene(150, 100)));
    let bytes = bare(&made);
    let read = decode::read(&bytes).unwrap();
    assert_eq!((&read.0, &read.1), (&made.1.photo, &made.0));
    assert_eq!(sections(&bytes).unwrap().iter().map(|s| s.kind).collect::<Vec<_>>(), ["photo", "planes", "labels"]);
    let [got, unmatted] = [&made.0, &Geometry { matte_band: 0, ..made.0.clone() }].map(|g| crate::texture(&made.1.photo, g, g.masks()));
    let same = |a: &[Vec<crate::TexturedLayer>], s: &Scene| {
        let all = || a.iter().flatten();
        let alpha: Vec<u8> = all().flat_map(|l| l.shape.alpha.clone()).collect();
        let hidden: Vec<[u8; 3]> = all().flat_map(|l| l.hidden.clone()).collect();
        (alpha, hidden) == (s.texels.alpha.clone(), s.texels.hidden.clone())
    };
    let scene = decode(&bytes).unwrap();
    assert!(same(&got, &scene) && !same(&unmatted, &scene));
    // its levels and regions are matted, too
    let parts = [level(&bytes, 1).unwrap(), region(&bytes, &TileRect { columns: 1..3, rows: 0..1 }, 0, RegionPhoto::Lossless).unwrap()];
    assert!(parts.iter().all(|part| decode::read_geometry(part).unwrap().matte_band == MATTE_BAND));
    assert_eq!(decode::read_geometry(&bare(&plain)).unwrap().matte_band, 0);
}

#[test]
fn a_matted_container_carries_no_derived_sections() {
    use prost::Message;
    let (geometry, s) = matted(scene(70, 40));
    let photo = EncodedPhoto::from_photo(&s.photo, 90).unwrap();
    for optional in [OptionalSections { alpha: true, hidden: None }, OptionalSections { alpha: false, hidden: Some(HiddenCodec::Png) }] {
        assert!(matches!(encode(&geometry, &s, &photo, optional), Err(ContainerError::Encode(_))));
    }
    let carried = container(&scene(70, 40));
    let (mut index, body) = decode::split(&carried).unwrap();
    index.matted = true;
    let both = [select_sections::header(&carried[4..8], &index.encode_to_vec()), body.to_vec()].concat();
    assert!(decode(&both).unwrap_err().to_string().contains("matted"));
}

#[test]
fn rows_of_a_matted_container_match_the_whole() {
    for made in [matted(scene(150, 300)), matted(rough(scene(150, 300)))] {
        let bytes = bare(&made);
        let whole = decode(&bytes).unwrap();
        let grid = whole.grid;
        for row in 0..grid.rows() {
            let pixel_rows = pixel_rows(&bytes, &(row..row + 1)).unwrap();
            let own = pixel_rows.start as usize * 150..pixel_rows.end as usize * 150;
            let photo = PhotoRows { width: 150, height: 300, top: pixel_rows.start, rgb: whole.photo.rgb[own].to_vec() };
            let part = decode_rows(&bytes, &(row..row + 1), &photo, None).unwrap();
            let of_row = |l: &&crate::Layer| l.tile / grid.columns() == row;
            let all: Vec<_> = whole.layers.iter().filter(of_row).collect();
            let texels: usize = all.iter().map(|l| l.rect.area()).sum();
            let first = all[0].first_texel;
            assert_eq!(part.texels.class, whole.texels.class[first..first + texels]);
            assert_eq!(part.texels.alpha, whole.texels.alpha[first..first + texels]);
            assert_eq!(part.texels.hidden, whole.texels.hidden[all[0].first_hidden..][..part.texels.hidden.len()]);
        }
    }
}

#[test]
fn a_newer_major_version_is_refused_by_number() {
    let mut b = container(&scene(70, 70));
    b[4] = 2;
    assert!(matches!(decode(&b), Err(ContainerError::Newer { found: 2, known: 1 })));
}

#[test]
fn every_truncation_is_an_error() {
    let b = container(&scene(70, 40));
    for cut in (0..b.len()).step_by(7) {
        assert!(decode(&b[..cut]).is_err(), "cut at {cut}");
    }
}
