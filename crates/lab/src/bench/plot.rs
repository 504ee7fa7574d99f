//! Draws an experiment as an SVG plot.

use std::fmt::Write;

use super::{Axis, Experiment, Point};

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 400.0;
/// Left, top, right and bottom margins.
const BORDER: [f64; 4] = [70.0, 14.0, 170.0, 50.0];
/// Colour-blind safe colours (Okabe and Ito) that are visible on white and on black.
const COLOURS: [&str; 6] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#56b4e9"];

/// Largest number of points whose values are written beside them.
const NAMED: usize = 12;

/// The value in a setting as on the command line.
fn brief(setting: &str) -> &str {
    let value = setting.strip_prefix("--").and_then(|s| s.split_once(' ')).map_or(setting, |(_, value)| value);
    value.split_once(" --").map_or(value, |(value, _)| value)
}

/// Escapes text for markup.
pub(super) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Formats a number with about three digits.
pub(super) fn number(v: f64) -> String {
    let digits = match v.abs() {
        a if a >= 100.0 || a == 0.0 => 0,
        a if a >= 10.0 => 1,
        a if a >= 1.0 => 2,
        a if a >= 0.01 => 4,
        _ => return format!("{v:.2e}"),
    };
    format!("{v:.digits$}")
}

/// Maps values to positions on an axis.
struct Scale {
    log: bool,
    lo: f64,
    hi: f64,
    from: f64,
    to: f64,
}

impl Scale {
    /// A scale over all finite values, with some padding on both sides.
    fn new(axis: &Axis, values: impl Iterator<Item = f64>, from: f64, to: f64) -> Self {
        let log = axis.log;
        let seen = values.filter(|v| v.is_finite() && (!log || *v > 0.0)).map(|v| if log { v.log10() } else { v });
        let (lo, hi) = seen.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        let (lo, hi) = if lo > hi { (0.0, 1.0) } else { (lo, hi) };
        let room = ((hi - lo) * 0.06).max(if log { 0.05 } else { (hi.abs() * 0.01).max(1e-9) });
        Self { log, lo: lo - room, hi: hi + room, from, to }
    }

    /// Position of a value; `None` if it has none on this axis.
    fn at(&self, v: f64) -> Option<f64> {
        let v = if self.log { v.log10() } else { v };
        v.is_finite().then(|| self.from + (v - self.lo) / (self.hi - self.lo) * (self.to - self.from))
    }

    /// About `count` round values for labels.
    fn ticks(&self, count: f64) -> Vec<f64> {
        if self.log {
            let within = |v: &f64| (self.lo..=self.hi).contains(&v.log10());
            let decades = self.lo.floor() as i32..=self.hi.ceil() as i32;
            let some = |steps: &[f64]| -> Vec<f64> {
                decades.clone().flat_map(|d| steps.iter().map(move |s| s * 10f64.powi(d))).filter(within).collect()
            };
            let choices = [some(&[1.0]), some(&[1.0, 3.0]), some(&[1.0, 2.0, 5.0]), some(&[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0])];
            let enough = choices.iter().position(|c| c.len() >= 3).unwrap_or(choices.len() - 1);
            return choices[enough].clone();
        }
        let raw = (self.hi - self.lo) / count;
        let unit = 10f64.powf(raw.log10().floor());
        let step = unit * [1.0, 2.0, 5.0, 10.0].into_iter().find(|s| s * unit >= raw).unwrap_or(10.0);
        let (first, last) = ((self.lo / step).ceil() as i64, (self.hi / step).floor() as i64);
        (first..=last).map(|i| i as f64 * step).collect()
    }
}

