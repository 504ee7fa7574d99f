//! The ffmpeg command of `tmpi live publish`: which source it reads, and whether it copies or encodes the video.

use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context as _, bail};
use serde_json::{Value, json};

use super::Usage;

/// H.264 encoders that need no special hardware, best first, with the arguments for low latency and frames in display order.
const ENCODERS: [(&str, &[&str]); 4] = [
    ("libx264", &["-profile:v", "baseline", "-preset", "veryfast", "-tune", "zerolatency", "-crf", "23"]),
    ("libopenh264", &["-profile:v", "constrained_baseline", "-b:v", "1500k"]),
    ("h264_videotoolbox", &["-profile:v", "baseline", "-realtime", "1", "-b:v", "1500k"]),
    ("h264_mf", &["-b:v", "1500k"]),
];
const OPUS: &str = "libopus";
/// Encoded frames are progressive, with square pixels, even sides of at most 1280 pixels, and BT.709 colours in limited range.
const FILTERS: &str = "yadif=deint=interlaced,scale='iw*if(gt(sar,0),sar,1)':ih,setsar=1,\
    scale=w='min(iw,1280)':h='min(ih,1280)':force_original_aspect_ratio=decrease:force_divisible_by=2:out_color_matrix=bt709:out_range=tv,\
    setparams=colorspace=bt709:range=tv";
/// Frames from one key frame to the next: the longest wait of a viewer who joins or has lost a frame.
const GROUP: &str = "60";
/// Prefixes of sources that run on even if unread.
const LIVE: [&str; 10] = ["rtsp://", "rtsps://", "rtmp://", "rtmps://", "srt://", "rtp://", "udp://", "/dev/", "http://", "https://"];

/// Sample rate and channels of the sound, as on the publishing page (`static/live/microphone.js`).
pub(super) const SOUND: (u32, u32) = (48_000, 1);

