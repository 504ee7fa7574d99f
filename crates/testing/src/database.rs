//! A PostgreSQL server for this test program, in a temporary folder, with one database per test.

use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

/// The server ends when its standard input closes: when this process ends in any way.
const SCRIPT: &str = r#"
"$1/initdb" -D "$2/db" -U postgres -A trust --no-sync > "$2/log" 2>&1 || exit 1
"$1/postgres" -D "$2/db" -k "$2" -c listen_addresses= -c fsync=off -c max_connections=400 >> "$2/log" 2>&1 &
server=$!
read -r _
kill -QUIT $server
wait $server
rm -rf "$2"
"#;
/// Longest wait for the server.
const START: Duration = Duration::from_mins(2);

#[derive(Debug)]
struct Server {
    programs: PathBuf,
    folder: PathBuf,
    // its standard input stays open
    _process: Child,
}

/// User and group for the server if this process runs as root, which PostgreSQL refuses.
fn unprivileged(folder: &Path) -> Option<(u32, u32)> {
    let users = std::fs::read_to_string("/etc/passwd").ok()?;
    let of = |name: &str| {
        let line = users.lines().find(|line| line.split(':').next() == Some(name))?;
        let mut fields = line.split(':').skip(2);
        Some((fields.next()?.parse().ok()?, fields.next()?.parse().ok()?))
    };
    let is_root = std::fs::metadata(folder).is_ok_and(|of| std::os::unix::fs::MetadataExt::uid(&of) == 0);
    is_root.then(|| of("postgres").or_else(|| of("nobody")))?
}

fn start() -> Option<Server> {
    let programs = crate::postgres()?;
    let folder = tempfile::Builder::new().prefix("tmpi-pg").tempdir().expect("a folder").keep();
    let mut command = Command::new("sh");
    command.arg("-c").arg(SCRIPT).arg("sh").arg(&programs).arg(&folder);
    if let Some((user, group)) = unprivileged(&folder) {
        std::os::unix::fs::chown(&folder, Some(user), Some(group)).expect("the folder is given away");
        command.gid(group).uid(user);
    }
    let process = command.current_dir(&folder).stdin(Stdio::piped()).stdout(Stdio::null()).spawn().expect("a shell");
    Some(Server { programs, folder, _process: process })
}

/// URL of an empty database; `None` without PostgreSQL, so that the test is skipped.
pub fn database() -> Option<String> {
    static SERVER: OnceLock<Option<Server>> = OnceLock::new();
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let Some(server) = SERVER.get_or_init(start) else {
        // lists this test as skipped, too
        return crate::postgres().and(None);
    };
    let name = format!("test_{}", NEXT.fetch_add(1, Ordering::Relaxed));
    let until = Instant::now() + START;
    let create = || {
        let mut command = Command::new(server.programs.join("createdb"));
        command.arg("-h").arg(&server.folder).args(["-U", "postgres", &name]).stdout(Stdio::null()).stderr(Stdio::null());
        command.status().expect("createdb").success()
    };
    while !create() {
        let log = std::fs::read_to_string(server.folder.join("log")).unwrap_or_default();
        assert!(Instant::now() < until, "PostgreSQL does not start: {log}");
        std::thread::sleep(Duration::from_millis(50));
    }
    Some(format!("postgres://postgres@localhost/{name}?host={}", server.folder.display()))
}
