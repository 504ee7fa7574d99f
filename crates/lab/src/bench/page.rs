//! Writes the results as a self-contained page.

use std::fmt::Write;

use super::plot::{escaped, number, svg};
use super::{Experiment, Results};

const STYLE: &str = "
:root{color-scheme:light dark;--ink:#1b1d22;--soft:#5d636e;--paper:#fff;--line:#e3e5ea;--mark:#f4f6f9}
@media(prefers-color-scheme:dark){:root{--ink:#e9ebef;--soft:#9aa1ad;--paper:#15171b;--line:#2c3038;--mark:#1d2026}}
*{box-sizing:border-box}
body{margin:0 auto;padding:2rem 1.25rem 4rem;max-width:60rem;font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper)}
h1{font-size:1.7rem;margin:0 0 .25rem}h2{font-size:1.2rem;margin:2.75rem 0 .25rem}
p{margin:.25rem 0 .75rem;color:var(--soft);max-width:46rem}
nav{display:flex;flex-wrap:wrap;gap:.25rem 1rem;margin:1rem 0;font-size:.95rem}a{color:inherit}
svg{width:100%;height:auto;display:block}svg text{font-size:12px;fill:var(--soft)}
.grid{stroke:var(--line)}.front{fill:none;stroke:var(--soft);stroke-width:1.2;stroke-dasharray:2 4}
details{margin:.5rem 0}summary{cursor:pointer;color:var(--soft)}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.85rem;font-variant-numeric:tabular-nums;white-space:nowrap}
th,td{padding:.2rem .7rem;text-align:right;border-bottom:1px solid var(--line)}th:first-child,td:first-child,th:nth-child(2),td:nth-child(2){text-align:left}
th{font-weight:600;color:var(--soft)}tr.default{background:var(--mark);font-weight:600}
dl{display:grid;grid-template-columns:max-content 1fr;gap:.1rem 1rem;font-size:.95rem}dt{color:var(--soft)}dd{margin:0}
";

/// The results as an HTML page.
#[must_use]
pub fn html(r: &Results) -> String {
    let m = &r.machine;
    let mut out = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>tmpi-lab bench</title><style>{STYLE}</style><h1>tmpi-lab bench</h1>\
         <p>Cost and error of each approximation. No other setting of a plot is better on both axes than a filled point; a dotted line \
         joins these. A ring marks the defaults, a bar one standard deviation over the scenes. Hover over a point for its setting.</p><dl>"
    );
    let gigabytes = m.memory as f64 / 1e9;
    let load = m.load.map_or(String::new(), |l| format!(", load {l:.1} at the end"));
    let facts = [
        ("Machine", format!("{}, {} threads, {gigabytes:.1} GB, {}{load}", m.processor, m.threads, m.system)),
        ("Program", format!("tmpi {}", r.version)),
        ("Measured on", r.subjects.join(", ")),
        ("Times", format!("medians of {} runs, means over all scenes", r.repeats)),
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
    let mut names: Vec<&str> = vec![e.x.label, e.y.label];
    for (name, _) in e.curves.iter().flat_map(|c| &c.points).flat_map(|p| &p.figures) {
        if !names.contains(name) {
            names.push(name);
        }
    }
    let few = e.curves.iter().map(|c| c.points.len()).sum::<usize>() <= 1;
    let mut out = format!(
        "<details{}><summary>All figures</summary><div class=\"wide\"><table><tr><th>curve<th>setting<th>± {}",
        if few { " open" } else { "" },
        escaped(e.y.label)
    );
    for n in &names {
        let _ = write!(out, "<th>{}", escaped(n));
    }
    for (c, p) in e.curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p))) {
        let class = if p.default { " class=\"default\"" } else { "" };
        let _ = write!(out, "<tr{class}><td>{}<td>{}", escaped(&c.name), escaped(&p.setting));
        let _ = write!(out, "<td>{}", number(p.spread));
        for n in &names {
            let value = match *n {
                n if n == e.x.label => Some(p.x),
                n if n == e.y.label => Some(p.y),
                n => p.figures.iter().find(|f| f.0 == n).map(|f| f.1),
            };
            let _ = write!(out, "<td>{}", value.map_or(String::new(), number));
        }
    }
    out + "</table></div></details>"
}
