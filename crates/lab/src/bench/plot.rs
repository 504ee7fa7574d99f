//! Draws an experiment as an SVG plot.

use std::fmt::Write;

use super::{Axis, Experiment, Point};

const WIDTH: f64 = 770.0;
const HEIGHT: f64 = 400.0;
/// Edges of the plot itself; the names of the curves are on its right.
const LEFT: f64 = 70.0;
const RIGHT: f64 = 550.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 350.0;
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

/// A value, with its range if runs differ.
pub(super) fn ranged(value: f64, range: Option<[f64; 2]>) -> String {
    let range = range.map_or(String::new(), |[least, most]| format!(" ({}–{})", number(least), number(most)));
    number(value) + &range
}

/// Maps values, or their logarithms, from `lo` to `hi` to positions from `from` to `to`.
struct Scale {
    log: bool,
    lo: f64,
    hi: f64,
    from: f64,
    to: f64,
}

impl Scale {
    /// A scale over all finite values, with some padding on both sides.
    fn new(axis: &Axis, values: impl Iterator<Item = f64>, (from, to): (f64, f64)) -> Self {
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

    /// Where a bar between two values starts and ends, from the position `at`; `None` if a value has no position.
    fn bar(&self, ends: [f64; 2], at: f64) -> Option<[f64; 2]> {
        let within = |v: f64| Some(self.at(v)?.clamp(self.from.min(self.to), self.from.max(self.to)) - at);
        Some([within(ends[0])?, within(ends[1])?])
    }

    /// Round values for labels, and their positions.
    fn ticks(&self) -> Vec<(f64, f64)> {
        let placed = |v: f64| Some((v, self.at(v)?));
        if self.log {
            let multiples = |steps: &[f64]| -> Vec<(f64, f64)> {
                let decades = self.lo.floor() as i32..=self.hi.ceil() as i32;
                let values = decades.flat_map(|d| steps.iter().map(move |s| s * 10f64.powi(d)));
                values.filter(|v| (self.lo..=self.hi).contains(&v.log10())).filter_map(placed).collect()
            };
            if let Some(enough) = [multiples(&[1.0]), multiples(&[1.0, 2.0, 5.0])].into_iter().find(|ticks| ticks.len() >= 3) {
                return enough;
            }
        }
        // within a decade, both axes are nearly alike
        let (lo, hi) = if self.log { (10f64.powf(self.lo), 10f64.powf(self.hi)) } else { (self.lo, self.hi) };
        let raw = (hi - lo) / 6.0;
        let unit = 10f64.powf(raw.log10().floor());
        let step = unit * [1.0, 2.0, 5.0].into_iter().find(|s| s * unit >= raw).unwrap_or(10.0);
        let (first, last) = ((lo / step).ceil() as i64, (hi / step).floor() as i64);
        (first..=last).filter_map(|i| placed(i as f64 * step)).collect()
    }
}

pub(super) fn svg(e: &Experiment) -> String {
    let points = || e.curves.iter().flat_map(|c| &c.points);
    let x = Scale::new(&e.x, points().map(|p| p.x), (LEFT, RIGHT));
    let y = Scale::new(&e.y, points().map(|p| p.y), (BOTTOM, TOP));
    let mut out = format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">", escaped(&e.title));
    axes(&mut out, e, &x, &y);
    let named = e.joined() && points().count() <= NAMED;
    let mut names = Vec::new();
    for (i, c) in e.curves.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let places: Vec<(f64, f64, &Point)> = c.points.iter().filter_map(|p| Some((x.at(p.x)?, y.at(p.y)?, p))).collect();
        if e.joined() {
            let line: Vec<String> = places.iter().map(|(a, b, _)| format!("{a:.1},{b:.1}")).collect();
            let dash = if i < COLOURS.len() { "" } else { " stroke-dasharray=\"5 4\"" };
            // writing to a String cannot fail, here and below
            let _ = write!(out, "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.6\"{dash}/>", line.join(" "));
        }
        for &(a, b, p) in &places {
            let _ = write!(out, "<g transform=\"translate({a:.1} {b:.1})\">{}</g>", dot(p, [(&e.x, &x, a), (&e.y, &y, b)], colour, named));
        }
        names.extend(places.last().map(|(_, b, _)| (*b, colour, &c.name)));
    }
    // at the height of each curve's last point, spread to avoid overlap
    names.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut next = TOP + 8.0;
    for (wanted, colour, name) in names {
        let at = wanted.max(next).min(BOTTOM);
        next = at + 17.0;
        let name = escaped(name);
        let _ = write!(
            out,
            "<g transform=\"translate({} {at:.1})\"><circle r=\"4\" fill=\"{colour}\"/><text x=\"10\" y=\"4\">{name}</text></g>",
            RIGHT + 14.0
        );
    }
    out + "</svg>"
}

