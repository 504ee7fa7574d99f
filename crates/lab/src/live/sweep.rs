//! Measures each sequence at several sizes, bit rates and budgets: error against run time and bytes.

use serde::Serialize;

use super::{Row, Settings, VIEW_BOX, run};
use crate::LabError;
use crate::bench::{Axis, Curve, Experiment, Machine, Point as Plotted, Results};
use crate::table::table;

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct OperatingPoint {
    pub size: (u32, u32),
    /// H.264 bits per second.
    pub bitrate: u32,
    /// Milliseconds that the geometry of a frame should take; 0: no limit.
    pub budget_ms: f64,
}

/// A sequence at one operating point.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    #[serde(flatten)]
    pub at: OperatingPoint,
    #[serde(flatten)]
    pub row: Row,
}

/// All sequences at all operating points.
#[derive(Clone, Debug, Serialize)]
pub struct Sweep {
    pub machine: Machine,
    pub frames: u32,
    /// How far to the right of the camera the side view is, in units of the nearest distance: the border of a room's view box.
    pub side_view: f64,
    /// Results of all sequences for each point, in the given order of points.
    pub points: Vec<Point>,
    /// Skipped sequences, each with the reason.
    pub skipped: Vec<String>,
    pub seconds: f64,
}

/// Measures all sequences at each point, and calls `progress` for each.
pub fn measure(settings: &Settings, at: &[OperatingPoint], progress: &dyn Fn(&str)) -> Result<Sweep, LabError> {
    let start = std::time::Instant::now();
    let (mut points, mut skipped) = (Vec::new(), Vec::new());
    for &at in at {
        let settings = Settings { at, ..settings.clone() };
        let (rows, without) = run(&settings, &|what| progress(&format!("{what}, {at}")))?;
        points.extend(rows.into_iter().map(|row| Point { at, row }));
        skipped = without;
    }
    Ok(Sweep {
        machine: Machine::this(),
        frames: settings.flags.frames,
        side_view: VIEW_BOX.x,
        points,
        skipped,
        seconds: start.elapsed().as_secs_f64(),
    })
}

impl std::fmt::Display for OperatingPoint {
    /// Formats the point as command-line options.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "--size {}x{} --bitrate {} --budget-ms {}", self.size.0, self.size.1, self.bitrate, self.budget_ms)
    }
}

/// Figures in the table and on the page: heading, name, and digits.
const FIGURES: [(&str, &str, usize); 11] = [
    ("server ms", "server, ms", 1),
    ("p95", "server, ms, 95th percentile", 1),
    ("PSNR", "side view, dB", 2),
    ("SSIM", "side view, SSIM", 3),
    ("flicker", "flicker, levels", 3),
    ("kbit/s", "total, kbit/s", 0),
    ("geometry %", "geometry, % of total", 1),
    ("unsent %", "tiles not sent, %", 1),
    ("waiting %", "tiles late: waiting, %", 1),
    ("coarse %", "tiles late: coarse, %", 1),
    ("depth px", "depth network, pixels", 0),
];

impl Sweep {
    /// The results as a text table: all figures with a column for each sequence, or some with a line for each if there are several points.
    pub fn table(&self) -> String {
        if self.points.iter().all(|p| p.at == self.points[0].at) { self.all_figures() } else { self.lines() }
    }

    fn all_figures(&self) -> String {
        let mut names: Vec<&str> = Vec::new();
        for (name, _) in self.points.iter().flat_map(|p| &p.row.figures) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        let head: Vec<&str> = std::iter::once("").chain(self.points.iter().map(|p| p.row.sequence)).collect();
        let line = |name: &str| {
            let figure = |p: &Point| p.row.get(name).map_or(String::new(), |v| format!("{v:.3}"));
            std::iter::once(name.to_owned()).chain(self.points.iter().map(figure)).collect::<Vec<_>>()
        };
        self.points.first().map_or(String::new(), |p| format!("{}, {} frames; {}\n", p.at, self.frames, self.place()))
            + &table(1, &head, names.into_iter().map(line))
    }

    fn lines(&self) -> String {
        let head: Vec<&str> = ["sequence", "size", "target", "budget ms"].into_iter().chain(FIGURES.map(|f| f.0)).collect();
        let line = |Point { at, row }: &Point| {
            let budget = if at.budget_ms > 0.0 { at.budget_ms.to_string() } else { "none".into() };
            let own = [row.sequence.to_owned(), format!("{}x{}", at.size.0, at.size.1), (at.bitrate / 1000).to_string(), budget];
            let figures = FIGURES.map(|(_, name, digits)| row.get(name).map_or(String::new(), |v| format!("{v:.digits$}")));
            own.into_iter().chain(figures).collect::<Vec<_>>()
        };
        format!("{} frames per sequence; PSNR in dB, SSIM and flicker (levels) of the side view; {}\n", self.frames, self.place())
            + &table(1, &head, self.points.iter().map(line))
    }

    fn place(&self) -> String {
        format!("side view {} to the right, the border of a room's view box", self.side_view)
    }