/// The plot as markup.
pub(super) fn svg(e: &Experiment) -> String {
    let points = || e.curves.iter().flat_map(|c| &c.points);
    let x = Scale::new(&e.x, points().map(|p| p.x), BORDER[0], WIDTH - BORDER[2]);
    let y = Scale::new(&e.y, points().map(|p| p.y), HEIGHT - BORDER[3], BORDER[1]);
    let mut out = format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">", escaped(&e.title));
    axes(&mut out, e, &x, &y);
    front(&mut out, e, &x, &y);
    let mut labels: Vec<(f64, usize)> = Vec::new();
    let named = e.joined() && points().count() <= NAMED;
    for (i, c) in e.curves.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let dash = if i < COLOURS.len() { "" } else { " stroke-dasharray=\"5 4\"" };
        let places: Vec<(f64, f64, &Point)> = c.points.iter().filter_map(|p| Some((x.at(p.x)?, y.at(p.y)?, p))).collect();
        let line: Vec<String> = places.iter().map(|(a, b, _)| format!("{a:.1},{b:.1}")).collect();
        if e.joined() {
            put(
                &mut out,
                &format!("<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\"{dash}/>", line.join(" ")),
            );
        }
        for (a, b, p) in &places {
            if p.default {
                put(
                    &mut out,
                    &format!(
                        "<circle cx=\"{a:.1}\" cy=\"{b:.1}\" r=\"8.5\" fill=\"none\" stroke=\"currentColor\" stroke-width=\"1.6\"/>\
                         <text x=\"{:.1}\" y=\"{:.1}\" class=\"own\">default</text>",
                        a + 11.0,
                        b + 16.0
                    ),
                );
            }
            if named {
                let name = escaped(brief(&p.setting));
                put(&mut out, &format!("<text x=\"{:.1}\" y=\"{:.1}\" class=\"of\">{name}</text>", a + 7.0, b - 7.0));
            }
            if let (Some(top), Some(bottom)) = (y.at(p.y + p.spread), y.at(p.y - p.spread))
                && p.spread > 0.0
            {
                let (top, bottom) = [top, bottom].map(|v| v.clamp(BORDER[1], HEIGHT - BORDER[3])).into();
                put(
                    &mut out,
                    &format!(
                        "<line x1=\"{a:.1}\" x2=\"{a:.1}\" y1=\"{top:.1}\" y2=\"{bottom:.1}\" stroke=\"{colour}\" stroke-opacity=\".35\"/>"
                    ),
                );
            }
            let fill = if p.pareto { colour } else { "var(--paper)" };
            let tip = escaped(&format!("{}: {} {}, {} {}", p.setting, number(p.x), e.x.label, number(p.y), e.y.label));
            put(
                &mut out,
                &format!(
                    "<circle cx=\"{a:.1}\" cy=\"{b:.1}\" r=\"4\" fill=\"{fill}\" stroke=\"{colour}\" stroke-width=\"1.6\"><title>{tip}</title></circle>"
                ),
            );
        }
        if let Some((_, b, _)) = places.last() {
            labels.push((*b, i));
        }
    }
    // labels on the right, at the height of each curve's last point, spread to avoid overlap
    labels.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut next = BORDER[1] + 8.0;
    for (wanted, i) in labels {
        let at = wanted.max(next).min(HEIGHT - BORDER[3]);
        next = at + 17.0;
        let (colour, left) = (COLOURS[i % COLOURS.len()], WIDTH - BORDER[2] + 10.0);
        put(
            &mut out,
            &format!(
                "<circle cx=\"{:.1}\" cy=\"{at:.1}\" r=\"4\" fill=\"{colour}\"/><text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                left + 4.0,
                left + 14.0,
                at + 4.0,
                escaped(&e.curves[i].name)
            ),
        );
    }
    out + "</svg>"
}

fn put(out: &mut String, markup: &str) {
    out.push_str(markup);
}

