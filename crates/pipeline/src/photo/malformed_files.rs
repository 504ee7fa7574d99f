//! Files crafted to cost much, and damaged files that could pass as whole.

use tmpi_testing::pictures;

use super::*;

/// A progressive JPEG of 16 × 16 grey pixels with `count` scans: one of DC coefficients, then empty ones. The last delivers everything
/// that is left.
fn scans(count: usize) -> Vec<u8> {
    let mut out = vec![0xFF, 0xD8, 0xFF, 0xDB, 0, 67, 0];
    out.extend_from_slice(&[1; 64]);
    out.extend_from_slice(&[0xFF, 0xC2, 0, 11, 8, 0, 16, 0, 16, 1, 1, 0x11, 0]);
    for (table, symbol) in [(0x00, 0x00), (0x10, 0x20)] {
        out.extend_from_slice(&[0xFF, 0xC4, 0, 20, table, 1]);
        out.extend_from_slice(&[0; 15]);
        out.push(symbol);
    }
    // four blocks with a DC difference of 0
    out.extend_from_slice(&[0xFF, 0xDA, 0, 8, 1, 1, 0x00, 0, 0, 0, 0x0F]);
    for scan in 1..count {
        let last = if scan + 1 < count { 62 } else { 63 };
        // one end-of-band run over four blocks
        out.extend_from_slice(&[0xFF, 0xDA, 0, 8, 1, 1, 0x00, 1, last, 0, 0x1F]);
    }
    out.extend_from_slice(&[0xFF, 0xD9]);
    out
}

#[test]
fn scans_are_counted_before_decoding() {
    let limits = Limits::default();
    check(&scans(jpeg_metadata::MAX_SCANS), &limits).unwrap();
    assert_eq!(decode(&scans(jpeg_metadata::MAX_SCANS), &limits, None).unwrap().photo.at(3, 3), [128; 3]);
    for reduced in [None, Some(4)] {
        let error = decode(&scans(jpeg_metadata::MAX_SCANS + 1), &limits, reduced).unwrap_err();
        assert!(error.to_string().contains("more than 100 scans"), "{error}");
    }
    assert!(check(&scans(jpeg_metadata::MAX_SCANS + 1), &limits).is_err());
}

#[test]
fn a_file_too_short_for_its_claimed_size_is_refused_by_the_check() {
    let mut file = tests::jpeg(64, 64);
    let frame = file.windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
    file[frame + 5..frame + 9].copy_from_slice(&[&3000u16.to_be_bytes()[..], &16_384u16.to_be_bytes()].concat());
    let error = check(&file, &Limits::default()).unwrap_err();
    assert!(error.to_string().contains("cut short"), "{error}");
    // the flattest picture needs few bits and is accepted
    let flat = pictures::jpeg(image::GrayImage::from_pixel(4096, 300, image::Luma([128])), 1);
    assert!(check(&flat, &Limits::default()).is_ok() && !decode(&flat, &Limits::default(), None).unwrap().damaged);
    let error = decode(&scans(1), &Limits::default(), None).unwrap_err();
    assert!(error.to_string().contains("first scan"), "{error}");
    assert!(!decode(&scans(2), &Limits::default(), None).unwrap().damaged);
}

#[test]
fn memory_is_checked_before_decoding_and_fifty_megapixels_of_any_kind_pass() {
    let progressive = scans(2);
    let at = |decoder_memory| check(&progressive, &Limits { decoder_memory, ..Limits::default() });
    // four blocks of 64 coefficients, and 256 pixels
    let need = 4 * 128 + 256 * 3;
    assert!(at(need).is_ok());
    assert!(matches!(at(need - 1), Err(PhotoError::TooMuchMemory { bytes, .. }) if bytes == need));
    let memory = |sampling: u8, marker: u8| {
        let parts: Vec<u8> = (1..=3).flat_map(|id| [id, if id == 1 { sampling } else { 0x11 }, 0]).collect();
        let head = [&[8][..], &6000u16.to_be_bytes(), &8192u16.to_be_bytes(), &[3]].concat();
        jpeg_frame::Frame::read(marker, &[head, parts].concat()).unwrap().memory()
    };
    for (sampling, marker) in [(0x11, 0xC0), (0x22, 0xC2), (0x21, 0xC2), (0x11, 0xC2)] {
        let bytes = memory(sampling, marker);
        assert!(bytes <= Limits::DECODER_MEMORY, "{sampling:x}: {bytes}");
    }
}

#[test]
fn the_check_refuses_a_png_cut_within_a_chunk_and_counts_its_memory() {
    let file = pictures::png(40, 30, &[7; 40 * 30 * 8], image::ExtendedColorType::Rgba16);
    let limits = |decoder_memory| Limits { decoder_memory, ..Limits::default() };
    assert!(check(&file, &limits(40 * 30 * 8)).is_ok());
    assert!(matches!(check(&file, &limits(40 * 30 * 8 - 1)), Err(PhotoError::TooMuchMemory { .. })));
    for end in [30, 40, file.len() - 20, file.len() - 13] {
        assert!(check(&file[..end], &Limits::default()).is_err(), "cut to {end}");
    }
    // only the end chunk follows the picture
    assert!((file.len() - 12..file.len()).all(|end| check(&file[..end], &Limits::default()).is_ok()));
}

#[test]
fn a_palette_has_1_to_256_whole_colours() {
    let chunk = |name: &[u8; 4], body: &[u8]| [&(body.len() as u32).to_be_bytes()[..], name, body, &[0; 4]].concat();
    let head = [&24u32.to_be_bytes()[..], &18u32.to_be_bytes(), &[4, 3, 0, 0, 0]].concat();
    let of = |bytes: usize| {
        [b"\x89PNG\r\n\x1a\n".to_vec(), chunk(b"IHDR", &head), chunk(b"PLTE", &vec![7; bytes]), chunk(b"IDAT", &[0]), chunk(b"IEND", &[])]
            .concat()
    };
    for bytes in [3, 48, 768] {
        assert!(check(&of(bytes), &Limits::default()).is_ok(), "{bytes}");
    }
    for bytes in [0, 1, 2, 61, 767, 769, 771] {
        let refused = check(&of(bytes), &Limits::default()).unwrap_err().to_string();
        assert!(refused.contains("palette"), "{bytes}: {refused}");
    }
}