    /// The results as a page with plots of error against run time and bytes.
    pub fn page(&self) -> String {
        let about = format!("Side views against the truth; means over the frames of one run of each sequence; {}.", self.place());
        let time = Axis::new("server, ms per frame", true, Some(false));
        let bytes = Axis::new("video, geometry and sound, kbit/s", true, Some(false));
        let plot = |id: &str, title: &str, x: Axis, of: &str| {
            let y = Axis::new("PSNR, dB", false, Some(true));
            let mut e = Experiment { id: id.into(), title: title.into(), about: about.clone(), x, y, curves: self.curves(of) };
            e.mark();
            e
        };
        crate::bench::html(&Results {
            version: env!("CARGO_PKG_VERSION").into(),
            machine: self.machine.clone(),
            subjects: vec![format!("rendered sequences of {} frames", self.frames)],
            repeats: 1,
            experiments: vec![
                plot("room-time", "Rooms: error against run time", time, "server, ms"),
                plot("room-bytes", "Rooms: error against bytes", bytes, "total, kbit/s"),
            ],
            costs: None,
            skipped: self.skipped.clone(),
            seconds: self.seconds,
        })
    }

    fn curves(&self, x: &str) -> Vec<Curve> {
        let mut curves: Vec<Curve> = Vec::new();
        for Point { at, row } in &self.points {
            let name = format!("{}, {}x{}", row.sequence, at.size.0, at.size.1);
            let of = |name: &str| row.get(name).unwrap_or_default();
            let point = Plotted {
                setting: at.to_string(),
                x: of(x),
                y: of("side view, dB"),
                figures: FIGURES.map(|(_, name, _)| (name.to_owned(), of(name))).into(),
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
    use clap::Parser as _;

    use super::super::Flags;
    use super::*;

    #[derive(clap::Parser)]
    struct Cli {
        #[command(flatten)]
        flags: Flags,
    }

    fn points() -> Sweep {
        let point = |width, budget_ms, psnr| Point {
            at: OperatingPoint { size: (width, 240), bitrate: 384_000, budget_ms },
            row: Row {
                sequence: "still camera",
                figures: [("side view, dB", psnr), ("server, ms", 12.0), ("total, kbit/s", 500.0)].map(|(n, v)| (n.into(), v)).into(),
            },
        };
        let points = vec![point(320, 0.0, 24.5), point(320, 10.0, 23.0), point(640, 0.0, 26.0)];
        Sweep { machine: Machine::this(), frames: 9, side_view: VIEW_BOX.x, points, skipped: vec!["cut: a < b".into()], seconds: 1.0 }
    }

    #[test]
    fn the_table_has_separate_lines_and_columns() {
        let table = points().table();
        assert!(table.lines().next().unwrap().contains("side view 0.12 to the right"), "{table}");
        let lines: Vec<&str> = table.lines().skip(1).collect();
        assert_eq!(lines.len(), 4);
        assert!(lines[1].contains("none") && lines[2].contains(" 10 ") && lines[3].contains("640x240"));
        let one = Sweep { points: vec![points().points.remove(1)], ..points() }.table();
        assert!(
            one.contains("--budget-ms 10, 9 frames; side view 0.12 to the right")
                && one.contains("side view, dB")
                && one.contains("23.000"),
            "{one}"
        );
    }

    #[test]
    fn the_page_plots_time_and_bytes_by_size() {
        let page = points().page();
        assert_eq!(page.matches("<svg").count(), 2);
        assert!(
            page.contains("side view 0.12 to the right")
                && page.contains("still camera, 320x240")
                && page.contains("still camera, 640x240")
                && page.contains("cut: a &lt; b")
        );
        assert!(page.contains("--size 320x240 --bitrate 384000 --budget-ms 10"));
    }

    #[test]
    fn every_point_measures_the_sequences() {
        let Cli { flags } = Cli::parse_from(["live-bench", "--frames", "3", "--views", "2", "--parallax", "0.25"]);
        let at = |width, budget_ms| OperatingPoint { size: (width, 64), bitrate: 100_000, budget_ms };
        let settings = Settings { flags, at: at(80, 0.0), models: crate::oracle_depth::none(), depth: false };
        let found = measure(&settings, &[at(80, 0.0), at(96, 1e-3)], &|_| {}).unwrap();
        // without a depth network, only the sequence with measured depth runs
        assert_eq!(
            found.points.iter().map(|p| (p.at.size.0, p.row.sequence)).collect::<Vec<_>>(),
            [(80, "still camera, RGB-D"), (96, "still camera, RGB-D")]
        );
        assert_eq!(found.skipped.len(), 3);
        let figure = |i: usize, name: &str| found.points[i].row.get(name).unwrap();
        let coarse = |i: usize| figure(i, "tiles late: coarse, %");
        assert!(coarse(0) <= 0.0 && coarse(1) > 0.0, "{} {}", coarse(0), coarse(1));
        let missing: Vec<&str> = FIGURES.iter().map(|f| f.1).filter(|name| found.points[0].row.get(name).is_none()).collect();
        assert_eq!(missing, ["depth network, pixels"]);
        let json: serde_json::Value = serde_json::to_value(&found).unwrap();
        assert!(
            json["side_view"] == 0.12
                && json["points"][1]["budget_ms"] == 1e-3
                && json["points"][0]["figures"]["side view, dB"].is_number()
        );
    }
}
