//! Collects results, and writes them after each experiment.

use std::path::Path;
use std::time::Instant;

use super::{BenchError, Experiment, Machine, Results, Settings, html};

/// Results so far, written after each experiment.
pub(super) struct Log<'a> {
    pub settings: &'a Settings,
    pub results: Results,
    progress: &'a dyn Fn(&str),
    /// Until when the results count the seconds.
    start: Instant,
}

impl<'a> Log<'a> {
    pub fn new(settings: &'a Settings, progress: &'a dyn Fn(&str)) -> Result<Self, BenchError> {
        let results = Results {
            version: env!("CARGO_PKG_VERSION").into(),
            machine: Machine::this(),
            subjects: Vec::new(),
            repeats: if settings.quick { 3 } else { 5 },
            experiments: Vec::new(),
            costs: None,
            skipped: Vec::new(),
            seconds: 0.0,
        };
        let path = settings.output.join(RESULTS);
        let mut log = Self { settings, results, progress, start: Instant::now() };
        if settings.resume && path.exists() {
            let before = Results::read(&path)?;
            if (&before.version, before.repeats) != (&log.results.version, log.results.repeats) {
                return Err(BenchError::File { path, reason: "another version or another `--quick` wrote it".into() });
            }
            log.results = Results { skipped: Vec::new(), ..before };
        }
        Ok(log)
    }

    /// Whether an experiment is asked for, and not among the kept ones.
    pub fn wants(&self, id: &str) -> bool {
        let asked = self.settings.only.is_empty() || self.settings.only.iter().any(|o| o == id);
        asked && !self.results.experiments.iter().any(|e| e.id == id)
    }

    /// The same, and tells the user if so.
    pub fn starts(&self, id: &str) -> bool {
        let wants = self.wants(id);
        if wants {
            (self.progress)(id);
        }
        wants
    }

    pub fn skip(&mut self, reason: String) {
        self.results.skipped.push(reason);
    }

    /// Adds an experiment, and writes all.
    pub fn add(&mut self, mut experiment: Experiment) -> Result<(), BenchError> {
        experiment.mark();
        self.results.experiments.push(experiment);
        self.write()
    }

    pub fn write(&mut self) -> Result<(), BenchError> {
        let now = Instant::now();
        self.results.seconds += now.duration_since(std::mem::replace(&mut self.start, now)).as_secs_f64();
        self.results.write(&self.settings.output)
    }
}

/// File of the results in their folder.
const RESULTS: &str = "results.json";

impl Results {
    fn read(path: &Path) -> Result<Self, BenchError> {
        let bad = |reason: String| BenchError::File { path: path.to_owned(), reason };
        let bytes = std::fs::read(path).map_err(|e| bad(e.to_string()))?;
        serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))
    }

    /// Writes the results, the page and the costs to a folder, which is created if needed.
    fn write(&self, folder: &Path) -> Result<(), BenchError> {
        let write = |name: &str, bytes: Vec<u8>| {
            let path = folder.join(name);
            let done = std::fs::create_dir_all(folder).and_then(|()| std::fs::write(&path, bytes));
            done.map_err(|e| BenchError::File { path, reason: e.to_string() })
        };
        let json =
            |value: serde_json::Result<Vec<u8>>| value.map_err(|e| BenchError::File { path: folder.join(RESULTS), reason: e.to_string() });
        write(RESULTS, json(serde_json::to_vec_pretty(self))?)?;
        write("index.html", html(self).into_bytes())?;
        self.costs.as_ref().map_or(Ok(()), |costs| write("costs.json", json(serde_json::to_vec_pretty(costs))?))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "test")]

    use super::super::tests::experiment;
    use super::*;
    use tmpi_pipeline::Models;

    #[test]
    fn results_are_resumed_and_the_page_has_all_points() {
        let folder = tempfile::tempdir().unwrap();
        let models = Models { depth: std::sync::Arc::new(crate::oracle_depth::OracleDepth(none())), theta: None, psi: None };
        let networks = tmpi_pipeline::networks::models::Settings::default();
        let output = folder.path().join("bench");
        let settings = Settings { quick: true, photos: Vec::new(), only: Vec::new(), output, resume: true, models, networks };
        let mut log = Log::new(&settings, &|_| {}).unwrap();
        assert!(log.wants("e") && log.wants("f"));
        log.skip("gpu: none & nothing".into());
        log.add(experiment(&[(1.0, 10.0), (20.0, 30.0)])).unwrap();
        let page = std::fs::read_to_string(settings.output.join("index.html")).unwrap();
        assert!(page.contains("about &lt;it&gt;") && page.contains("none &amp; nothing") && page.matches("<circle").count() >= 2);
        assert!(!page.contains("http://") || page.contains("http://www.w3.org/2000/svg"), "the page makes no requests");
        let again = Log::new(&settings, &|_| {}).unwrap();
        assert!(!again.wants("e") && again.wants("f"));
        assert_eq!(again.results.experiments[0].curves[0].points.len(), 2);
        assert!(Log::new(&Settings { resume: false, ..settings.clone() }, &|_| {}).unwrap().wants("e"));
        assert!(Log::new(&Settings { quick: false, ..settings }, &|_| {}).is_err(), "results of other settings are not mixed");
    }

    fn none() -> tmpi_core::DisparityMap {
        tmpi_core::DisparityMap { width: 0, height: 0, delta: Vec::new() }
    }
}
