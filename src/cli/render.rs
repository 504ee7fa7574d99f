//! `tmpi render`.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::Context;
use serde_json::json;

use super::flags::{fov_x, numbers, quality, size};
use super::{Usage, files, note, result_as};
use tmpi_core::{Camera, Intrinsics, Pose, Scene, ViewBox, container};
use tmpi_render::{
    self, Animation, AnimationFormat, Arrangement, Backend, EYE_DISTANCE, MAX_PIXELS, MAX_SIDE, MotionRange, PictureFormat, Rig,
    StereoLayout,
};

/// Render a view of a container from another position
#[derive(Clone, Debug, clap::Args)]
pub(super) struct RenderArgs {
    /// The container
    #[arg(value_name = "IN.tmpi")]
    input: PathBuf,
    /// Image to write: PNG and WebP with alpha, JPEG over black, MPO with --stereo sbs. With --path: an animated WebP or an MP4 film, both by ffmpeg, or numbered
    /// PNG or JPEG frames
    #[arg(short, long, value_name = "OUT.{png,jpg,webp,mpo,mp4}")]
    output: PathBuf,
    /// Position of the camera (right, down, forward, in units of the nearest distance) and its direction (degrees)
    #[arg(long, value_parser = pose, allow_hyphen_values = true, default_value = "0,0,0", value_name = "TX,TY,TZ[,YAW,PITCH,ROLL]")]
    pose: Pose,
    /// Image size; default: the photo's
    #[arg(long, value_parser = size, value_name = "WxH")]
    size: Option<(u32, u32)>,
    /// Horizontal field of view in degrees; default: the photo's
    #[arg(long, value_parser = fov_x, value_name = "DEG")]
    fov_x: Option<f64>,
    /// Renderer
    #[arg(long, value_enum, default_value_t, value_name = "HOST")]
    backend: Backend,
    /// Render the views of two eyes into one picture; --size is that of a view
    #[arg(long, value_enum, group = "arrangement", value_name = "LAYOUT")]
    stereo: Option<StereoLayout>,
    /// With --stereo or --quilt: distance of the first camera from the last, in units of the nearest distance. Default: 1/30 for --stereo
    #[arg(long, value_parser = ipd, requires = "arrangement", allow_hyphen_values = true, value_name = "DISTANCE")]
    ipd: Option<f64>,
    /// Render a quilt for light-field displays: views from left to right, by default over the width of the view box, at most 0.06; --size
    /// is that of a view
    #[arg(long, value_parser = Arrangement::quilt, group = "arrangement", value_name = "COLUMNSxROWS")]
    quilt: Option<Arrangement>,
    /// With --stereo or --quilt: disparity at the depth of the screen; nearer things stand before it. Default: the median over the photo's
    /// area, as in the viewer
    #[arg(long, value_parser = focus, requires = "arrangement", value_name = "DISPARITY")]
    focus: Option<f64>,
    /// Move the camera along a loop, as far as viewers move on their own
    #[arg(long, value_enum, value_name = "PATH")]
    path: Option<tmpi_render::Path>,
    /// Number of frames; a film has 30 a second
    #[arg(long, requires = "path", value_parser = clap::value_parser!(u32).range(1..=10_000), default_value_t = 60, value_name = "N")]
    frames: u32,
    /// Quality of a JPEG or of an animation, 1 to 100
    #[arg(long, value_parser = quality, default_value = "90", value_name = "1-100")]
    quality: u8,
    /// Print a line of JSON for each image
    #[arg(long)]
    json: bool,
}

fn pose(text: &str) -> Result<Pose, String> {
    let all = numbers(text)?;
    if !(3..=6).contains(&all.len()) {
        return Err("expected three to six numbers".into());
    }
    let at = |i: usize| all.get(i).copied().unwrap_or(0.0);
    Ok(Pose { tx: at(0), ty: at(1), tz: at(2), yaw: at(3), pitch: at(4), roll: at(5) })
}

fn ipd(text: &str) -> Result<f64, String> {
    match numbers(text)?.as_slice() {
        &[v] if v > 0.0 && v <= 10.0 => Ok(v),
        _ => Err("it must be above 0 and at most 10".into()),
    }
}

