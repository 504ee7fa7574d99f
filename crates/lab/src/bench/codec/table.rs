//! Results as text.

use std::fmt::Write;

use super::{CodecResults, Row};
use crate::bench::measure::median;

/// Bounds on a container's size for each byte of its photo: mean, and worst.
const MEAN: f64 = 1.30;
const WORST: f64 = 1.60;

fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let all: Vec<f64> = values.into_iter().collect();
    all.iter().sum::<f64>() / all.len().max(1) as f64
}

/// One way over all scenes.
struct Line<'a> {
    rows: Vec<&'a Row>,
}

impl CodecResults {
    fn lines(&self) -> Vec<Line<'_>> {
        let ways = self.scenes.first().map_or(0, |s| s.rows.len());
        (0..ways).map(|i| Line { rows: self.scenes.iter().filter_map(|s| s.rows.get(i)).collect() }).collect()
    }

    /// A line each of every way on every scene.
    #[must_use]
    pub fn csv(&self) -> String {
        let quoted = |s: &str| format!("\"{}\"", s.replace('"', "\"\""));
        let or_nothing = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.4}"));
        let mut out = String::from(
            "photo,width,height,way,quality,below,bytes,encode_ms,encode_cpu_ms,decode_ms,decode_cpu_ms,ssimulacra2,psnr,psnr_least\n",
        );
        for s in &self.scenes {
            for r in &s.rows {
                let quality = r.quality.map_or(String::new(), |q| q.to_string());
                let of = |f: fn(&super::Score) -> f64| or_nothing(r.score.as_ref().map(f));
                // a String takes everything
                let _ = writeln!(
                    out,
                    "{},{},{},{},{quality},{},{},{:.3},{:.3},{},{},{},{},{}",
                    quoted(&s.name),
                    s.width,
                    s.height,
                    quoted(&r.way),
                    r.below,
                    r.bytes,
                    r.encode_ms,
                    r.encode_cpu_ms,
                    or_nothing(r.decode_ms),
                    or_nothing(r.decode_cpu_ms),
                    of(|s| s.ssimulacra2),
                    of(|s| s.psnr),
                    of(|s| s.psnr_least),
                );
            }
        }
        out
    }

    /// Tables to be read: all ways, then the sections of every container.
    #[must_use]
    pub fn table(&self) -> String {
        let mut out = String::new();
        let scenes = self.scenes.len();
        let _ = writeln!(
            out,
            "Means over {scenes} scenes; times are medians of {} runs, processor ms of all threads; load {}.",
            self.repeats,
            self.machine.load.map_or("unknown".into(), |l| format!("{l:.1}")),
        );
        let _ = writeln!(
            out,
            "{:<30}{:>10}{:>9}{:>9}{:>9}{:>9}{:>9}{:>11}{:>11}",
            "way", "KB", "x ours", "quality", "ssimu2", "below", "view dB", "encode ms", "decode ms"
        );
        let ours: Vec<f64> = self.scenes.iter().filter_map(|s| s.rows.first()).map(|r| r.bytes as f64).collect();
        for Line { rows } in self.lines() {
            let text = |v: Option<f64>, digits: usize| v.map_or("-".into(), |v| format!("{v:.digits$}"));
            let some = |f: &dyn Fn(&Row) -> Option<f64>| {
                let all: Vec<f64> = rows.iter().filter_map(|r| f(r)).collect();
                (!all.is_empty()).then(|| mean(all))
            };
            let _ = writeln!(
                out,
                "{:<30}{:>10.1}{:>9.2}{:>9}{:>9}{:>9}{:>9}{:>11.1}{:>11}",
                rows.first().map_or("", |r| &r.way),
                mean(rows.iter().map(|r| r.bytes as f64 / 1e3)),
                mean(rows.iter().zip(&ours).map(|(r, ours)| r.bytes as f64 / ours)),
                text(some(&|r| r.quality.map(f64::from)), 0),
                text(some(&|r| r.score.map(|s| s.ssimulacra2)), 2),
                rows.iter().filter(|r| r.below).count(),
                text(some(&|r| r.score.map(|s| s.psnr)), 2),
                mean(rows.iter().map(|r| r.encode_cpu_ms)),
                text(some(&|r| r.decode_cpu_ms), 1),
            );
        }
        self.bands(&mut out);
        self.sections(&mut out);
        let shared: Vec<_> = self.scenes.iter().filter_map(|s| s.shared).collect();
        let of = |f: fn(&super::SharedRow) -> usize| mean(shared.iter().map(|r| f(r) as f64));
        let _ = writeln!(
            out,
            "index and planes, bytes: now {:.0}, by zstd {:.0}, by zstd with a dictionary of all others {:.0}",
            of(|r| r.now),
            of(|r| r.zstd),
            of(|r| r.shared)
        );
        for s in &self.skipped {
            let _ = writeln!(out, "left out: {s}");
        }
        out
    }

    fn bands(&self, out: &mut String) {
        if self.scenes.iter().all(|s| s.bands.is_empty()) {
            return;
        }
        let _ = writeln!(
            out,
            "{:<24}{:>11}{:>10}{:>7}{:>11}{:>9}{:>9}{:>10}{:>10}",
            "photo", "size", "band px", "bands", "bytes", "more B", "more %", "read ms", "read cpu"
        );
        for s in &self.scenes {
            let one = s.bands.first().map_or(0, |b| b.bytes) as f64;
            for b in &s.bands {
                let more = b.bytes as f64 - one;
                let _ = writeln!(
                    out,
                    "{:<24}{:>11}{:>10}{:>7}{:>11}{more:>9.0}{:>9.3}{:>10.1}{:>10.1}",
                    s.name,
                    format!("{}x{}", s.width, s.height),
                    b.pixels.map_or("-".into(), |p| p.to_string()),
                    b.bands,
                    b.bytes,
                    100.0 * more / one,
                    b.read_ms,
                    b.read_cpu_ms,
                );
            }
        }
    }

    fn sections(&self, out: &mut String) {
        let _ = writeln!(
            out,
            "\n{:<24}{:>11}{:>6}{:>9}{:>9}{:>9}{:>8}{:>8}{:>8}{:>10}{:>9}{:>9}{:>9}",
            "photo",
            "size",
            "kept",
            "photo B",
            "labels B",
            "planes B",
            "planes",
            "B/plane",
            "total/p",
            "photo dB",
            "ssimu2",
            "view dB",
            "least"
        );
        for s in &self.scenes {
            let of = |kind: &str| s.sections.iter().filter(|p| p.kind == kind).map(|p| p.length).sum::<u64>();
            let score = s.rows.first().and_then(|r| r.score).unwrap_or_default();
            let _ = writeln!(
                out,
                "{:<24}{:>11}{:>6}{:>9}{:>9}{:>9}{:>8}{:>8.2}{:>8.3}{:>10.2}{:>9.2}{:>9.2}{:>9.2}",
                s.name,
                format!("{}x{}", s.width, s.height),
                if s.kept { "yes" } else { "no" },
                of("photo"),
                of("labels"),
                of("planes"),
                s.planes,
                of("planes") as f64 / f64::from(s.planes.max(1)),
                s.over_photo,
                s.photo_psnr,
                s.photo_ssimulacra2.unwrap_or(f64::NAN),
                score.psnr,
                score.psnr_least,
            );
        }
        let over: Vec<f64> = self.scenes.iter().map(|s| s.over_photo).collect();
        let worst = over.iter().copied().fold(0.0, f64::max);
        let middle = mean(over.clone());
        let verdict = if middle <= MEAN && worst <= WORST { "held" } else { "NOT held" };
        let _ = writeln!(
            out,
            "container over photo: mean {middle:.3}, median {:.3}, worst {worst:.3}; at most {MEAN:.2} and {WORST:.2}: {verdict}",
            median(over)
        );
    }
}
