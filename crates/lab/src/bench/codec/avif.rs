//! AVIF by the `ffmpeg` that is installed: no library of ours reads or writes it.

use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

use crate::bench::BenchError;

/// The encoder; others there are without loss of alpha, or without chroma of full size.
const ENCODER: &str = "libaom-av1";
/// A still picture, at the speed that is usual for pictures.
const FLAGS: [&str; 4] = ["-still-picture", "1", "-cpu-used", "6"];
/// Its coarsest step.
const COARSEST: u32 = 63;

/// What pixels are handed over as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pixels {
    /// Three bytes each, coded at a quality.
    Rgb,
    /// One byte each, coded without loss.
    Grey,
}

impl Pixels {
    fn name(self) -> &'static str {
        match self {
            Self::Rgb => "rgb24",
            Self::Grey => "gray",
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::Rgb => 3,
            Self::Grey => 1,
        }
    }
}

/// Whether there is an encoder, else why not.
pub fn available() -> Result<(), String> {
    let listed = Command::new("ffmpeg").args(["-hide_banner", "-encoders"]).stdin(Stdio::null()).output();
    let listed = listed.map_err(|e| format!("ffmpeg, which writes it, cannot be run: {e}"))?;
    let text = String::from_utf8_lossy(&listed.stdout);
    if text.split_whitespace().any(|word| word == ENCODER) { Ok(()) } else { Err(format!("the ffmpeg here has no {ENCODER}")) }
}

/// A file of a picture of `w` × `h`; `quality` 1 to 100 for colours.
pub fn encode(pixels: &[u8], kind: Pixels, (w, h): (u32, u32), quality: u8) -> Result<Vec<u8>, BenchError> {
    let file = Temporary::new();
    let mut command = ffmpeg();
    command.args(["-f", "rawvideo", "-pix_fmt", kind.name(), "-s", &format!("{w}x{h}"), "-i", "pipe:0", "-frames:v", "1"]);
    command.args(["-c:v", ENCODER]).args(FLAGS).args(["-color_range", "pc", "-crf"]);
    match kind {
        // chroma of full size, as the JPEG has that it is compared with, and a matrix that the decoder is told of
        Pixels::Rgb => {
            let rate = (u32::from(100 - quality.clamp(1, 100)) * COARSEST + 49) / 99;
            let colours = ["-vf", "scale=out_color_matrix=bt709:out_range=pc", "-pix_fmt", "yuv444p", "-colorspace", "bt709"];
            command.arg(rate.to_string()).args(colours);
        }
        Pixels::Grey => {
            command.args(["0", "-pix_fmt", "gray", "-aom-params", "lossless=1"]);
        }
    }
    command.arg(&file.0);
    run(command, pixels)?;
    std::fs::read(&file.0).map_err(|e| failed(&e))
}

/// Pixels of a file of `w` × `h`.
pub fn decode(file: &[u8], kind: Pixels, (w, h): (u32, u32)) -> Result<Vec<u8>, BenchError> {
    let input = Temporary::new();
    std::fs::write(&input.0, file).map_err(|e| failed(&e))?;
    let mut command = ffmpeg();
    command.arg("-i").arg(&input.0).args(["-f", "rawvideo", "-pix_fmt", kind.name(), "pipe:1"]);
    let pixels = run(command, &[])?;
    let want = w as usize * h as usize * kind.bytes();
    if pixels.len() == want { Ok(pixels) } else { Err(failed(&format!("{} bytes of pixels, not {want}", pixels.len()))) }
}

fn failed(e: &dyn std::fmt::Display) -> BenchError {
    BenchError::Picture(format!("AVIF: {e}"))
}

fn ffmpeg() -> Command {
    let mut command = Command::new("ffmpeg");
    command.args(["-hide_banner", "-loglevel", "error", "-nostdin", "-y"]);
    command
}

/// Runs a command on an input; gives what it writes.
fn run(mut command: Command, input: &[u8]) -> Result<Vec<u8>, BenchError> {
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().map_err(|e| failed(&e))?;
    let pipe = child.stdin.take();
    // one of the two ends waits for the other
    let output = std::thread::scope(|scope| {
        scope.spawn(|| {
            // a pipe that broke means that it ended, and it says why
            let _ = pipe.map(|mut pipe| pipe.write_all(input));
        });
        child.wait_with_output()
    });
    let output = output.map_err(|e| failed(&e))?;
    if output.status.success() { Ok(output.stdout) } else { Err(failed(&String::from_utf8_lossy(&output.stderr).trim())) }
}

/// A file that goes when it is done with: the format is finished by going back to its start, which a pipe cannot.
struct Temporary(PathBuf);

impl Temporary {
    fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("tmpi-codec-{}-{}.avif", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        Self(std::env::temp_dir().join(name))
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        // may never have been written
        let _ = std::fs::remove_file(&self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grey_comes_back_exactly_and_colours_nearly() {
        let (w, h) = (64u32, 48u32);
        let grey: Vec<u8> = (0..w * h).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        if let Err(why) = available() {
            // the bench says so in place of a row
            assert!(why.contains("ffmpeg") && encode(&grey, Pixels::Grey, (w, h), 1).is_err());
        }
        if tmpi_testing::Need::Ffmpeg.or_skip(available()).is_none() {
            return;
        }
        let file = encode(&grey, Pixels::Grey, (w, h), 1).unwrap();
        assert_eq!(decode(&file, Pixels::Grey, (w, h)).unwrap(), grey);
        let rgb: Vec<u8> = (0..w * h).flat_map(|i| [(i % w * 4) as u8, (i / w * 5) as u8, 90]).collect();
        let [fine, coarse] = [95, 5].map(|quality| {
            let file = encode(&rgb, Pixels::Rgb, (w, h), quality).unwrap();
            (file.len(), crate::metrics::psnr(&rgb, &decode(&file, Pixels::Rgb, (w, h)).unwrap()))
        });
        assert!(fine.1 > 40.0 && coarse.1 < fine.1 && coarse.0 < fine.0, "{fine:?} {coarse:?}");
        assert!(decode(b"no picture", Pixels::Rgb, (w, h)).is_err());
    }
}
