use std::sync::Arc;

use super::*;
use crate::server::Limits;
use crate::server::exports::Recipe;
use tmpi_core::{DisparityMap, Photo};
use tmpi_pipeline::{Models, Progress, Silent};

fn maker(command: fn() -> io::Result<Command>, data: &Path) -> ProcessMaker {
    let flat = ("flat", |photo: &Photo| Ok(DisparityMap::from_fn(photo.width, photo.height, |_, _| 0.5)));
    let checks = PipelineMaker::new(Models { depth: Arc::new(flat), theta: None, psi: None }, Limits::default().photo());
    let scratch = scratch::folder(data);
    ProcessMaker { checks, idle: Mutex::default(), command: Box::new(command), scratch, better: None, renewed: OnceLock::new() }
}

fn fault(command: fn() -> io::Result<Command>) -> Fault {
    let dir = tempfile::tempdir().unwrap();
    let maker = maker(command, dir.path());
    let fault = maker.make(b"a photo", None, &Options::default(), &Silent).unwrap_err();
    assert!(maker.idle.lock().unwrap().is_empty(), "such a process is not kept");
    fault
}

fn shell(script: &str) -> Command {
    let mut command = Command::new("sh");
    command.args(["-c", script]);
    command
}

#[test]
fn credentials_are_not_passed_on() {
    for name in ["AWS_SECRET_ACCESS_KEY", "OTEL_EXPORTER_OTLP_HEADERS", "TMPI_SERVE_DATABASE"] {
        assert!(!is_passed(OsStr::new(name)), "{name}");
    }
    assert!(is_passed(OsStr::new("TMPI_MODELS")) && is_passed(OsStr::new("LD_LIBRARY_PATH")));
}

#[cfg(target_os = "linux")]
#[test]
#[allow(unsafe_code, reason = "a call of libc without memory of ours")]
fn other_processes_cannot_read_the_memory_of_the_server() {
    disable_process_inspection();
    // SAFETY: it takes no pointer
    assert_eq!(unsafe { libc::prctl(libc::PR_GET_DUMPABLE, 0, 0, 0, 0) }, 0);
}

#[test]
fn invalid_answers_of_a_process_fail_only_its_photo() {
    // no message, an unknown one, an invalid report, a photo without files, a file for a photo, an endless file, and an early end
    let all: [fn() -> io::Result<Command>; 7] = [
        || Ok(shell("echo a line of some length; cat > /dev/null")),
        || Ok(shell(r#"echo '["Unknown",[]]'; cat > /dev/null"#)),
        || Ok(shell(r#"echo '[{"Made":null},[]]'; cat > /dev/null"#)),
        || {
            let made = serde_json::to_string(&Answer::Made(Box::default())).unwrap();
            Ok(shell(&format!("echo '[{made},[]]'; cat > /dev/null")))
        },
        || Ok(shell(r#"echo '[{"Written":1},[2]]'; echo 1; cat > /dev/null"#)),
        || Ok(shell(r#"echo '[{"Written":1},[2000000000]]'; cat > /dev/null"#)),
        || Ok(shell("exit 0")),
    ];
    for command in all {
        let fault = fault(command);
        assert!(matches!(fault, Fault::Crashed(_)), "{fault:?}");
    }
    let none = fault(|| Err(io::Error::other("no program")));
    assert!(matches!(none, Fault::Server(_)), "{none:?}");
}

#[test]
fn an_idle_process_ends_after_its_timeout() {
    let dir = tempfile::tempdir().unwrap();
    let maker = maker(|| Ok(shell("cat > /dev/null")), dir.path());
    maker.prepare();
    assert!(!maker.release_idle_memory(Duration::ZERO), "one that has made none is small");
    let ids = || maker.idle.lock().unwrap().iter().map(|worker| worker.child.id()).collect::<Vec<_>>();
    let before = ids();
    maker.idle.lock().unwrap()[0].made = Some(Instant::now());
    assert!(!maker.release_idle_memory(Duration::from_hours(1)) && ids() == before);
    assert!(maker.release_idle_memory(Duration::ZERO));
    assert!(ids().len() == 1 && ids() != before, "another waits in its place");
}

/// Cancelled once a process has written a line to this file.
#[cfg(target_os = "linux")]
struct Once<'a>(&'a Path);

#[cfg(target_os = "linux")]
impl Sink for Once<'_> {
    fn progress(&self, _: &Progress) {}

    fn cancelled(&self) -> bool {
        std::fs::read_to_string(self.0).is_ok_and(|text| text.ends_with('\n'))
    }
}

#[cfg(target_os = "linux")]
#[test]
fn children_of_a_process_end_with_it_and_its_temporary_files_are_removed() {
    let runs = |id: &str| {
        let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
        // a zombie counts as ended, since nothing may wait for it here
        stat.rsplit_once(')').is_some_and(|(_, rest)| !rest.trim_start().starts_with('Z'))
    };
    // one that is killed and one that ends on its own, each with a running child and a folder left behind
    let all: [fn() -> io::Result<Command>; 2] = [
        || Ok(shell(r#"read -r line; sleep 600 > /dev/null & mkdir "$TMPDIR/film"; echo $! > "$TMPDIR/../../id"; cat > /dev/null"#)),
        || Ok(shell(r#"read -r line; sleep 600 > /dev/null & mkdir "$TMPDIR/film"; echo $! > "$TMPDIR/../../id"; kill -9 $$"#)),
    ];
    for (n, command) in all.into_iter().enumerate() {
        let dir = tempfile::tempdir().unwrap();
        let maker = maker(command, dir.path());
        let scratch = maker.scratch.clone();
        let told = dir.path().join("id");
        let recipe = Recipe::parse("format=zip", &Limits::default()).unwrap();
        // the folder exists before anything is sent
        let work = ExportTask { recipe: &recipe, container: b"line\n", drawing: &|| Err(String::new()), is_low_priority: true };
        let fault = if n == 0 { maker.export(&work, &Once(&told)) } else { maker.export(&work, &Silent) }.unwrap_err();
        assert!(matches!((n, &fault), (0, Fault::Cancelled) | (1, Fault::Crashed(_))), "{fault:?}");
        let id = std::fs::read_to_string(&told).unwrap();
        let id = id.trim();
        assert!(id.parse::<u32>().is_ok(), "{id}");
        let end = Instant::now() + Duration::from_secs(20);
        while runs(id) {
            assert!(Instant::now() < end, "what it started outlives it");
            std::thread::sleep(TICK);
        }
        assert_eq!(std::fs::read_dir(&scratch).unwrap().count(), 0);
    }
}

#[test]
fn leftovers_of_earlier_processes_are_removed_at_the_start() {
    let dir = tempfile::tempdir().unwrap();
    remove_leftovers(dir.path()).unwrap();
    let left = scratch::folder(dir.path()).join("7/film");
    std::fs::create_dir_all(&left).unwrap();
    remove_leftovers(dir.path()).unwrap();
    assert!(!left.exists() && dir.path().exists());
}
