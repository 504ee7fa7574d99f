#![allow(clippy::unwrap_used, reason = "test")]

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use tmpi_core::live::{TileState, schema};
use tmpi_pipeline::depth::{DepthError, Estimate, Estimator};
use tmpi_pipeline::run::stages::snap_to_video;

use super::depth::snap_part;
use super::*;

/// Derives disparity from brightness, with another scale and shift in each run, like networks.
#[derive(Default)]
struct Bright {
    runs: AtomicU32,
}

impl Estimator for Bright {
    fn name(&self) -> &'static str {
        "bright"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        let run = self.runs.fetch_add(1, Ordering::Relaxed);
        let (scale, shift) = (1.0 - 0.1 * (run % 4) as f32, 0.05 * (run % 3) as f32);
        let delta = photo.rgb.iter().map(|p| scale * f32::from(p[0]) / 255.0 + shift).collect();
        Ok(DisparityMap { width: photo.width, height: photo.height, delta })
    }
}

/// Settings without a cooldown.
fn without_cooldown() -> Settings {
    Settings { cooldown: Duration::ZERO, ..Settings::default() }
}

fn room(settings: Settings) -> (Arc<Bright>, FramePipeline) {
    let depth = Arc::new(Bright::default());
    (Arc::clone(&depth), FramePipeline::new(Models { depth, theta: None, psi: None }, settings))
}

/// A square at `x` in front of a wall that gets nearer to the right.
fn frame(number: u64, x: u32) -> Frame {
    let (width, height) = (240, 136);
    let pixel = |u: u32, v: u32| if (x..x + 40).contains(&u) && (40..100).contains(&v) { 200 } else { 40 + (u / 4) as u8 };
    let photo = Photo::from_fn(width, height, |u, v| [pixel(u, v); 3]);
    Frame { number, at: Duration::from_millis(33 * number), photo, depth: None }
}

#[test]
fn a_still_scene_costs_nothing() {
    let (depth, mut room) = room(Settings::default());
    let first = room.next(&frame(0, 60)).unwrap();
    assert!(first.cut && first.sent.len() == 15 && first.chunks.len() == 1 && first.waiting == 0);
    for n in 1..5 {
        let update = room.next(&frame(n, 60)).unwrap();
        assert!(update.changed.is_empty() && update.chunks.is_empty());
        assert_eq!(update.stages.len(), 1, "only the comparison runs");
    }
    assert_eq!(depth.runs.load(Ordering::Relaxed), 1);
}

#[test]
fn a_reader_of_all_chunks_matches_the_room() {
    let (_, mut room) = room(without_cooldown());
    room.next(&frame(0, 20)).unwrap();
    let mut reader = TileState::new(&TileState::hello(room.geometry().unwrap())).unwrap();
    reader.take(&schema::Geometry { frame: 0, chunks: room.snapshot(0).unwrap().into_iter().collect() }).unwrap();
    for n in 1..12 {
        let before = room.geometry().unwrap().tiles.clone();
        let update = room.next(&frame(n, 20 + 6 * n as u32)).unwrap();
        assert!(!update.cut && update.changed.len() < 15);
        for t in (0..15).filter(|t| !update.changed.contains(t)) {
            assert_eq!(before[t as usize], room.geometry().unwrap().tiles[t as usize], "tile {t} of frame {n}");
        }
        assert!(update.sent.iter().all(|t| update.changed.contains(t)));
        reader.take(&schema::Geometry { frame: n, chunks: update.chunks }).unwrap();
        assert_eq!(reader.geometry(), room.geometry());
    }
}

#[test]
fn a_change_of_the_networks_scale_does_not_move_depth() {
    let (_, mut room) = room(without_cooldown());
    let shown = |room: &FramePipeline, x: u32| {
        let g = room.geometry().unwrap();
        // tile 6 has its upper left corner at (56, 56)
        g.tiles[6].disparities(&g.grid, 6)[(70 - 56) * 64 + (x - 56) as usize]
    };
    room.next(&frame(0, 70)).unwrap();
    let first = shown(&room, 75);
    for n in 1..8 {
        room.next(&frame(n, 70 - n as u32)).unwrap();
        let now = shown(&room, 75);
        // planes are kept within 1.5 × 0.064; the network's own scale would move them by 0.23
        assert!((now - first).abs() < 0.1, "frame {n}: {now}, expected {first}");
    }
}