pub(super) fn run(args: &RenderArgs) -> anyhow::Result<()> {
    let ending = files::extension(&args.output);
    let film = AnimationFormat::from_extension(&ending).filter(|_| args.path.is_some());
    let endings = if args.path.is_some() { ".png, .jpg, .jpeg, .webp or .mp4" } else { ".png, .jpg, .jpeg, .webp or .mpo" };
    let format = PictureFormat::from_extension(&ending).or(film.map(|_| PictureFormat::default()));
    // a film needs --path
    let film_alone =
        args.path.is_none() && PictureFormat::from_extension(&ending).is_none() && AnimationFormat::from_extension(&ending).is_some();
    let hint = if film_alone { format!("; for a film give --path {}", tmpi_render::Path::NAMES.join("|")) } else { String::new() };
    let format = format.ok_or_else(|| Usage(format!("--output {} must end in {endings}{hint}", args.output.display())))?;
    if format == PictureFormat::Mpo && (args.stereo != Some(StereoLayout::SideBySide) || args.path.is_some()) {
        return Err(Usage(format!("--output {}: .mpo requires --stereo sbs", args.output.display())).into());
    }
    let bytes = files::read(&args.input)?;
    let scene = Arc::new(container::decode(&bytes).with_context(|| args.input.display().to_string())?);
    let (width, height) = args.size.unwrap_or((scene.grid.width, scene.grid.height));
    let rig = rig(args, &scene);
    let (whole_width, whole_height) = rig.map_or((width, height), |r| r.arrangement.size((width, height)));
    if whole_width > MAX_SIDE || whole_height > MAX_SIDE || u64::from(whole_width) * u64::from(whole_height) > MAX_PIXELS {
        let views = rig.map_or(1, |r| r.arrangement.views());
        let problem = format!("{views} views of {width}×{height} are more than {MAX_SIDE} a side or {MAX_PIXELS} pixels together");
        return Err(Usage(format!("{problem}: give a smaller --size")).into());
    }
    let intrinsics = match args.fov_x {
        Some(fov) => Intrinsics::from_fov_x(width, height, fov),
        None => scene.intrinsics.resized((scene.grid.width, scene.grid.height), (width, height)),
    };
    let camera = Camera { pose: args.pose, intrinsics, width, height };
    let renderer = tmpi_render::select(args.backend)?;
    let name = renderer.name();
    let frames = args.path.map_or(1, |_| args.frames);
    let range = MotionRange::of(&scene);
    let mut film = film.map(|format| Animation::start(format, (whole_width, whole_height), args.quality)).transpose()?;
    let begun = Instant::now();
    let camera_of = |frame: u32| args.path.map_or(camera, |path| path.camera(&camera, frame, frames, &range));
    let is_outside = |frame: u32| is_outside(&scene.view_box, &camera_of(frame).pose, rig.as_ref());
    if (0..frames).any(is_outside) {
        let ViewBox { x, y, z } = scene.view_box;
        let what = "the picture may have holes and torn edges";
        note(&format!("tmpi: the camera is outside the view box, ±{x} right, ±{y} down, ±{z} forward: {what}"));
    }
    for frame in 0..frames {
        let start = Instant::now();
        let camera = camera_of(frame);
        let output = args.path.map_or_else(|| args.output.clone(), |_| numbered(&args.output, frame + 1, frames));
        let view = match &rig {
            Some(rig) => tmpi_render::draw_multiview(renderer.as_ref(), &scene, &camera, rig)?,
            None => renderer.render(&scene, &camera)?,
        };
        let ms = start.elapsed().as_secs_f64() * 1e3;
        if let Some(film) = &mut film {
            film.push(&view)?;
            continue;
        }
        files::write(&output, &tmpi_render::encode(&view, format, args.quality)?)?;
        let (w, h, outside) = (view.width, view.height, is_outside(frame));
        let about = json!({
            "output": output, "width": w, "height": h, "backend": name, "pose": camera.pose, "outside_view_box": outside, "ms": ms,
        });
        result_as(args.json, &about, &format!("{}: {w}×{h}, {name} in {ms:.1} ms", output.display()))?;
    }
    if let Some(film) = film {
        files::write(&args.output, &film.finish()?)?;
        let ms = begun.elapsed().as_secs_f64() * 1e3;
        let about =
            json!({ "output": args.output, "width": whole_width, "height": whole_height, "backend": name, "frames": frames, "ms": ms });
        let text = format!("{}: {whole_width}×{whole_height}, {frames} frames, {name} in {ms:.0} ms", args.output.display());
        result_as(args.json, &about, &text)?;
    }
    Ok(())
}

fn focus(text: &str) -> Result<f64, String> {
    match numbers(text)?.as_slice() {
        &[v] if (0.0..=2.0).contains(&v) => Ok(v),
        _ => Err("it must be from 0 to 2".into()),
    }
}

/// Whether one of the cameras is outside the view box.
fn is_outside(view_box: &ViewBox, pose: &Pose, rig: Option<&Rig>) -> bool {
    let reach = rig.map_or(0.0, |rig| rig.baseline / 2.0);
    [-reach, reach].iter().any(|&shift| !tmpi_render::contains_pose(view_box, &pose.shifted([shift, 0.0, 0.0])))
}

/// The cameras of `--stereo` or `--quilt`.
fn rig(args: &RenderArgs, scene: &Scene) -> Option<Rig> {
    let (arrangement, usual) = match (args.quilt, args.stereo) {
        (Some(quilt), _) => (quilt, (2.0 * scene.view_box.x).min(MotionRange::TRAVEL)),
        (None, Some(layout)) => (Arrangement::Stereo(layout), EYE_DISTANCE),
        (None, None) => return None,
    };
    let baseline = args.ipd.unwrap_or(usual);
    Some(Rig { arrangement, baseline, focus: args.focus.unwrap_or_else(|| MotionRange::of(scene).pivot) })
}

/// `name-0001.png`, with as many digits as all frames need, at least four.
fn numbered(path: &Path, frame: u32, frames: u32) -> PathBuf {
    let digits = frames.to_string().len().max(4);
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    path.with_file_name(format!("{stem}-{frame:0digits$}.{}", path.extension().unwrap_or_default().to_string_lossy()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_have_three_to_six_finite_numbers() {
        assert_eq!(pose("-0.1,0,0.2").unwrap(), Pose::at(-0.1, 0.0, 0.2));
        assert!((pose("0,0,0,10,-5,3").unwrap().pitch + 5.0).abs() < 1e-12);
        for bad in ["", "1,2", "1,2,3,4,5,6,7", "nan,0,0", "0,inf,0", "a,b,c"] {
            assert!(pose(bad).is_err(), "{bad}");
        }
        assert!(ipd("0.06").is_ok() && ipd("0").is_err() && ipd("-1").is_err() && ipd("nan").is_err());
    }

    #[test]
    fn frames_are_numbered_in_order() {
        assert_eq!(numbered(Path::new("a/b.c.png"), 7, 60), Path::new("a/b.c-0007.png"));
        assert_eq!(numbered(Path::new("v.jpg"), 10_000, 10_000), Path::new("v-10000.jpg"));
    }
}
