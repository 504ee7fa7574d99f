//! Collects results, and writes them after each experiment.

use std::path::Path;
use std::time::Instant;

use super::{Experiment, Machine, Results, Settings, html};
use crate::{LabError, files};

/// Results so far, written after each experiment.
pub(super) struct Log<'a> {
    pub settings: &'a Settings,
    pub results: Results,
    progress: &'a dyn Fn(&str),
    /// Until when the results count the seconds.
    start: Instant,
}

impl<'a> Log<'a> {
    pub fn new(settings: &'a Settings, progress: &'a dyn Fn(&str)) -> Result<Self, LabError> {
        let repeats = settings.flags.repeats.map_or(if settings.flags.quick { 3 } else { 5 }, usize::from);
        let results = Results { version: env!("CARGO_PKG_VERSION").into(), machine: Machine::this(), repeats, ..Results::default() };
        let path = settings.flags.output.join(RESULTS);
        let mut log = Self { settings, results, progress, start: Instant::now() };
        if settings.flags.resume && path.exists() {
            let before = files::read_json::<Results>(&path)?;
            if (&before.version, before.repeats) != (&log.results.version, log.results.repeats) {
                return Err(LabError::file(&path, "another version, or another `--quick` or `--repeats`, wrote it"));
            }
            log.results = Results { skipped: Vec::new(), ..before };
        }
        Ok(log)
    }

    /// Whether an experiment is asked for, and not among the kept ones.
    pub fn wants(&self, id: &str) -> bool {
        let asked = self.settings.flags.only.is_empty() || self.settings.flags.only.iter().any(|o| o == id);
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

    /// Runs and adds an experiment if it is asked for.
    pub fn run(&mut self, id: &str, experiment: impl FnOnce() -> Result<Experiment, LabError>) -> Result<(), LabError> {
        if self.starts(id) { self.add(experiment()?) } else { Ok(()) }
    }

    /// Adds an experiment, and writes all.
    pub fn add(&mut self, mut experiment: Experiment) -> Result<(), LabError> {
        experiment.mark();
        self.results.experiments.push(experiment);
        self.write()
    }

    pub fn write(&mut self) -> Result<(), LabError> {
        let now = Instant::now();
        self.results.seconds += now.duration_since(std::mem::replace(&mut self.start, now)).as_secs_f64();
        self.results.write(&self.settings.flags.output)
    }
}

const RESULTS: &str = "results.json";

impl Results {
    /// Writes the results, the page and the costs to a folder, which is created if needed.
    fn write(&self, folder: &Path) -> Result<(), LabError> {
        files::write_json(&folder.join(RESULTS), self)?;
        files::write(&folder.join("index.html"), html(self).as_bytes())?;
        self.costs.as_ref().map_or(Ok(()), |costs| files::write_json(&folder.join("costs.json"), costs))
    }
}

#[cfg(test)]
mod tests {
    use super::super::Flags;
    use super::super::tests::experiment;
    use super::*;
    use crate::oracle_depth;

    #[test]
    fn results_are_resumed_and_the_page_has_all_points() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("bench");
        let flags = Flags { quick: true, photos: Vec::new(), only: Vec::new(), output, resume: true, repeats: None };
        let with = |flags| Settings { flags, models: oracle_depth::none(), networks: tmpi_pipeline::networks::models::Settings::default() };
        let settings = with(flags.clone());
        let mut log = Log::new(&settings, &|_| {}).unwrap();
        assert!(log.wants("e") && log.wants("f"));
        log.results.skipped.push("gpu: none & nothing".into());
        let mut measured = experiment(&[(1.0, 10.0), (20.0, 30.0)]);
        measured.curves[0].points[1].ranges = vec![("ms".into(), [18.0, 25.0])];
        log.add(measured).unwrap();
        let page = std::fs::read_to_string(flags.output.join("index.html")).unwrap();
        assert!(page.contains("about &lt;it&gt;") && page.contains("none &amp; nothing") && page.matches("<circle").count() >= 2);
        assert!(page.contains("<td>20.0 (18.0–25.0)") && page.matches("class=\"range\"").count() == 1, "times have their range");
        assert!(!page.contains("http://") || page.contains("http://www.w3.org/2000/svg"), "the page makes no requests");
        let again = Log::new(&settings, &|_| {}).unwrap();
        assert!(!again.wants("e") && again.wants("f"));
        assert_eq!(again.results.experiments[0].curves[0].points.len(), 2);
        assert!(Log::new(&with(Flags { resume: false, ..flags.clone() }), &|_| {}).unwrap().wants("e"));
        assert!(Log::new(&with(Flags { quick: false, ..flags.clone() }), &|_| {}).is_err(), "results of other settings are not mixed");
        assert!(Log::new(&with(Flags { repeats: Some(2), ..flags }), &|_| {}).is_err(), "nor those of other numbers of runs");
    }
}