#[test]
fn after_a_cut_a_room_equals_a_new_one() {
    let (_, mut room) = self::room(Settings::default());
    room.next(&frame(0, 60)).unwrap();
    let mut other = frame(1, 60);
    other.photo.rgb.iter_mut().for_each(|p| *p = p.map(|v| 255 - v));
    let update = room.next(&other).unwrap();
    assert!(update.cut && update.sent.len() == 15);
    // with the network's scale and shift of the second run
    let (depth, mut fresh) = self::room(Settings::default());
    depth.runs.store(1, Ordering::Relaxed);
    fresh.next(&other).unwrap();
    assert!(room.geometry() == fresh.geometry());
}

#[test]
fn readers_get_every_tile_at_a_cut_over_budget() {
    let (_, mut room) = room(Settings { frame_ms: 1e-3, ..without_cooldown() });
    // one corner tile is the same in both scenes
    let scene = |number: u64, by: u8| {
        let mut frame = frame(number, 60);
        let width = frame.photo.width as usize;
        let corner = |i: usize| i % width < 64 && i / width < 64;
        frame.photo.rgb.iter_mut().enumerate().filter(|(i, _)| !corner(*i)).for_each(|(_, p)| *p = p.map(|v| v.wrapping_add(by)));
        frame
    };
    let first = room.next(&scene(0, 0)).unwrap();
    assert!(first.cut && first.sent.len() == 15);
    let mut reader = TileState::new(&TileState::hello(room.geometry().unwrap())).unwrap();
    reader.take(&schema::Geometry { frame: 0, chunks: first.chunks }).unwrap();
    for n in 1..4 {
        let update = room.next(&scene(n, 128)).unwrap();
        assert_eq!((update.cut, update.sent.len() == 15), (n == 1, n == 1));
        assert!(n > 1 || update.coarse > 0, "all within the budget");
        reader.take(&schema::Geometry { frame: n, chunks: update.chunks }).unwrap();
        assert_eq!(reader.geometry(), room.geometry(), "frame {n}");
    }
}

#[test]
fn changed_tiles_over_budget_go_together() {
    let (_, mut room) = room(Settings { frame_ms: 1e-3, ..Settings::default() });
    for number in 0..10 {
        let update = room.next(&walls(number, 0.05 * number as f32)).unwrap();
        assert!(update.waiting == 0 && update.sent.len() > 1, "frame {number}: {} wait, {:?} sent", update.waiting, update.sent);
        assert!(number == 0 || update.coarse > 0, "frame {number} is within the budget");
    }
}

#[test]
fn an_ample_budget_equals_no_budget() {
    let (_, mut free) = room(without_cooldown());
    let (_, mut ample) = room(Settings { frame_ms: 1e12, ..without_cooldown() });
    for n in 0..8 {
        let frame = frame(n, 60 + 9 * n as u32);
        let (a, b) = (free.next(&frame).unwrap(), ample.next(&frame).unwrap());
        assert_eq!((a.changed, a.sent, a.kept, a.chunks), (b.changed, b.sent, b.kept, b.chunks), "frame {n}");
        assert_eq!((b.waiting, b.coarse), (0, 0));
        assert_eq!(free.geometry(), ample.geometry());
    }
}

/// [`Bright`] with a choice of input sizes, which it records.
#[derive(Default)]
struct Choice {
    bright: Bright,
    ran: std::sync::Mutex<Vec<(u32, u32)>>,
}

