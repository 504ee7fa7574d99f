//! Downloads model files. Broken downloads are resumed, and a file is kept only if it is complete and has the right digest.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::Duration;

use sha2::{Digest as _, Sha256};

/// Largest file that is fetched if its size is unknown, in bytes.
const MOST: u64 = 4 << 30;
/// Longest time to resolve a name, and to connect: without a network, users should not have to wait.
const CONNECT: Duration = Duration::from_secs(3);
/// Longest time until a server answers, and until it sends the next piece.
const PATIENCE: Duration = Duration::from_secs(30);

/// A SHA-256 digest, written and read as 64 hexadecimal digits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Digest([u8; 32]);

impl FromStr for Digest {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?} is not a SHA-256 digest of 64 hexadecimal digits");
        if text.len() != 64 || !text.is_ascii() {
            return Err(wrong());
        }
        let mut bytes = [0; 32];
        for (i, b) in bytes.iter_mut().enumerate() {
            *b = u8::from_str_radix(&text[2 * i..2 * i + 2], 16).map_err(|_| wrong())?;
        }
        Ok(Self(bytes))
    }
}

impl std::fmt::Display for Digest {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

/// A file to fetch.
#[derive(Clone, Copy, Debug)]
pub struct RemoteFile<'a> {
    /// HTTP or HTTPS address.
    pub url: &'a str,
    /// Size in bytes, if known.
    pub bytes: Option<u64>,
    /// Digest that the file must have.
    pub sha256: Digest,
}

