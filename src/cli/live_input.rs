//! The ffmpeg command of `tmpi live publish`: which source it reads, and whether it copies or encodes the video.

use std::process::{Command, Stdio};

use anyhow::{Context as _, bail};
use serde::Deserialize;

use super::Usage;
use super::live_program::is_paced;

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

/// What the user asked for.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Wanted {
    /// Always encode the video.
    pub(super) transcode: bool,
    /// Publish the sound, if the source has any.
    pub(super) sound: bool,
}

/// How a source is read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    /// Arguments that name the source.
    input: Vec<String>,
    /// Encoder of the video; `None` copies it.
    encoder: Option<&'static str>,
    /// The source's sound is read, too.
    pub(super) sound: bool,
    /// Notices for the user.
    pub(super) notices: Vec<String>,
}

/// The output of `ffprobe`.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Probed {
    streams: Vec<Stream>,
    /// The first frames.
    frames: Vec<Picture>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Picture {
    side_data_list: Vec<SideData>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Stream {
    codec_type: String,
    codec_name: String,
    pix_fmt: String,
    field_order: String,
    /// Reorder depth between decoding and display: above 0 for B-frames or reordered P-frames.
    has_b_frames: u32,
    /// Width to height of a pixel, `4:3`.
    sample_aspect_ratio: String,
    side_data_list: Vec<SideData>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct SideData {
    /// The rotation and mirroring for display: lines of an offset and three numbers.
    displaymatrix: String,
}

impl SideData {
    /// Whether the matrix rotates or mirrors the picture.
    fn turns(&self) -> bool {
        let rows: Vec<Vec<i64>> =
            self.displaymatrix.lines().map(|line| line.split_whitespace().filter_map(|n| n.parse().ok()).collect()).collect();
        let numbers: Vec<i64> = rows.into_iter().filter(|row| row.len() == 3).flatten().collect();
        matches!(numbers[..], [a, b, _, c, d, ..] if a <= 0 || b != 0 || c != 0 || d <= 0)
    }
}

impl Probed {
    /// Why the video cannot be copied; `None` if it can.
    fn obstacle(&self) -> Option<String> {
        let video = self.streams.iter().find(|s| s.codec_type == "video")?;
        if video.codec_name != "h264" {
            return Some(format!("its video is {}", video.codec_name));
        }
        if video.has_b_frames > 0 {
            return Some("its frames are not in display order (B-frames)".into());
        }
        if !matches!(video.pix_fmt.as_str(), "" | "yuv420p" | "yuvj420p") {
            return Some(format!("its pixels are {}", video.pix_fmt));
        }
        if video.side_data_list.iter().any(SideData::turns) {
            return Some("its frames are rotated".into());
        }
        if !matches!(video.sample_aspect_ratio.as_str(), "" | "N/A" | "0:1" | "1:1") {
            return Some("its pixels are not square".into());
        }
        let whole = matches!(video.field_order.as_str(), "" | "progressive" | "unknown");
        (!whole).then(|| "it is interlaced".into())
    }

    /// Whether the video stream, and not its container, carries the rotation. ffmpeg 5.1 then rotates only the frames that carry it, often
    /// the key frames alone, and squeezes the others into the rotated size.
    fn turns_within(&self) -> bool {
        let by_container = self.streams.iter().flat_map(|s| &s.side_data_list).any(SideData::turns);
        !by_container && self.frames.iter().flat_map(|f| &f.side_data_list).any(SideData::turns)
    }

    fn has_sound(&self) -> bool {
        self.streams.iter().any(|s| s.codec_type == "audio")
    }
}

impl Plan {
    /// Probes the source and the encoders of this machine's ffmpeg.
    ///
    /// # Errors
    /// The source has no video, its video needs an encoder that ffmpeg lacks, or the system has no such camera.
    pub(super) fn new(origin: Origin<'_>, wanted: Wanted) -> anyhow::Result<Self> {
        let input = input(origin, std::env::consts::OS)?;
        // a camera is not probed: it cannot be opened twice, and few have H.264 and sound
        let probed = match origin {
            Origin::Address(source) | Origin::Stream(source, _) => probe(source)?,
            Origin::Camera(_) => {
                let camera = Stream { codec_type: "video".into(), codec_name: "a camera's".into(), ..Stream::default() };
                Some(Probed { streams: vec![camera], ..Probed::default() })
            }
        };
        decided(input, probed.as_ref(), wanted, encoders)
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
            command.args(["-application", "lowdelay", "-frame_duration", "20", "-f", "rtp"]);
            command.arg(format!("rtp://127.0.0.1:{port}?rtcpport={port}"));
        }
        command
    }
}

/// Arguments that name a source.
fn input(origin: Origin<'_>, system: &str) -> anyhow::Result<Vec<String>> {
    let args = |args: &[&str]| args.iter().map(|a| (*a).to_owned()).collect();
    Ok(match origin {
        Origin::Address(source) if is_paced(source) => args(&["-i", source]),
        Origin::Stream(file, rate) => args(&["-re", "-framerate", &rate.to_string(), "-f", "h264", "-i", file]),
        Origin::Address(source) => args(&["-re", "-i", source]),
        Origin::Camera(name) => match (system, name) {
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

/// Decides how to read a source by its probe; `encoders` lists those of this machine's ffmpeg.
fn decided(
    input: Vec<String>,
    probed: Option<&Probed>,
    wanted: Wanted,
    encoders: impl FnOnce() -> anyhow::Result<Vec<String>>,
) -> anyhow::Result<Plan> {
    let mut plan = Plan { input, encoder: None, sound: false, notices: Vec::new() };
    if probed.is_none() {
        plan.notices.push("ffprobe is not installed: the video is passed on unchanged, the sound is left out".into());
    }
    if probed.is_some_and(|p| p.streams.iter().all(|s| s.codec_type != "video")) {
        bail!("the source has no video");
    }
    if probed.is_some_and(Probed::turns_within) {
        bail!(
            "the video stream carries a rotation (display orientation), which versions of ffmpeg handle differently; \
             rotate the video first: ffmpeg -noautorotate -i IN -vf transpose=cclock -c:v libx264 OUT"
        );
    }
    let obstacle = if wanted.transcode { Some("--transcode".into()) } else { probed.and_then(Probed::obstacle) };
    let sound = wanted.sound && probed.is_some_and(Probed::has_sound);
    if obstacle.is_none() && !sound {
        return Ok(plan);
    }
    let known = encoders()?;
    let has = |name: &str| known.iter().any(|k| k == name);
    if let Some(why) = obstacle {
        let encoder = ENCODERS.iter().map(|(name, _)| *name).find(|name| has(name));
        let encoder = encoder.with_context(|| format!("the video has to be encoded ({why}), and this ffmpeg has no encoder of H.264"))?;
        plan.notices.push(format!("{encoder} encodes the video: {why}"));
        plan.encoder = Some(encoder);
    }
    plan.sound = sound && has(OPUS);
    if sound && !plan.sound {
        plan.notices.push(format!("the sound is left out: this ffmpeg has no {OPUS}"));
    }
    Ok(plan)
}

/// The standard output of a command; `None` if the program is not installed.
fn printed(command: &mut Command) -> anyhow::Result<Option<Vec<u8>>> {
    let name = command.get_program().to_string_lossy().into_owned();
    match command.stdin(Stdio::null()).output() {
        Ok(output) if output.status.success() => Ok(Some(output.stdout)),
        Ok(output) => {
            let complaint = String::from_utf8_lossy(&output.stderr);
            bail!("{name} has failed ({}): {}", output.status, complaint.lines().last().unwrap_or_default())
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).with_context(|| format!("starting {name}")),
    }
}

fn probe(source: &str) -> anyhow::Result<Option<Probed>> {
    let entries = "stream=codec_type,codec_name,pix_fmt,field_order,has_b_frames,sample_aspect_ratio:stream_side_data=displaymatrix:frame_side_data=displaymatrix";
    let asked = ["-loglevel", "error", "-of", "json", "-show_entries", entries, "-read_intervals", "%+#20", "-i", source];
    let text = printed(Command::new("ffprobe").args(asked))?;
    text.map(|text| serde_json::from_slice(&text).context("the output of ffprobe")).transpose()
}

fn encoders() -> anyhow::Result<Vec<String>> {
    let text = printed(Command::new("ffmpeg").args(["-hide_banner", "-loglevel", "error", "-encoders"]))?;
    let text = text.context("ffmpeg is not installed")?;
    // ` V....D libx264              libx264 H.264 …`
    Ok(String::from_utf8_lossy(&text).lines().filter_map(|line| line.split_whitespace().nth(1)).map(str::to_owned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOUND_TOO: Wanted = Wanted { transcode: false, sound: true };

    fn probed(streams: &str) -> Probed {
        serde_json::from_str(&format!("{{\"streams\":[{streams}]}}")).unwrap_or_default()
    }

    fn h264(more: &str) -> String {
        format!(r#"{{"codec_type":"video","codec_name":"h264","pix_fmt":"yuv420p","field_order":"progressive"{more}}}"#)
    }

    const AUDIO: &str = r#"{"codec_type":"audio","codec_name":"aac"}"#;

    fn plan(streams: &str, wanted: Wanted, encoders: &[&str]) -> anyhow::Result<Plan> {
        let known = encoders.iter().map(|e| (*e).to_owned()).collect();
        decided(vec!["-i".into(), "x".into()], Some(&probed(streams)), wanted, || Ok(known))
    }

    fn args(plan: &Plan, port: Option<u16>) -> String {
        plan.command(port).get_args().map(|a| a.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn playable_video_is_copied_and_other_video_encoded_with_a_notice() {
        let upright = r#","has_b_frames":0,"sample_aspect_ratio":"1:1","side_data_list":[{"displaymatrix":"\n0: 65536 0 0\n1: 0 65536 0\n2: 0 0 1073741824\n"},{}]"#;
        let copied = plan(&h264(upright), SOUND_TOO, &[]).expect("a plan");
        assert!(args(&copied, None).contains("-c:v copy") && copied.notices.is_empty() && !copied.sound);
        let streams = [
            (h264(r#","has_b_frames":2"#), "B-frames"),
            (h264(r#","side_data_list":[{"displaymatrix":"\n0: 0 65536 0\n1: -65536 0 0\n2: 0 0 1073741824\n"}]"#), "rotated"),
            (h264(r#","side_data_list":[{"displaymatrix":"\n0: -65536 0 0\n1: 0 65536 0\n2: 0 0 1073741824\n"}]"#), "rotated"),
            (h264(r#","sample_aspect_ratio":"4:3""#), "square"),
            (r#"{"codec_type":"video","codec_name":"hevc","pix_fmt":"yuv420p"}"#.into(), "hevc"),
            (r#"{"codec_type":"video","codec_name":"h264","pix_fmt":"yuv422p10le"}"#.into(), "yuv422p10le"),
            (r#"{"codec_type":"video","codec_name":"h264","pix_fmt":"yuv420p","field_order":"tt"}"#.into(), "interlaced"),
        ];
        let within = format!(
            r#"{}],"frames":[{{"side_data_list":[{{"displaymatrix":"\n0: 0 65536 0\n1: -65536 0 0\n2: 0 0 1073741824\n"}}]}}"#,
            h264("")
        );
        assert!(plan(&within, SOUND_TOO, &["libx264"]).is_err_and(|e| e.to_string().contains("transpose")), "by the video itself");
        for (streams, why) in streams {
            let plan = plan(&streams, SOUND_TOO, &["aac", "libopenh264", "libx264"]).expect("a plan");
            let args = args(&plan, None);
            assert!(args.contains("-c:v libx264 -profile:v baseline") && args.contains("-bf 0"), "{args}");
            assert!(plan.notices.len() == 1 && plan.notices[0].contains(why), "{:?}", plan.notices);
        }
        let forced = plan(&h264(""), Wanted { transcode: true, sound: false }, &["libopenh264"]).expect("a plan");
        assert!(args(&forced, None).contains("-c:v libopenh264"));
        let none = plan(&h264(r#","has_b_frames":1"#), SOUND_TOO, &["aac"]).expect_err("no encoder");
        assert!(none.to_string().contains("no encoder of H.264"), "{none}");
        assert!(plan(AUDIO, SOUND_TOO, &["libx264", OPUS]).is_err_and(|e| e.to_string().contains("no video")));
    }

    #[test]
    fn sound_is_read_if_present_wanted_and_encodable() {
        let both = format!("{},{AUDIO}", h264(""));
        let with = plan(&both, SOUND_TOO, &[OPUS]).expect("a plan");
        assert!(
            with.sound && args(&with, Some(4000)).ends_with("-f rtp rtp://127.0.0.1:4000?rtcpport=4000"),
            "{}",
            args(&with, Some(4000))
        );
        assert!(!args(&with, None).contains("rtp"));
        assert!(!plan(&both, Wanted::default(), &[OPUS]).expect("a plan").sound);
        let without = plan(&both, SOUND_TOO, &["libx264"]).expect("a plan");
        assert!(!without.sound && without.notices[0].contains(OPUS));
        // without ffprobe
        let blind = decided(vec![], None, SOUND_TOO, || Ok(vec![])).expect("a plan");
        assert!(!blind.sound && blind.encoder.is_none() && blind.notices.len() == 1);
    }

    #[test]
    fn cameras_have_the_system_s_names_and_files_play_in_real_time() {
        let line = |origin, system| input(origin, system).map(|args| args.join(" ")).map_err(|e| e.to_string());
        assert_eq!(line(Origin::Camera(None), "linux").as_deref(), Ok("-f v4l2 -i /dev/video0"));
        assert_eq!(line(Origin::Camera(Some("/dev/video2")), "linux").as_deref(), Ok("-f v4l2 -i /dev/video2"));
        assert_eq!(line(Origin::Camera(None), "macos").as_deref(), Ok("-f avfoundation -framerate 30 -i 0:none"));
        assert_eq!(line(Origin::Camera(Some("USB")), "windows").as_deref(), Ok("-f dshow -i video=USB"));
        assert!(line(Origin::Camera(None), "windows").is_err() && line(Origin::Camera(None), "plan9").is_err());
        assert_eq!(line(Origin::Address("film.mp4"), "linux").as_deref(), Ok("-re -i film.mp4"));
        assert_eq!(line(Origin::Address("rtsp://camera/1"), "linux").as_deref(), Ok("-i rtsp://camera/1"));
        // it may be a file
        assert_eq!(line(Origin::Address("http://camera/1"), "linux").as_deref(), Ok("-re -i http://camera/1"));
    }
}