impl Estimator for Choice {
    fn name(&self) -> &'static str {
        "choice"
    }

    fn estimate(&self, photo: &Photo) -> Result<DisparityMap, DepthError> {
        self.bright.estimate(photo)
    }

    fn sizes(&self, width: u32, height: u32) -> Vec<(u32, u32)> {
        vec![(width, height), (width / 2, height / 2), (width / 4, height / 4)]
    }

    fn estimate_at(&self, photo: &Photo, size: (u32, u32)) -> Result<Estimate, DepthError> {
        self.ran.lock().unwrap().push(size);
        Ok(Estimate { network_ms: 1e-3, ..self.estimate(photo)?.into() })
    }
}

#[test]
fn late_depth_runs_at_a_smaller_size() {
    let mut other = frame(1, 60);
    other.photo.rgb.iter_mut().for_each(|p| *p = p.map(|v| 255 - v));
    for (frame_ms, then) in [(1e-6, (60, 34)), (0.0, (240, 136))] {
        let depth = Arc::new(Choice::default());
        let models = Models { depth: Arc::<Choice>::clone(&depth), theta: None, psi: None };
        let mut room = FramePipeline::new(models, Settings { frame_ms, ..Settings::default() });
        assert_eq!(room.next(&frame(0, 60)).unwrap().depth_size, Some((240, 136)), "no cost has been measured yet");
        assert_eq!(room.next(&other).unwrap().depth_size, Some(then), "a new scene does not wait");
        assert_eq!(*depth.ran.lock().unwrap(), [(240, 136), then]);
    }
}

#[test]
fn coarse_tiles_get_more_planes_when_there_is_time() {
    let (_, mut room) = room(Settings::default());
    // two planes for each of 15 tiles take 45e6 ms, three 60e6
    room.budget = Budget::new(59e6);
    (0..2).for_each(|_| room.budget.tiles_took(&[6; 10], true, 70e6));
    let with = |number| {
        let mut f = frame(number, 60);
        let delta = (0..f.photo.rgb.len()).map(|i| [0.1, 0.4, 0.7, 0.95, 0.2][(i % 240 / 15).min(4)]).collect();
        f.depth = Some(DisparityMap { width: 240, height: 136, delta });
        f
    };
    let planes = |room: &FramePipeline| room.geometry().unwrap().tiles[0].planes.len();
    let first = room.next(&with(0)).unwrap();
    assert!(first.waiting == 0 && first.coarse > 0 && planes(&room) == 2, "{} wait, {} coarse", first.waiting, first.coarse);
    // real measurements lower the costs
    let second = room.next(&with(1)).unwrap();
    assert!(second.changed.is_empty() && second.coarse == 0 && second.sent.contains(&0), "{:?}", second.sent);
    assert!(planes(&room) > 2);
    assert!(room.next(&with(2)).unwrap().sent.is_empty());
}

#[test]
fn a_change_of_measured_depth_alone_is_sent() {
    let (depth, mut room) = room(Settings::default());
    let with = |number, near: f32| {
        let mut f = frame(number, 60);
        let delta = (0..f.photo.rgb.len()).map(|i| if i % 240 < 56 { near } else { 0.3 }).collect();
        f.depth = Some(DisparityMap { width: 240, height: 136, delta });
        f
    };
    room.next(&with(0, 0.3)).unwrap();
    assert!(room.next(&with(1, 0.3)).unwrap().sent.is_empty());
    let update = room.next(&with(2, 0.9)).unwrap();
    assert!(update.changed.is_empty() && update.sent.contains(&0) && !update.sent.contains(&4), "{:?}", update.sent);
    assert_eq!(depth.runs.load(Ordering::Relaxed), 0);
    let mut wrong = with(3, 0.9);
    wrong.depth.as_mut().unwrap().width = 120;
    assert!(matches!(room.next(&wrong), Err(GeometryError::Depth(120, 136, 240, 136))));
}

