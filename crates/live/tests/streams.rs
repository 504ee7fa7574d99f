//! Compares decoded streams of many kinds, made by ffmpeg, with ffmpeg's own decoding.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "test")]

use std::io::Write as _;
use std::process::{Command, Stdio};

use tmpi_core::Photo;
use tmpi_live::access_units::{Splitter, codec};
use tmpi_live::video::{self, VideoError};
use tmpi_testing::Need;
use tmpi_testing::pictures::ivf_frames;

/// Runs ffmpeg with these arguments, separated by spaces, and returns its output; `None` if there is no ffmpeg.
fn ffmpeg(arguments: &str, input: &[u8]) -> Option<Vec<u8>> {
    let mut command = Command::new("ffmpeg");
    command.args(["-loglevel", "error"]).args(arguments.split(' ')).arg("-");
    let spawned = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
    let mut child = Need::Ffmpeg.or_skip(spawned)?;
    let (mut stdin, input) = (child.stdin.take().unwrap(), input.to_vec());
    // ffmpeg may exit before it has read everything
    let writes = std::thread::spawn(move || drop(stdin.write_all(&input)));
    let out = child.wait_with_output().unwrap();
    writes.join().unwrap();
    assert!(out.status.success(), "ffmpeg {arguments}");
    Some(out.stdout)
}

/// A moving test picture in colour, encoded with these arguments.
fn film(size: &str, filters: &str, coder: &str) -> Option<Vec<u8>> {
    ffmpeg(&format!("-f lavfi -i testsrc2=size={size}:rate=10:duration=0.6 -vf {filters} {coder}"), &[])
}

/// An H.264 stream with these x264 parameters.
fn h264(size: &str, filters: &str, parameters: &str) -> Option<Vec<u8>> {
    let coder = "-c:v libx264 -preset veryfast -bf 0 -crf 8";
    film(size, filters, &format!("{coder} -x264-params keyint=3:{parameters} -f h264"))
}

/// Access units of an H.264 stream.
fn units(stream: &[u8]) -> Vec<Vec<u8>> {
    let mut splitter = Splitter::default();
    let mut units = splitter.push(stream).unwrap();
    units.extend(splitter.finish());
    units.into_iter().map(|unit| unit.data).collect()
}

/// Decodes a stream as the server does, at the size in its first frame.
fn shown<T: AsRef<[u8]>>(codec: &str, frames: &[T]) -> Result<Vec<Photo>, VideoError> {
    let size = video::size(codec, frames[0].as_ref())?.expect("a key frame first");
    let mut decoder = video::decoder(codec, size)?;
    frames.iter().filter_map(|frame| decoder.decode(frame.as_ref()).transpose()).collect()
}

/// PSNR, dB, of a decoded stream against ffmpeg's decoding, fully cropped (`unaligned`). Each chroma value applies to four pixels, as in
/// our decoder.
fn psnr(is: &[Photo], (format, stream): (&str, &[u8]), reading: &str) -> f64 {
    let scale = format!("scale={reading}flags=neighbor+accurate_rnd+full_chroma_int");
    let raw = ffmpeg(&format!("-flags unaligned -f {format} -i - -vf {scale} -f rawvideo -pix_fmt rgb24"), stream).unwrap();
    let should = raw.chunks_exact(is[0].rgb.as_flattened().len());
    assert_eq!(is.len(), should.len());
    let squares = is.iter().zip(should).flat_map(|(is, should)| is.rgb.as_flattened().iter().zip(should));
    let (sum, count) = squares.fold((0.0, 0.0), |(sum, count), (a, b)| (sum + f64::from(a.abs_diff(*b)).powi(2), count + 1.0));
    10.0 * (255.0 * 255.0 * count / f64::max(sum, 1e-9)).log10()
}

/// Above this PSNR, dB, two decoders differ only by rounding.
const SAME_PSNR: f64 = 50.0;

#[test]
fn cropping_works_on_all_sides() {
    // size of the film; crop on the left, top, right and bottom; displayed size
    let cuts = [
        ("320x240", [0, 0, 0, 0], (320, 240)),
        ("320x240", [0, 8, 0, 0], (320, 232)),
        ("320x240", [6, 0, 0, 0], (314, 240)),
        ("320x240", [0, 4, 0, 4], (320, 232)),
        ("320x240", [6, 4, 10, 8], (304, 228)),
        ("322x182", [2, 2, 4, 6], (316, 174)),
        ("160x120", [30, 2, 18, 50], (112, 68)),
    ];
    for interlaced in [0, 1] {
        for (size, [left, top, right, bottom], shows) in cuts {
            let cut = format!("crop-rect={left},{top},{right},{bottom}:fake-interlaced={interlaced}");
            // with fields, rows are cropped in multiples of four
            if interlaced == 1 && (top % 4 != 0 || bottom % 4 != 0 || size == "322x182") {
                continue;
            }
            let Some(stream) = h264(size, "format=yuv420p", &cut) else { return };
            let units = units(&stream);
            let codec = codec(&units[0]).unwrap();
            assert_eq!(video::size(&codec, &units[0]).unwrap(), Some(shows), "{size} {cut}");
            let is = shown(&codec, &units).unwrap();
            let psnr = psnr(&is, ("h264", &stream), "in_color_matrix=bt709:");
            assert!(is.len() == 6 && psnr > SAME_PSNR, "{size} {cut}: {} frames, {psnr:.1} dB", is.len());
        }
    }
}