/// Where frames come from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Origin<'a> {
    /// A file or a URL for `ffmpeg -i`.
    Address(&'a str),
    /// A raw H.264 file and its frame rate.
    Stream(&'a str, f64),
    /// A camera of this machine; without a name, the system's first.
    Camera(Option<&'a str>),
}

impl<'a> Origin<'a> {
    /// A file or a URL; `rate` is the frame rate of files that do not have one.
    pub(super) fn of(source: &'a str, rate: f64) -> Self {
        let path = Path::new(source);
        let is_raw = path.extension().is_some_and(|e| e == "h264" || e == "264") && !path.is_dir() && !Self::Address(source).is_live();
        if is_raw { Self::Stream(source, rate) } else { Self::Address(source) }
    }

    /// Whether the source runs on even if unread.
    pub(super) fn is_live(self) -> bool {
        match self {
            Self::Address(source) => LIVE.iter().any(|start| source.starts_with(start)),
            Self::Stream(..) => false,
            Self::Camera(_) => true,
        }
    }

    /// Arguments that name the source.
    fn input(self, system: &str) -> anyhow::Result<Vec<String>> {
        let args = |args: &[&str]| args.iter().map(|a| (*a).to_owned()).collect();
        Ok(match self {
            // what comes by HTTP may be a file
            Self::Address(source) if self.is_live() && !source.starts_with("http") => args(&["-i", source]),
            Self::Address(source) => args(&["-re", "-i", source]),
            Self::Stream(file, rate) => args(&["-re", "-r", &rate.to_string(), "-f", "h264", "-i", file]),
            Self::Camera(name) => match (system, name) {
                ("linux", name) => args(&["-f", "v4l2", "-i", name.unwrap_or("/dev/video0")]),
                ("macos", name) => args(&["-f", "avfoundation", "-framerate", "30", "-i", &format!("{}:none", name.unwrap_or("0"))]),
                ("windows", Some(name)) => args(&["-f", "dshow", "-i", &format!("video={name}")]),
                ("windows", None) => {
                    bail!(Usage("--camera needs a name on Windows: `ffmpeg -list_devices true -f dshow -i dummy` lists them".into()))
                }
                _ => bail!(Usage(format!("--camera does not work on {system}; give the URL by which ffmpeg reads the camera"))),
            },
        })
    }

    /// What ffprobe says of the source.
    fn probe(self) -> anyhow::Result<Value> {
        let source = match self {
            Self::Address(source) | Self::Stream(source, _) => source,
            // it cannot be opened twice, and few have H.264 and sound
            Self::Camera(_) => return Ok(json!({ "streams": [{ "codec_type": "video" }] })),
        };
        let entries = "stream=codec_type,codec_name,pix_fmt,field_order,has_b_frames,sample_aspect_ratio:\
            stream_side_data=displaymatrix:frame_side_data=displaymatrix";
        let args = ["-loglevel", "error", "-of", "json", "-show_entries", entries, "-read_intervals", "%+#20", "-i", source];
        serde_json::from_slice(&printed("ffprobe", &args)?).context("the output of ffprobe")
    }
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct InputOptions {
    pub(super) transcode: bool,
    /// Publish the sound, if the source has any.
    pub(super) sound: bool,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    /// Arguments that name the source.
    input: Vec<String>,
    /// Encoder of the video; `None` copies it.
    encoder: Option<&'static str>,
    /// The source's sound is read, too.
    pub(super) sound: bool,
    pub(super) notices: Vec<String>,
}

impl Plan {
    /// Probes the source and the encoders of this machine's ffmpeg.
    ///
    /// # Errors
    /// The source has no video, its video needs an encoder that ffmpeg lacks, or the system has no such camera.
    pub(super) fn new(origin: Origin<'_>, options: InputOptions) -> anyhow::Result<Self> {
        let input = origin.input(std::env::consts::OS)?;
        // ` V....D libx264              libx264 H.264 …`
        let encoders = String::from_utf8(printed("ffmpeg", &["-hide_banner", "-loglevel", "error", "-encoders"])?)?;
        let encoders: Vec<&str> = encoders.lines().filter_map(|line| line.split_whitespace().nth(1)).collect();
        Self::decide(input, &origin.probe()?, options, &encoders)
    }

    fn decide(input: Vec<String>, probed: &Value, options: InputOptions, encoders: &[&str]) -> anyhow::Result<Self> {
        let of_kind = |kind: &str| probed["streams"].as_array()?.iter().find(|s| s["codec_type"] == kind);
        let video = of_kind("video").context("the source has no video")?;
        let list = |of: &Value, key: &str| of[key].as_array().cloned().unwrap_or_default();
        let is_turned = |of: &Value| list(of, "side_data_list").iter().any(|data| data["displaymatrix"].is_string());
        // ffmpeg 5.1 rotates only the frames that carry the rotation, often the key frames alone, and squeezes the others
        if !is_turned(video) && list(probed, "frames").iter().any(is_turned) {
            bail!(
                "the video stream carries a rotation (display orientation), which versions of ffmpeg handle differently; \
                 rotate the video first: ffmpeg -noautorotate -i IN -vf transpose=cclock -c:v libx264 OUT"
            );
        }
        let is = |key: &str, good: &[&str]| good.contains(&video[key].as_str().unwrap_or_default());
        let obstacles = [
            (options.transcode, "--transcode"),
            (!is("codec_name", &["h264"]), "it is not H.264"),
            (video["has_b_frames"] != 0, "its frames are not in display order (B-frames)"),
            (!is("pix_fmt", &["yuv420p", "yuvj420p"]), "its pixels are not 4:2:0 with 8 bits"),
            (!is("field_order", &["", "unknown", "progressive"]), "it is interlaced"),
            (!is("sample_aspect_ratio", &["", "N/A", "0:1", "1:1"]), "its pixels are not square"),
            (is_turned(video), "its frames are rotated"),
        ];
        let mut plan = Self { input, encoder: None, sound: options.sound && of_kind("audio").is_some(), notices: Vec::new() };
        if let Some((_, why)) = obstacles.into_iter().find(|(is, _)| *is) {
            let encoder = ENCODERS.iter().map(|(name, _)| *name).find(|name| encoders.contains(name));
            let encoder =
                encoder.with_context(|| format!("the video has to be encoded ({why}), and this ffmpeg has no encoder of H.264"))?;
            plan.notices.push(format!("{encoder} encodes the video: {why}"));
            plan.encoder = Some(encoder);
        }
        if plan.sound && !encoders.contains(&OPUS) {
            plan.notices.push(format!("the sound is left out: this ffmpeg has no {OPUS}"));
            plan.sound = false;
        }
        Ok(plan)
    }

    /// The ffmpeg command. It writes H.264 to its standard output and sends sound by RTP to `port` on this machine.
    pub(super) fn command(&self, port: Option<u16>) -> Command {
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error"]).args(&self.input).args(["-map", "0:v:0", "-an"]);
        match self.encoder {
            None => command.args(["-c:v", "copy", "-bsf:v", "h264_mp4toannexb"]),
            Some(encoder) => {
                let how = ENCODERS.iter().find(|(name, _)| *name == encoder).map_or(&[][..], |(_, how)| how);
                command.args(["-vf", FILTERS, "-pix_fmt", "yuv420p", "-c:v", encoder]).args(how).args(["-bf", "0", "-g", GROUP])
            }
        };
        command.args(["-f", "h264", "-"]);
        if let Some(port) = port.filter(|_| self.sound) {
            let (rate, channels) = (SOUND.0.to_string(), SOUND.1.to_string());
            command.args(["-map", "0:a:0", "-vn", "-c:a", OPUS, "-b:a", "32k", "-ar", &rate, "-ac", &channels]);
            // the same stream for the receiver when the source is played again
            command.args(["-application", "lowdelay", "-frame_duration", "20", "-f", "rtp", "-ssrc", "1"]);
            command.arg(format!("rtp://127.0.0.1:{port}?rtcpport={port}"));
        }
        command
    }
}

/// The standard output of a program of ffmpeg.
fn printed(program: &str, args: &[&str]) -> anyhow::Result<Vec<u8>> {
    let output = Command::new(program).args(args).stdin(Stdio::null()).output();
    let output = output.with_context(|| format!("starting {program}: is ffmpeg installed?"))?;
    if !output.status.success() {
        let complaint = String::from_utf8_lossy(&output.stderr);
        bail!("{program} has failed ({}): {}", output.status, complaint.lines().last().unwrap_or_default());
    }
    Ok(output.stdout)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_encoder_is_used_and_sound_is_read_if_wanted_and_encodable() {
        let h264 = json!({ "codec_type": "video", "codec_name": "h264", "pix_fmt": "yuv420p", "has_b_frames": 0 });
        let both = json!({ "streams": [{ "codec_type": "audio" }, h264] });
        let plan = |probed: &Value, (transcode, sound), encoders: &[&str]| {
            Plan::decide(vec!["-i".into(), "x".into()], probed, InputOptions { transcode, sound }, encoders)
        };
        let args = |plan: &Plan| plan.command(Some(4000)).get_args().map(|a| a.to_string_lossy()).collect::<Vec<_>>().join(" ");
        let copied = plan(&both, (false, true), &[OPUS]).unwrap();
        assert!(copied.notices.is_empty() && args(&copied).contains("-c:v copy"));
        assert!(args(&copied).ends_with("rtp://127.0.0.1:4000?rtcpport=4000"));
        assert!(!args(&plan(&both, (false, false), &[OPUS]).unwrap()).contains("rtp"));
        let silent = plan(&both, (false, true), &["libx264"]).unwrap();
        assert!(!silent.sound && silent.notices[0].contains(OPUS));
        for (encoders, best) in [(&["libopenh264", "aac", "libx264"][..], "libx264"), (&["h264_mf", "libopenh264"][..], "libopenh264")] {
            let encoded = plan(&both, (true, false), encoders).unwrap();
            assert!(args(&encoded).contains(&format!("-c:v {best} ")) && encoded.notices[0].contains("--transcode"));
        }
        assert!(plan(&both, (true, false), &["aac"]).is_err_and(|e| e.to_string().contains("no encoder of H.264")));
        let sound = json!({ "streams": [{ "codec_type": "audio" }] });
        assert!(plan(&sound, (false, true), &[OPUS]).is_err_and(|e| e.to_string().contains("no video")));
    }

    #[test]
    fn cameras_have_the_system_s_names_and_files_play_in_real_time() {
        let line = |origin: Origin<'_>, system| origin.input(system).map(|args| args.join(" ")).map_err(|e| e.to_string());
        assert_eq!(line(Origin::Camera(None), "linux").as_deref(), Ok("-f v4l2 -i /dev/video0"));
        assert_eq!(line(Origin::Camera(Some("/dev/video2")), "linux").as_deref(), Ok("-f v4l2 -i /dev/video2"));
        assert_eq!(line(Origin::Camera(None), "macos").as_deref(), Ok("-f avfoundation -framerate 30 -i 0:none"));
        assert_eq!(line(Origin::Camera(Some("USB")), "windows").as_deref(), Ok("-f dshow -i video=USB"));
        assert!(line(Origin::Camera(None), "windows").is_err() && line(Origin::Camera(None), "plan9").is_err());
        for (source, live, input) in [
            ("film.mp4", false, "-re -i film.mp4"),
            ("film.h264", false, "-re -r 25 -f h264 -i film.h264"),
            ("rtsp://camera/1.h264", true, "-i rtsp://camera/1.h264"),
            ("http://camera/1", true, "-re -i http://camera/1"),
        ] {
            let origin = Origin::of(source, 25.0);
            assert_eq!((origin.is_live(), line(origin, "linux").as_deref()), (live, Ok(input)));
        }
    }
}