#[test]
fn snapping_a_part_equals_snapping_the_whole() {
    let frame = frame(0, 60);
    let (width, height) = (frame.photo.width, frame.photo.height);
    // ramps of seven pixels at the photo's edges
    let near = |x: u32| (f64::from(x.clamp(56, 63) - 56) / 7.0) as f32;
    let delta: Vec<f32> = (0..width * height).map(|i| 0.2 + 0.6 * near(i % width)).collect();
    let map = || WeightedDisparity { delta: DisparityMap { width, height, delta: delta.clone() }, confidence: None, given: false };
    let (models, limits, options) =
        (Models { depth: Arc::new(Bright::default()), theta: None, psi: None }, Limits::default(), Options::default());
    let mut job = Context::new(&models, &limits, &options, &Silent);
    let whole = snap_to_video(&mut job, &frame.photo, map()).unwrap().delta;
    assert_ne!(whole.delta, delta);
    for part in [Rect { x: 48, y: 0, w: 24, h: 136 }, Rect { x: 0, y: 40, w: 64, h: 16 }, Rect { x: 56, y: 120, w: 184, h: 16 }] {
        let found = snap_part(&mut job, &frame.photo, map(), part).unwrap().delta;
        for i in 0..width * height {
            let (x, y) = (i % width, i / width);
            let inside = (part.x..part.x + part.w).contains(&x) && (part.y..part.y + part.h).contains(&y);
            let should = if inside { whole.delta[i as usize] } else { delta[i as usize] };
            assert_eq!(found.delta[i as usize].to_bits(), should.to_bits(), "({x}, {y}) of {part:?}");
        }
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(12))]

    /// Measured depth drifts, jumps and flickers. At each frame, a reader of the chunks has the room's geometry, and no tile differs by
    /// more than the tolerance from the planes fitted to this frame: omitted changes do not accumulate.
    #[test]
    fn unsent_changes_stay_within_the_tolerance(steps in proptest::collection::vec((-0.02f32..0.02, -0.02f32..0.02, 0u32..4), 2..14)) {
        let (_, mut room) = room(without_cooldown());
        let (mut wall, mut slope, mut reader) = (0.3f32, 0.1f32, None::<TileState>);
        let mut before = None::<core::Geometry>;
        for (n, (dw, ds, edge)) in (0u64..).zip(steps) {
            (wall, slope) = (wall + dw, slope + ds);
            // the picture changes too, so that all tiles get new planes
            let mut frame = frame(n, 60);
            frame.photo.rgb.iter_mut().for_each(|p| *p = [(n * 90 % 200) as u8; 3]);
            let delta = |x: u32| if x < 100 + edge { wall } else { 0.6 + slope * x as f32 / 240.0 };
            frame.depth = Some(DisparityMap { width: 240, height: 136, delta: (0..240 * 136).map(|i| delta(i % 240)).collect() });
            let update = room.next(&frame).unwrap();
            let now = room.geometry().unwrap();
            let model = reader.get_or_insert_with(|| TileState::new(&TileState::hello(now)).unwrap());
            model.take(&schema::Geometry { frame: n, chunks: update.chunks.clone() }).unwrap();
            proptest::prop_assert_eq!(model.geometry(), Some(now));
            proptest::prop_assert!(update.kept_error <= PARALLAX, "{} px", update.kept_error);
            if let Some(before) = before.take().filter(|_| !update.cut) {
                for t in 0..now.tiles.len() as u32 {
                    let same = now.tiles[t as usize] == before.tiles[t as usize];
                    proptest::prop_assert_eq!(same, !update.sent.contains(&t), "tile {}", t);
                }
                // error against the measured depth, in pixels at the border of the view box: planes may be off by half a pixel and are
                // kept up to one and a half times that; omitted changes add a quarter
                let all = Rect { x: 0, y: 0, w: 240, h: 136 };
                let (x, y) = now.view_box.parallax(&now.intrinsics, all);
                let off = (0..now.grid.tiles()).flat_map(|t| {
                    let r = now.grid.rect(t);
                    let shown = now.tiles[t as usize].disparities(&now.grid, t);
                    (0..r.area()).map(move |i| (r.x + i as u32 % r.w, shown[i])).collect::<Vec<_>>()
                });
                // skip the edge, where labels are smoothed
                let flat = off.filter(|(x, _)| !(92..112).contains(x)).map(|(x, d)| f64::from((d - delta(x)).abs()));
                let most = flat.fold(0.0, f64::max) * x.max(y);
                proptest::prop_assert!(most <= 0.75 + PARALLAX + 0.05, "{} px", most);
            }
            before = Some(now.clone());
        }
    }
}