/// Colour matrices: ffmpeg's name in the scale filter, and the name in x264 and in stream metadata.
const MATRICES: [(&str, &str); 4] = [("bt601", "smpte170m"), ("bt709", "bt709"), ("smpte240m", "smpte240m"), ("bt2020", "bt2020nc")];

/// Checks that a decoded stream has this colour matrix and range, not others.
fn check_colours(is: &[Photo], (format, stream): (&str, &[u8]), matrix: &str, range: &str) {
    let read = |matrix: &str, range: &str| psnr(is, (format, stream), &format!("in_color_matrix={matrix}:in_range={range}:"));
    let same = read(matrix, range);
    let another = if matrix == "bt709" { "bt601" } else { "bt709" };
    let [other, wrong] = [read(another, range), read(matrix, if range == "tv" { "pc" } else { "tv" })];
    assert!(same > SAME_PSNR && other < SAME_PSNR - 5.0, "{format} {matrix} {range}: {same:.1} dB, by another matrix {other:.1}");
    assert!(wrong < SAME_PSNR - 5.0, "{format} {matrix} {range}: {wrong:.1} dB by the other range");
}

#[test]
fn h264_colours_follow_the_stream() {
    for (matrix, named) in MATRICES {
        for (range, full, format) in [("tv", "off", "yuv420p"), ("pc", "on", "yuvj420p")] {
            let converted = format!("scale=out_color_matrix={matrix}:out_range={range},format={format}");
            let Some(stream) = h264("320x240", &converted, &format!("colormatrix={named}:fullrange={full}")) else { return };
            let units = units(&stream);
            check_colours(&shown(&codec(&units[0]).unwrap(), &units).unwrap(), ("h264", &stream), matrix, range);
        }
    }
}

#[test]
fn vp9_colours_follow_the_stream() {
    for (matrix, named) in MATRICES {
        for range in ["tv", "pc"] {
            let converted =
                format!("scale=out_color_matrix={matrix}:out_range={range},format=yuv420p,setparams=range={range}:colorspace={named}");
            let coder = "-c:v libvpx-vp9 -deadline realtime -cpu-used 8 -lag-in-frames 0 -auto-alt-ref 0 -crf 10 -b:v 0 -f ivf";
            let Some(file) = film("174x142", &converted, coder) else { return };
            let frames = ivf_frames(&file);
            assert_eq!(video::size("vp09.00.10.08", frames[0]).unwrap(), Some((174, 142)));
            check_colours(&shown("vp09.00.10.08", &frames).unwrap(), ("ivf", &file), matrix, range);
        }
    }
}

#[test]
fn unnamed_colours_are_bt709_or_jpeg_at_full_range() {
    for (range, full, format, matrix) in [("tv", "off", "yuv420p", "bt709"), ("pc", "on", "yuvj420p", "bt601")] {
        let converted = format!("scale=out_color_matrix={matrix}:out_range={range},format={format}");
        let Some(stream) = h264("320x240", &converted, &format!("fullrange={full}")) else { return };
        let units = units(&stream);
        check_colours(&shown(&codec(&units[0]).unwrap(), &units).unwrap(), ("h264", &stream), matrix, range);
    }
}

#[test]
fn unsupported_streams_fail_at_once_with_advice() {
    let kinds = [
        ("format=yuv422p", "", "4:2:0"),
        ("format=yuv444p", "", "4:2:0"),
        ("format=yuv420p10le", "", "8 bits"),
        ("format=yuv420p", "interlaced=1", "interlaced"),
    ];
    for (filters, parameters, word) in kinds {
        let Some(stream) = h264("320x240", filters, parameters) else { return };
        let units = units(&stream);
        let refused = video::size(&codec(&units[0]).unwrap(), &units[0]);
        let why = refused.as_ref().err().map(ToString::to_string).unwrap_or_default();
        assert!(
            matches!(refused, Err(VideoError::Unsupported(_))) && why.contains(word) && why.contains("ffmpeg -"),
            "{filters}: {refused:?}"
        );
    }
    let Some(file) = film("176x144", "format=yuv444p", "-c:v libvpx-vp9 -deadline realtime -cpu-used 8 -f ivf") else { return };
    let refused = video::size("vp09.01.10.08", ivf_frames(&file)[0]);
    assert!(matches!(&refused, Err(VideoError::Unsupported(why)) if why.contains("profile")), "{refused:?}");
}