/// Why a file could not be fetched.
#[derive(Debug, thiserror::Error)]
pub enum DownloadError {
    /// No answer, or a broken connection. The bytes so far are kept, and the next call resumes.
    #[error("{url}: {reason}")]
    Http {
        /// Address.
        url: String,
        /// What went wrong.
        reason: String,
    },
    /// The server refuses.
    #[error("{url}: the server answers {status}")]
    Status {
        /// Address.
        url: String,
        /// HTTP status.
        status: u16,
    },
    /// The connection ended before the file did. The bytes so far are kept, and the next call resumes.
    #[error("the download broke off after {have} of {want} bytes; run it again to resume")]
    Truncated {
        /// Bytes so far.
        have: u64,
        /// Bytes of the file.
        want: u64,
    },
    /// The server sends another size than expected; nothing is kept.
    #[error("the server sends {got} bytes, expected {want}")]
    Size {
        /// Bytes of the file.
        want: u64,
        /// Bytes of the answer.
        got: u64,
    },
    /// The file is not the expected one; nothing is kept.
    #[error("the file has the SHA-256 digest {got}, expected {want}: it is damaged or another file, and was deleted")]
    Corrupt {
        /// Expected digest.
        want: Digest,
        /// Digest of the received file.
        got: Digest,
    },
    /// A local file cannot be read or written.
    #[error("{file}: {source}")]
    File {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

/// Fetches `wanted` to the file `to`, by way of a file beside it that ends in `.part`. Returns true if it fetched bytes, and false if the
/// file was already there. Calls `progress` with the number of bytes so far and, if known, that of the whole file.
///
/// # Errors
/// [`DownloadError`]; the file `to` stays as it was.
pub fn fetch(wanted: &RemoteFile<'_>, to: &Path, progress: impl FnMut(u64, Option<u64>)) -> Result<bool, DownloadError> {
    fetch_within(PATIENCE, sync, wanted, to, progress)
}

/// Makes a rename within a folder durable.
fn sync(folder: &Path) -> io::Result<()> {
    // other systems cannot open folders as files
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}

fn fetch_within(
    patience: Duration,
    sync: impl Fn(&Path) -> io::Result<()>,
    wanted: &RemoteFile<'_>,
    to: &Path,
    mut progress: impl FnMut(u64, Option<u64>),
) -> Result<bool, DownloadError> {
    let on = |file: &Path| {
        let file = file.to_owned();
        move |source| DownloadError::File { file, source }
    };
    if to.is_file() && digest(to).map_err(on(to))? == wanted.sha256 {
        return Ok(false);
    }
    if let Some(folder) = to.parent().filter(|f| !f.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(on(folder))?;
    }
    let mut name = to.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = to.with_file_name(name);
    let mut have = part.metadata().map_or(0, |m| m.len());
    if wanted.bytes.is_some_and(|want| have > want) {
        have = 0;
    }
    if have == 0 || Some(have) != wanted.bytes {
        transfer(patience, wanted, &part, have, &mut progress)?;
    }
    let got = digest(&part).map_err(on(&part))?;
    if got != wanted.sha256 {
        std::fs::remove_file(&part).map_err(on(&part))?;
        return Err(DownloadError::Corrupt { want: wanted.sha256, got });
    }
    std::fs::rename(&part, to).map_err(on(to))?;
    // a name is durable once its folder is synced
    let folder = to.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
    sync(folder).map_err(on(folder))?;
    Ok(true)
}

/// Appends the missing bytes to `part`, which has `have` bytes.
fn transfer(
    patience: Duration,
    wanted: &RemoteFile<'_>,
    part: &Path,
    have: u64,
    progress: &mut impl FnMut(u64, Option<u64>),
) -> Result<(), DownloadError> {
    let broken = |reason: String| DownloadError::Http { url: wanted.url.to_owned(), reason };
    let on = |source| DownloadError::File { file: part.to_owned(), source };
    let agent: ureq::Agent = ureq::Agent::config_builder()
        // the connect timeout starts once the name is resolved
        .timeout_resolve(Some(CONNECT.min(patience)))
        .timeout_connect(Some(CONNECT.min(patience)))
        .timeout_recv_response(Some(patience))
        .http_status_as_error(false)
        .user_agent(concat!("tmpi/", env!("CARGO_PKG_VERSION")))
        .build()
        .into();
    let mut request = agent.get(wanted.url);
    if have > 0 {
        request = request.header("Range", format!("bytes={have}-"));
    }
    let response = request.call().map_err(|e| broken(e.to_string()))?;
    let status = response.status().as_u16();
    // only an answer that begins where this file ends continues it
    let from = response.headers().get("content-range").and_then(|v| v.to_str().ok());
    let goes_on = status == 206 && from.is_some_and(|v| v.starts_with(&format!("bytes {have}-")));
    if status == 416 || (status == 206 && !goes_on) {
        // this part does not fit the server's file: the next call starts over
        std::fs::remove_file(part).map_err(on)?;
    }
    if !(status == 200 || goes_on) {
        return Err(DownloadError::Status { url: wanted.url.to_owned(), status });
    }
    let have = if goes_on { have } else { 0 };
    let length = response.headers().get("content-length").and_then(|v| v.to_str().ok()?.parse::<u64>().ok());
    let total = length.map(|l| l.saturating_add(have));
    let most = wanted.bytes.or(total).unwrap_or(MOST);
    if let (Some(got), Some(want)) = (total, wanted.bytes)
        && got != want
    {
        return Err(DownloadError::Size { want, got });
    }
    let mut file = OpenOptions::new().create(true).append(goes_on).write(true).truncate(!goes_on).open(part).map_err(on)?;
    let pieces = pieces(response.into_body().into_with_config().limit(u64::MAX).reader()).map_err(|e| broken(e.to_string()))?;
    let mut at = have;
    let cut = loop {
        progress(at, wanted.bytes.or(total));
        match pieces.recv_timeout(patience) {
            Err(RecvTimeoutError::Disconnected) => break None,
            Err(RecvTimeoutError::Timeout) => {
                break Some(io::Error::new(io::ErrorKind::TimedOut, format!("no data for {patience:?}")));
            }
            Ok(Ok(piece)) => {
                at += piece.len() as u64;
                if at > most {
                    drop(file);
                    std::fs::remove_file(part).map_err(on)?;
                    return Err(DownloadError::Size { want: most, got: at });
                }
                file.write_all(&piece).map_err(on)?;
            }
            Ok(Err(e)) => break Some(e),
        }
    };
    file.sync_all().map_err(on)?;
    match (cut, wanted.bytes.or(total)) {
        (_, Some(want)) if at < want => Err(DownloadError::Truncated { have: at, want }),
        (Some(e), None) => Err(broken(e.to_string())),
        _ => Ok(()),
    }
}

/// Receives a body piece by piece, and its error, if any, at the end. A thread reads the body, because a read cannot be cancelled but
/// waiting for it can. The thread ends with the process.
fn pieces(mut body: impl Read + Send + 'static) -> io::Result<Receiver<io::Result<Vec<u8>>>> {
    let (send, pieces) = sync_channel(4);
    std::thread::Builder::new().name("tmpi-download".into()).spawn(move || {
        let mut buffer = vec![0; 1 << 16];
        loop {
            let piece = match body.read(&mut buffer) {
                Ok(0) => return,
                Ok(n) => Ok(buffer[..n].to_vec()),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                Err(e) => Err(e),
            };
            let last = piece.is_err();
            if send.send(piece).is_err() || last {
                return;
            }
        }
    })?;
    Ok(pieces)
}

/// Digest of a file's contents.
fn digest(file: &Path) -> io::Result<Digest> {
    let (mut file, mut hash, mut buffer) = (File::open(file)?, Sha256::new(), vec![0; 1 << 16]);
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(Digest(hash.finalize().into())),
            n => hash.update(&buffer[..n]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex};

    use tmpi_testing::{Answer, Request, StandIn};

    /// How the server misbehaves.
    #[derive(Clone, Copy, PartialEq)]
    enum Mood {
        Well,
        /// Announces everything and sends half of it.
        Cuts,
        /// Changes a byte in the middle.
        Spoils,
        /// Ignores ranges.
        Whole,
        /// Announces everything, sends half of it, and then neither sends nor closes.
        Stalls,
        /// Sends one byte too many.
        Longer,
        Refuses,
    }

    struct Case {
        server: StandIn,
        mood: Arc<Mutex<Mood>>,
        content: Vec<u8>,
        folder: tempfile::TempDir,
        sha256: Digest,
    }

    /// The first byte that a request asks for.
    fn from(request: &Request) -> Option<u64> {
        request.header("range").strip_prefix("bytes=")?.trim_end_matches('-').parse().ok()
    }

    fn answer(request: &Request, content: &[u8], mood: Mood) -> Answer {
        let at = from(request).filter(|_| mood != Mood::Whole).unwrap_or(0) as usize;
        let mut body = content[at.min(content.len())..].to_vec();
        if mood == Mood::Spoils {
            let middle = body.len() / 2;
            body[middle] ^= 1;
        }
        if mood == Mood::Longer {
            body.push(7);
        }
        let head = match mood {
            Mood::Refuses => "404 Not Found".to_owned(),
            _ if at > 0 => format!("206 Partial Content\r\nContent-Range: bytes {at}-{}/{}", content.len() - 1, content.len()),
            _ => "200 OK".to_owned(),
        };
        let head = format!("HTTP/1.1 {head}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
        let sent = if matches!(mood, Mood::Cuts | Mood::Stalls) { body.len() / 2 } else { body.len() };
        let bytes = [head.as_bytes(), &body[..sent]].concat();
        if mood == Mood::Stalls { Answer::Stalled(bytes) } else { Answer::bytes(bytes) }
    }

    fn case() -> Case {
        let content: Vec<u8> = (0..300_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
        let (mood, sha256) = (Arc::new(Mutex::new(Mood::Well)), Digest(Sha256::digest(&content).into()));
        let (of, sent) = (Arc::clone(&mood), content.clone());
        let server = StandIn::start(move |request| answer(request, &sent, *of.lock().unwrap()));
        Case { server, mood, content, folder: tempfile::tempdir().unwrap(), sha256 }
    }

    impl Case {
        fn fetch(&self, mood: Mood, bytes: Option<u64>) -> Result<bool, DownloadError> {
            *self.mood.lock().unwrap() = mood;
            fetch(&RemoteFile { url: &self.url(), bytes, sha256: self.sha256 }, &self.file(), |_, _| {})
        }

        fn url(&self) -> String {
            self.server.url("/model.onnx")
        }

        fn file(&self) -> PathBuf {
            self.folder.path().join("sub/model.onnx")
        }

        fn part(&self) -> PathBuf {
            self.folder.path().join("sub/model.onnx.part")
        }

        /// The first bytes that the requests asked for.
        fn requests(&self) -> Vec<Option<u64>> {
            self.server.answered().iter().map(from).collect()
        }
    }

    #[test]
    fn a_file_is_fetched_completely_and_only_once() {
        let c = case();
        let mut last = (0, None);
        let wanted = RemoteFile { url: &c.url(), bytes: None, sha256: c.sha256 };
        assert!(fetch(&wanted, &c.file(), |have, all| last = (have, all)).unwrap());
        assert_eq!(last, (300_000, Some(300_000)));
        assert_eq!(std::fs::read(c.file()).unwrap(), c.content);
        assert!(!c.part().exists());
        assert!(!c.fetch(Mood::Refuses, None).unwrap(), "it is there already");
        assert_eq!(c.requests().len(), 1);
    }

    #[test]
    fn a_cut_download_is_refused_and_resumed() {
        let c = case();
        let cut = c.fetch(Mood::Cuts, Some(300_000)).unwrap_err();
        assert!(matches!(cut, DownloadError::Truncated { have: 150_000, want: 300_000 }), "{cut}");
        assert!(!c.file().exists() && c.part().exists());
        assert!(c.fetch(Mood::Well, Some(300_000)).unwrap());
        assert_eq!(std::fs::read(c.file()).unwrap(), c.content);
        assert_eq!(c.requests(), [None, Some(150_000)]);
    }

    #[test]
    fn a_download_from_a_silent_server_ends_and_can_resume() {
        let c = case();
        *c.mood.lock().unwrap() = Mood::Stalls;
        let wanted = RemoteFile { url: &c.url(), bytes: Some(300_000), sha256: c.sha256 };
        let silent = fetch_within(Duration::from_millis(300), sync, &wanted, &c.file(), |_, _| {}).unwrap_err();
        assert!(matches!(silent, DownloadError::Truncated { have: 150_000, want: 300_000 }), "{silent}");
        assert!(c.fetch(Mood::Well, Some(300_000)).unwrap());
        assert_eq!(c.requests(), [None, Some(150_000)]);
    }

    #[test]
    fn the_folder_is_synced_after_the_rename_and_its_error_is_returned() {
        let c = case();
        let wanted = RemoteFile { url: &c.url(), bytes: Some(300_000), sha256: c.sha256 };
        let synced = std::cell::RefCell::new(Vec::new());
        let seen = |folder: &Path| {
            synced.borrow_mut().push((folder.to_owned(), c.file().exists(), c.part().exists()));
            Ok(())
        };
        assert!(fetch_within(PATIENCE, seen, &wanted, &c.file(), |_, _| {}).unwrap());
        assert_eq!(*synced.borrow(), [(c.folder.path().join("sub"), true, false)]);
        std::fs::write(c.file(), b"older").unwrap();
        let fails = |_: &Path| Err(io::Error::other("no"));
        let told = fetch_within(PATIENCE, fails, &wanted, &c.file(), |_, _| {}).unwrap_err();
        assert!(matches!(told, DownloadError::File { .. }), "{told}");
        sync(c.folder.path()).unwrap();
    }

    #[test]
    fn a_server_without_ranges_starts_over() {
        let c = case();
        c.fetch(Mood::Cuts, Some(300_000)).unwrap_err();
        assert!(c.fetch(Mood::Whole, Some(300_000)).unwrap());
        assert_eq!(std::fs::read(c.file()).unwrap(), c.content);
    }

    #[test]
    fn a_corrupt_download_is_refused_and_leaves_nothing() {
        let c = case();
        std::fs::create_dir_all(c.folder.path().join("sub")).unwrap();
        std::fs::write(c.file(), b"older").unwrap();
        assert!(matches!(c.fetch(Mood::Spoils, Some(300_000)), Err(DownloadError::Corrupt { .. })));
        assert_eq!(std::fs::read(c.file()).unwrap(), b"older", "the older file stays");
        assert!(!c.part().exists());
        // a part that was already corrupt is found out at the end, too
        std::fs::write(c.part(), vec![0; 1000]).unwrap();
        assert!(matches!(c.fetch(Mood::Well, Some(300_000)), Err(DownloadError::Corrupt { .. })));
        assert!(c.fetch(Mood::Well, Some(300_000)).unwrap());
    }

    #[test]
    fn another_size_and_a_refusal_are_errors() {
        let c = case();
        assert!(matches!(c.fetch(Mood::Longer, Some(300_000)), Err(DownloadError::Size { want: 300_000, got: 300_001 })));
        assert!(matches!(c.fetch(Mood::Longer, None), Err(DownloadError::Corrupt { .. })));
        assert!(matches!(c.fetch(Mood::Refuses, None), Err(DownloadError::Status { status: 404, .. })));
        let unreachable = RemoteFile { url: "http://127.0.0.1:1/x", bytes: None, sha256: c.sha256 };
        assert!(matches!(fetch(&unreachable, &c.file(), |_, _| {}), Err(DownloadError::Http { .. })));
        assert!(!c.file().exists());
    }

    #[test]
    fn digests_round_trip_through_text() {
        let text = "2d8c6cb8f415229daf1eb041024208e2608c9f98e17c81cc7c6ecb449c56fd58";
        assert_eq!(text.parse::<Digest>().unwrap().to_string(), text);
        for bad in ["", "2d8c", &text.replace('2', "g"), &format!("{text}00"), &"ä".repeat(32)] {
            assert!(bad.parse::<Digest>().is_err(), "{bad}");
        }
    }
}