/// A near wall in front of a far one, which is `by` nearer than at first. The picture changes with each number.
fn walls(number: u64, by: f32) -> Frame {
    let mut f = frame(number, 60);
    // the same colours, so that it is not a cut
    (0..).zip(&mut f.photo.rgb).for_each(|(i, p)| *p = [60 + 30 * ((i / 240 + i % 240 + number) % 2) as u8; 3]);
    let delta = |x: u32| if (50..120).contains(&x) { 0.8 } else { 0.3 + by };
    f.depth = Some(DisparityMap { width: 240, height: 136, delta: (0..240 * 136).map(|i| delta(i % 240)).collect() });
    f
}

#[test]
fn small_moves_are_kept_until_they_add_up() {
    let (_, mut room) = room(without_cooldown());
    room.next(&walls(0, 0.0)).unwrap();
    let first = room.geometry().unwrap().clone();
    let update = room.next(&walls(1, 0.004)).unwrap();
    // the background behind the near wall moves by a tenth of a pixel
    assert!(update.sent.is_empty() && !update.kept.is_empty(), "{:?} sent, {:?} kept", update.sent, update.kept);
    assert!(update.kept_error > 0.0 && update.kept_error <= PARALLAX && update.chunks.is_empty());
    assert_eq!(room.geometry(), Some(&first));
    let sent: usize = (2..40).map(|n| room.next(&walls(n, 0.004 * n as f32)).unwrap().sent.len()).sum();
    assert!(sent > 0, "slow motion is eventually sent");
    // without a tolerance it is sent at once
    let (_, mut room) = self::room(Settings { parallax: 0.0, ..without_cooldown() });
    room.next(&walls(0, 0.0)).unwrap();
    let update = room.next(&walls(1, 0.004)).unwrap();
    assert!(!update.sent.is_empty() && update.kept.is_empty());
}

#[test]
fn measured_depth_has_no_cooldown() {
    let (_, mut room) = room(Settings::default());
    let sent: Vec<usize> = (0..4).map(|n| room.next(&walls(n, 0.1 * n as f32)).unwrap().sent.len()).collect();
    assert!(sent.iter().all(|s| *s > 0), "{sent:?}");
}

#[test]
fn changes_during_the_cooldown_are_sent_after_it() {
    let (depth, mut room) = room(Settings::default());
    room.next(&frame(0, 60)).unwrap();
    let runs = || depth.runs.load(Ordering::Relaxed);
    assert_eq!(runs(), 1);
    // 33 and 66 ms after the first frame
    for n in [1, 2] {
        let update = room.next(&frame(n, 90)).unwrap();
        assert!(update.sent.is_empty() && update.waiting == 6 && runs() == 1, "frame {n}: {} wait", update.waiting);
    }
    let now = room.next(&frame(3, 90)).unwrap();
    assert!(now.changed.is_empty() && !now.sent.is_empty() && now.waiting == 0 && runs() == 2);
    // a cut does not wait
    let mut other = frame(4, 90);
    other.photo.rgb.iter_mut().for_each(|p| *p = p.map(|v| 255 - v));
    assert_eq!(room.next(&other).unwrap().sent.len(), 15);
}

#[test]
fn slow_frames_and_clock_steps_cause_no_cooldown() {
    let (_, mut room) = room(Settings::default());
    for (n, ms) in [1_000, 1_080, 500, 590].into_iter().enumerate() {
        let update = room.next(&Frame { at: Duration::from_millis(ms), ..frame(n as u64, 60 + 10 * n as u32) }).unwrap();
        assert!(!update.sent.is_empty(), "at {ms} ms");
    }
}
