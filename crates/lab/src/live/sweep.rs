//! Measures each sequence at several sizes, bit rates and budgets: error against run time and bytes.

use std::fmt::Write;

use serde::Serialize;

use super::{Figures, LiveBenchError, Settings, run};
use crate::bench::{Axis, Curve, Experiment, Machine, Point as Plotted, Results};

/// Settings of a point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct OperatingPoint {
    /// Size of the frames.
    pub size: (u32, u32),
    /// H.264 bits per second; `None`: JPEG frames.
    pub bitrate: Option<u32>,
    /// Milliseconds that the geometry of a frame may take; 0: no limit.
    pub budget_ms: f64,
}

/// A sequence at one operating point.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    /// The operating point.
    #[serde(flatten)]
    pub at: OperatingPoint,
    /// Results.
    #[serde(flatten)]
    pub figures: Figures,
}

/// All sequences at all operating points.
#[derive(Clone, Debug, Serialize)]
pub struct Points {
    /// The machine.
    pub machine: Machine,
    /// Frames per sequence.
    pub frames: u32,
    /// Results of all sequences for each point, in the given order of points.
    pub points: Vec<Point>,
    /// Skipped sequences, each with the reason.
    pub skipped: Vec<String>,
    /// Total time in seconds.
    pub seconds: f64,
}

/// Measures all sequences at each point, and calls `progress` for each. Writes no pictures or streams.
///
/// # Errors
/// [`LiveBenchError`].
pub fn measure(settings: &Settings, at: &[OperatingPoint], progress: &dyn Fn(&str)) -> Result<Points, LiveBenchError> {
    let start = std::time::Instant::now();
    let (mut points, mut skipped) = (Vec::new(), Vec::new());
    for &at in at {
        let settings = Settings { size: at.size, bitrate: at.bitrate, frame_ms: at.budget_ms, files: None, ..settings.clone() };
        let results = run(&settings, &|what| progress(&format!("{what}, {at}")))?;
        points.extend(results.rows.into_iter().map(|figures| Point { at, figures }));
        skipped = results.skipped;
    }
    Ok(Points { machine: Machine::this(), frames: settings.frames, points, skipped, seconds: start.elapsed().as_secs_f64() })
}

impl std::fmt::Display for OperatingPoint {
    /// Formats the point as command-line options.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "--size {}x{}", self.size.0, self.size.1)?;
        match self.bitrate {
            Some(bitrate) => write!(f, " --bitrate {bitrate}")?,
            None => write!(f, " --codec jpeg")?,
        }
        if self.budget_ms > 0.0 { write!(f, " --budget-ms {}", self.budget_ms) } else { Ok(()) }
    }
}