/// A point, relative to its place: the ring of a default, its name, the spread, the range of repeated measurements, and the point itself
/// with a tip. Each axis has its scale and the position of the point.
fn dot(p: &Point, axes: [(&Axis, &Scale, f64); 2], colour: &str, named: bool) -> String {
    let mut out = String::new();
    if p.default {
        out += "<circle r=\"8.5\" fill=\"none\" stroke=\"currentColor\" stroke-width=\"1.6\"/><text x=\"11\" y=\"16\" class=\"own\">default</text>";
    }
    if named {
        let _ = write!(out, "<text x=\"7\" y=\"-7\" class=\"of\">{}</text>", escaped(brief(&p.setting)));
    }
    let [(x_axis, ..), (y_axis, y, b)] = axes;
    if let Some([top, bottom]) = y.bar([p.y + p.spread, p.y - p.spread], b) {
        let _ = write!(out, "<path d=\"M0 {top:.1}V{bottom:.1}\" stroke=\"{colour}\" stroke-opacity=\".35\"/>");
    }
    for ((axis, scale, at), turn) in axes.into_iter().zip([0, 90]) {
        if let Some([from, to]) = p.range(&axis.label).and_then(|range| scale.bar(range, at)) {
            let d = format!("M{from:.1} -3V3M{from:.1} 0H{to:.1}M{to:.1} -3V3");
            let _ = write!(out, "<path class=\"range\" d=\"{d}\" transform=\"rotate({turn})\" fill=\"none\" stroke=\"{colour}\"/>");
        }
    }
    let fill = if p.pareto { colour } else { "var(--paper)" };
    let value = |value: f64, axis: &Axis| format!("{} {}", ranged(value, p.range(&axis.label)), axis.label);
    let tip = escaped(&format!("{}: {}, {}", p.setting, value(p.x, x_axis), value(p.y, y_axis)));
    let _ = write!(out, "<circle r=\"4\" fill=\"{fill}\" stroke=\"{colour}\" stroke-width=\"1.6\"><title>{tip}</title></circle>");
    out
}

fn axes(out: &mut String, e: &Experiment, x: &Scale, y: &Scale) {
    for (v, at) in x.ticks() {
        let label = short(v);
        let _ = write!(out, "<path class=\"grid\" d=\"M{at:.1} {TOP}V{BOTTOM}\"/><text x=\"{at:.1}\" y=\"367\" class=\"x\">{label}</text>");
    }
    for (v, at) in y.ticks() {
        let label = short(v);
        let _ = write!(
            out,
            "<path class=\"grid\" d=\"M{LEFT} {at:.1}H{RIGHT}\"/><text x=\"62\" y=\"{at:.1}\" dy=\"4\" class=\"y\">{label}</text>"
        );
    }
    let name = |axis: &Axis, [less, more]: [&str; 2]| {
        let better = axis.up.map_or(String::new(), |up| format!(" ({} is better)", if up { more } else { less }));
        escaped(&format!("{}{better}", axis.label))
    };
    let _ = write!(
        out,
        "<text x=\"{:.0}\" y=\"390\" class=\"x\">{}</text><text transform=\"translate(16 {:.0}) rotate(-90)\" class=\"x\">{}</text>",
        f64::midpoint(LEFT, RIGHT),
        name(&e.x, ["left", "right"]),
        f64::midpoint(TOP, BOTTOM),
        name(&e.y, ["down", "up"])
    );
}

impl Experiment {
    /// Whether the points of a curve follow one number, so that a line between them is meaningful.
    fn joined(&self) -> bool {
        !["ramps", "denoise", "without", "discretisation"].contains(&self.id.as_str())
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
        let axis = |log| Axis::new("", log, None);
        for (values, log) in [(vec![27.3, 28.9], false), (vec![0.0, 0.0], false), (vec![3.0, 250.0], true), (vec![41.0, 47.0], true)] {
            let ticks = Scale::new(&axis(log), values.iter().copied(), (0.0, 100.0)).ticks();
            assert!((3..=14).contains(&ticks.len()), "{values:?}: {ticks:?}");
            assert!(ticks.iter().all(|&(_, at)| (-1e-6..=100.000_001).contains(&at)), "{values:?}: {ticks:?}");
        }
        let none = Scale::new(&axis(true), std::iter::empty(), (0.0, 1.0));
        assert_eq!(none.at(0.0), None);
    }

    #[test]
    fn numbers_and_text_are_formatted() {
        assert_eq!([0.0, 0.5, 12.345, 1234.5].map(number), ["0", "0.5000", "12.3", "1234"]);
        assert_eq!((ranged(12.345, None).as_str(), ranged(12.345, Some([9.0, 123.4])).as_str()), ("12.3", "12.3 (9.00–123)"));
        assert_eq!((short(20000.0).as_str(), short(0.3).as_str()), ("20k", "0.3"));
        assert_eq!(["--max-error 1", "--view-box 1,2,3 --verify-prune", "level 2"].map(brief), ["1", "1,2,3", "level 2"]);
        assert_eq!(escaped("<a&\"b\">"), "&lt;a&amp;&quot;b&quot;&gt;");
    }
}
