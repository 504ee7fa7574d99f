//! Writes the results as a self-contained page.

use std::fmt::Write;

use super::plot::{escaped, number, ranged, svg};
use super::{Experiment, Results};

const STYLE: &str = "
:root{color-scheme:light dark;--ink:#1b1d22;--soft:#5d636e;--paper:#fff;--line:#e3e5ea;--mark:#f4f6f9}
@media(prefers-color-scheme:dark){:root{--ink:#e9ebef;--soft:#9aa1ad;--paper:#15171b;--line:#2c3038;--mark:#1d2026}}
*{box-sizing:border-box}
body{margin:0 auto;padding:2rem 1.25rem 4rem;max-width:60rem;font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper)}
h1{font-size:1.7rem;margin:0 0 .25rem}h2{font-size:1.2rem;margin:2.75rem 0 .25rem}
p{margin:.25rem 0 .75rem;color:var(--soft);max-width:46rem}
nav{display:flex;flex-wrap:wrap;gap:.25rem 1rem;margin:1rem 0;font-size:.95rem}a{color:inherit}
svg{width:100%;height:auto;display:block}svg text{font-size:12px;fill:var(--soft)}svg .own{fill:var(--ink);font-weight:600}svg .of{font-size:10.5px}
.grid{stroke:var(--line)}.x{text-anchor:middle}.y{text-anchor:end}
details{margin:.5rem 0}summary{cursor:pointer;color:var(--soft)}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.85rem;font-variant-numeric:tabular-nums;white-space:nowrap}
th,td{padding:.2rem .7rem;text-align:right;border-bottom:1px solid var(--line)}th:first-child,td:first-child,th:nth-child(2),td:nth-child(2){text-align:left}
ul{padding-left:1.2rem;max-width:46rem;color:var(--soft)}
th{font-weight:600;color:var(--soft)}tr.default{background:var(--mark);font-weight:600}
dl{display:grid;grid-template-columns:max-content 1fr;gap:.1rem 1rem;font-size:.95rem}dt{color:var(--soft)}dd{margin:0}
";

const READING: &str = "<h2>How to read the plots</h2><ul>\
<li>A point is one setting: the mean over all scenes. Hover over it for the setting and its figures.</li>\
<li>A ring with the word “default” is the setting that is used where nothing is said.</li>\
<li>The words at the axes say which side is better.</li>\
<li>A filled point: no other setting is better in both directions. If the default is not filled, another setting may be the better choice.</li>\
<li>A vertical bar is one standard deviation over the scenes: how much scenes differ, not how far the mean is from the truth.</li>\
<li>A bar with ends goes from the mean of each scene's fastest run to the mean of its slowest one: how far repeated times are apart. If you \
see none beside a time, it is shorter than the point. Tables have it in brackets.</li>\
<li>“All figures” below a plot opens a table of everything that was measured.</li></ul>\
<details><summary>What the figures mean</summary><dl>\
<dt>view, dB</dt><dd>A scene is made of one photo and drawn from other places, where the exact picture is known: PSNR against that, without the outer 15 % on \
each side. 1 dB more is a tenth less error.</dd>\
<dt>view from ahead, dB</dt><dd>That of the one view from nearer, at the front of the default view box.</dd>\
<dt>processing, ms</dt><dd>Wall time from the disparity map to the container: without reading the photo, the depth network and the measuring of errors.</dd>\
<dt>parallax error, px</dt><dd>Pixels between where planes show a point and where the disparity map has it, by the camera of the view box that shows them the \
farthest apart; mean over the photo.</dd>\
<dt>disparity error</dt><dd>Mean distance of the network's disparity from the true one, after the best scale and shift; disparity runs from 0 (infinitely far) to 1 \
(the nearest point).</dd>\
<dt>container, KB</dt><dd>What a viewer downloads.</dd></dl></details>";

pub fn html(r: &Results) -> String {
    let m = &r.machine;
    let mut out = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>tmpi-lab bench</title><style>{STYLE}</style><h1>tmpi-lab bench</h1>\
         <p>Each plot varies one option of <code>tmpi make</code> and shows what it costs and what error it leaves.</p>{READING}<dl>"
    );
    let gigabytes = m.memory as f64 / 1e9;
    let load = m.load.map_or(String::new(), |l| format!(", load {l:.1} at the end"));
    let times = match r.repeats {
        0 | 1 => "of one run".to_owned(),
        n => format!(
            "medians of {n} runs, in turns with those of other settings, or of 2 if a run takes more than a second; means over all scenes"
        ),
    };
    let facts = [
        ("Machine", format!("{}, {} threads, {gigabytes:.1} GB, {}{load}", m.processor, m.threads, m.system)),
        ("Program", format!("tmpi {}", r.version)),
        ("Measured on", r.subjects.join(", ")),
        ("Times", times),
        ("Duration", format!("{:.0} s", r.seconds)),
    ];
    for (name, value) in facts {
        // writing to a String cannot fail
        let _ = write!(out, "<dt>{name}</dt><dd>{}</dd>", escaped(&value));
    }
    for s in &r.skipped {
        let _ = write!(out, "<dt>Skipped</dt><dd>{}</dd>", escaped(s));
    }
    out += "</dl><nav>";
    for e in &r.experiments {
        let _ = write!(out, "<a href=\"#{}\">{}</a>", e.id, escaped(&e.title));
    }
    out += "</nav>";
    for e in &r.experiments {
        let _ = write!(out, "<h2 id=\"{}\">{}</h2><p>{}</p>", e.id, escaped(&e.title), escaped(&e.about));
        if e.curves.iter().map(|c| c.points.len()).sum::<usize>() > 1 {
            out += &svg(e);
        }
        out += &table(e);
    }
    out + "</html>\n"
}

fn table(e: &Experiment) -> String {
    let points = || e.curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p)));
    let mut names: Vec<&str> = vec![&*e.x.label, &*e.y.label];
    for (name, _) in points().flat_map(|(_, p)| &p.figures) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let open = if points().count() <= 1 { " open" } else { "" };
    let y = escaped(&e.y.label);
    let mut out = format!("<details{open}><summary>All figures</summary><div class=\"wide\"><table><tr><th>curve<th>setting<th>± {y}");
    for n in &names {
        let _ = write!(out, "<th>{}", escaped(n));
    }
    for (c, p) in points() {
        let class = if p.default { " class=\"default\"" } else { "" };
        let _ = write!(out, "<tr{class}><td>{}<td>{}<td>{}", escaped(&c.name), escaped(&p.setting), number(p.spread));
        for (i, n) in names.iter().enumerate() {
            let value = [p.x, p.y].get(i).copied().or_else(|| p.figures.iter().find(|f| f.0 == *n).map(|f| f.1));
            let _ = write!(out, "<td>{}", value.map_or(String::new(), |v| ranged(v, p.range(n))));
        }
    }
    out + "</table></div></details>"
}