/// Column of the table: name, width, and contents.
type Column = (&'static str, usize, fn(&Point) -> String);
const COLUMNS: [Column; 14] = [
    ("sequence", 20, |p| p.figures.sequence.into()),
    ("size", 11, |p| format!("{}x{}", p.at.size.0, p.at.size.1)),
    ("target kbit/s", 14, |p| p.at.bitrate.map_or_else(|| "jpeg".into(), |b| format!("{}", b / 1000))),
    ("budget ms", 10, |p| if p.at.budget_ms > 0.0 { p.at.budget_ms.to_string() } else { "none".into() }),
    ("server ms", 10, |p| format!("{:.1}", p.figures.server_ms)),
    ("p95", 7, |p| format!("{:.1}", p.figures.server_ms_p95)),
    ("PSNR", 7, |p| format!("{:.2}", p.figures.psnr)),
    ("SSIM", 7, |p| format!("{:.3}", p.figures.ssim)),
    ("flicker", 8, |p| format!("{:.3}", p.figures.flicker)),
    ("kbit/s", 7, |p| format!("{:.0}", p.figures.kbit_s)),
    ("geometry", 9, |p| format!("{:.1} %", 100.0 * p.figures.geometry_share)),
    ("unsent", 9, |p| format!("{:.1} %", 100.0 * p.figures.left_out)),
    ("late", 7, |p| format!("{:.1} %", 100.0 * (p.figures.waiting + p.figures.coarse))),
    ("depth px", 9, |p| format!("{:.0}", p.figures.depth_pixels)),
];

impl Points {
    /// The results as a text table, with a line for each point and sequence.
    #[must_use]
    pub fn table(&self) -> String {
        let mut out = format!("{} frames per sequence; PSNR in dB, SSIM and flicker (levels) of the side view\n", self.frames);
        let mut line = |of: &dyn Fn(&Column) -> String| {
            for (i, column) in COLUMNS.iter().enumerate() {
                let width = column.1;
                // writing to a String cannot fail
                let _ = if i == 0 { write!(out, "{:<width$}", of(column)) } else { write!(out, "{:>width$}", of(column)) };
            }
            out.push('\n');
        };
        line(&|c| c.0.into());
        for p in &self.points {
            line(&|c| c.2(p));
        }
        out
    }

    /// The results as a page with plots of error against run time and bytes.
    #[must_use]
    pub fn page(&self) -> String {
        let about = "Side views against the truth; means over the frames of one run of each sequence.";
        let time = Axis { label: "server, ms per frame", log: true, up: Some(false) };
        let bytes = Axis { label: "video, geometry and sound, kbit/s", log: true, up: Some(false) };
        let plot = |id, title: &str, x, of: fn(&Figures) -> f64| {
            let y = Axis { label: "PSNR, dB", log: false, up: Some(true) };
            let mut e = Experiment { id, title: title.into(), about: about.into(), x, y, curves: self.curves(of) };
            e.mark();
            e
        };
        crate::bench::html(&Results {
            version: env!("CARGO_PKG_VERSION"),
            machine: self.machine.clone(),
            subjects: vec![format!("rendered sequences of {} frames", self.frames)],
            repeats: 1,
            experiments: vec![
                plot("room-time", "Rooms: error against run time", time, |f| f.server_ms),
                plot("room-bytes", "Rooms: error against bytes", bytes, |f| f.kbit_s),
            ],
            costs: None,
            skipped: self.skipped.clone(),
            seconds: self.seconds,
        })
    }

    /// A curve for each sequence and size.
    pub(super) fn curves(&self, x: fn(&Figures) -> f64) -> Vec<Curve> {
        let mut curves: Vec<Curve> = Vec::new();
        for Point { at, figures: f } in &self.points {
            let name = format!("{}, {}x{}", f.sequence, at.size.0, at.size.1);
            let point = Plotted {
                setting: at.to_string(),
                x: x(f),
                y: f.psnr,
                figures: vec![
                    ("SSIM", f.ssim),
                    ("flicker, levels", f.flicker),
                    ("server, p95, ms", f.server_ms_p95),
                    ("total, kbit/s", f.kbit_s),
                    ("geometry, %", 100.0 * f.geometry_share),
                    ("tiles not sent, %", 100.0 * f.left_out),
                    ("tiles late, %", 100.0 * (f.waiting + f.coarse)),
                ],
                ..Plotted::default()
            };
            match curves.iter_mut().find(|c| c.name == name) {
                Some(curve) => curve.points.push(point),
                None => curves.push(Curve { name, points: vec![point] }),
            }
        }
        curves
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::*;

    fn points() -> Points {
        let point = |width, budget_ms, psnr| Point {
            at: OperatingPoint { size: (width, 240), bitrate: Some(384_000), budget_ms },
            figures: Figures { sequence: "still camera", psnr, server_ms: 12.0, kbit_s: 500.0, ..Figures::default() },
        };
        let points = vec![point(320, 0.0, 24.5), point(320, 10.0, 23.0), point(640, 0.0, 26.0)];
        Points { machine: Machine::this(), frames: 9, points, skipped: vec!["cut: a < b".into()], seconds: 1.0 }
    }

    #[test]
    fn the_table_has_separate_lines_and_columns() {
        let table = points().table();
        let lines: Vec<&str> = table.lines().skip(1).collect();
        assert_eq!(lines.len(), 4);
        assert!(lines[1].contains("none") && lines[2].contains(" 10 ") && lines[3].contains("640x240"));
        assert!(COLUMNS.iter().all(|(name, width, _)| name.len() < *width));
        let wide = Point {
            at: OperatingPoint { size: (1920, 1080), bitrate: None, budget_ms: 1000.0 },
            figures: Figures { sequence: "still camera, RGB-D", ..Figures::default() },
        };
        assert!(COLUMNS.iter().all(|(_, width, of)| of(&wide).len() <= *width));
    }

    #[test]
    fn the_page_plots_time_and_bytes_by_size() {
        let page = points().page();
        assert_eq!(page.matches("<svg").count(), 2);
        assert!(page.contains("still camera, 320x240") && page.contains("still camera, 640x240") && page.contains("cut: a &lt; b"));
        assert!(page.contains("--size 320x240 --bitrate 384000 --budget-ms 10"));
    }

    #[test]
    fn every_point_measures_the_sequences() {
        let models = tmpi_pipeline::Models {
            depth: std::sync::Arc::new(crate::oracle_depth::OracleDepth(tmpi_core::DisparityMap {
                width: 0,
                height: 0,
                delta: Vec::new(),
            })),
            theta: None,
            psi: None,
        };
        let settings = Settings {
            size: (80, 64),
            seed: super::super::SEED,
            frames: 3,
            every: 1,
            bitrate: None,
            frame_ms: 0.0,
            views: 2,
            models,
            depth: false,
            true_scale: false,
            max_error: tmpi_live::MAX_ERROR,
            parallax: 0.25,
            cooldown: tmpi_live::COOLDOWN,
            late: 0,
            follow: tmpi_core::live::MAX_MOTION_FRAMES,
            recheck: tmpi_live::RECHECK,
            only: None,
            files: None,
        };
        let at = |width, budget_ms| OperatingPoint { size: (width, 64), bitrate: None, budget_ms };
        let found = measure(&settings, &[at(80, 0.0), at(96, 1e-3)], &|_| {}).unwrap();
        // without a depth network, only the sequence with measured depth runs
        assert_eq!(
            found.points.iter().map(|p| (p.at.size.0, p.figures.sequence)).collect::<Vec<_>>(),
            [(80, "still camera, RGB-D"), (96, "still camera, RGB-D")]
        );
        assert_eq!(found.skipped.len(), 3);
        let late = |i: usize| found.points[i].figures.waiting + found.points[i].figures.coarse;
        assert!(late(0) <= 0.0 && late(1) > 0.0, "{} {}", late(0), late(1));
        let json: serde_json::Value = serde_json::to_value(&found).unwrap();
        assert!(json["points"][1]["budget_ms"] == 1e-3 && json["points"][0]["psnr"].is_number());
    }
}