fn axes(out: &mut String, e: &Experiment, x: &Scale, y: &Scale) {
    let (left, right, upper, lower) = (BORDER[0], WIDTH - BORDER[2], BORDER[1], HEIGHT - BORDER[3]);
    for v in x.ticks(6.0) {
        if let Some(at) = x.at(v) {
            // writing to a String cannot fail
            let _ = write!(
                out,
                "<line class=\"grid\" x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{upper}\" y2=\"{lower}\"/><text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                lower + 17.0,
                short(v)
            );
        }
    }
    for v in y.ticks(6.0) {
        if let Some(at) = y.at(v) {
            let _ = write!(
                out,
                "<line class=\"grid\" x1=\"{left}\" x2=\"{right}\" y1=\"{at:.1}\" y2=\"{at:.1}\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                left - 8.0,
                at + 4.0,
                short(v)
            );
        }
    }
    let better = |up: Option<bool>, toward: [&str; 2]| up.map_or(String::new(), |u| format!(" ({} is better)", toward[usize::from(u)]));
    let (xl, yl) =
        (format!("{}{}", e.x.label, better(e.x.up, ["left", "right"])), format!("{}{}", e.y.label, better(e.y.up, ["down", "up"])));
    let _ = write!(
        out,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text><text transform=\"translate(16 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
        f64::midpoint(left, right),
        HEIGHT - 10.0,
        escaped(&xl),
        f64::midpoint(upper, lower),
        escaped(&yl)
    );
}

/// Draws the Pareto front as steps.
fn front(out: &mut String, e: &Experiment, x: &Scale, y: &Scale) {
    if !e.joined() || e.x.up.is_none() || e.is_apart() {
        return;
    }
    let mut best: Vec<(f64, f64)> =
        e.curves.iter().flat_map(|c| &c.points).filter(|p| p.pareto).filter_map(|p| Some((x.at(p.x)?, y.at(p.y)?))).collect();
    best.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut path = String::new();
    for (i, (a, b)) in best.iter().enumerate() {
        let _ = if i == 0 { write!(path, "M{a:.1} {b:.1}") } else { write!(path, "H{a:.1}V{b:.1}") };
    }
    put(out, &format!("<path d=\"{path}\" class=\"front\"/>"));
}

impl Experiment {
    /// Whether the points of a curve follow one number, so that a line between them is meaningful.
    fn joined(&self) -> bool {
        !["steps", "ramps", "denoise", "without", "moves", "mesh", "discretisation", "families"].contains(&self.id)
    }
}

/// A tick's label, without trailing zeros.
fn short(v: f64) -> String {
    let rounded = (v * 1e6).round() / 1e6;
    if rounded.abs() >= 1e4 { format!("{}k", rounded / 1e3) } else { format!("{rounded}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_few_and_on_the_axis() {
        let axis = |log| Axis { label: "", log, up: None };
        for (values, log) in [(vec![27.3, 28.9], false), (vec![0.0, 0.0], false), (vec![3.0, 250.0], true), (vec![41.0, 47.0], true)] {
            let s = Scale::new(&axis(log), values.iter().copied(), 0.0, 100.0);
            let ticks = s.ticks(6.0);
            assert!((1..=14).contains(&ticks.len()), "{values:?}: {ticks:?}");
            assert!(ticks.iter().all(|&t| s.at(t).is_some_and(|p| (-1e-6..=100.000_001).contains(&p))), "{values:?}: {ticks:?}");
        }
        let none = Scale::new(&axis(true), std::iter::empty(), 0.0, 1.0);
        assert_eq!(none.at(0.0), None);
    }

    #[test]
    fn numbers_and_text_are_formatted() {
        assert_eq!([0.0, 0.5, 12.345, 1234.5].map(number), ["0", "0.5000", "12.3", "1234"]);
        assert_eq!((short(20000.0).as_str(), short(0.3).as_str()), ("20k", "0.3"));
        assert_eq!(["--max-error 1", "--view-box 1,2,3 --verify-prune", "level 2"].map(brief), ["1", "1,2,3", "level 2"]);
        assert_eq!(escaped("<a&\"b\">"), "&lt;a&amp;&quot;b&quot;&gt;");
    }
}
