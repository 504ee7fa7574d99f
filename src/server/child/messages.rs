//! Messages in the pipes to and from child processes. Each is a line of JSON, an array of the message and the lengths of its files; their
//! bytes follow the line.

use std::collections::BTreeMap;
use std::io::{self, BufRead, Read as _, Write};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::server::maker::Fault;
use crate::server::routes::Stage;
use tmpi_pipeline::Report;

/// Longest line, and largest file.
const MAX_BYTES: u64 = 1 << 30;

#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub enum Work {
    /// Make a photo with these options. Files: the strokes, the photo, and its depth map if it has one.
    Make(BTreeMap<String, String>),
    /// Write the export file of this recipe. File: the container.
    Write(String),
}

#[derive(Serialize, Deserialize)]
pub enum Answer {
    /// A stage begins; more answers follow.
    Progress(Stage),
    /// The photo is made. Files: container, disparity and thumbnail.
    Made(Box<Report>),
    /// The export file is written, by a process with this peak memory in bytes. File: its contents.
    Written(u64),
    /// There is no result.
    Fault(Fault),
}

pub fn write(to: &mut impl Write, message: &impl Serialize, files: &[impl AsRef<[u8]>]) -> io::Result<()> {
    let lengths: Vec<usize> = files.iter().map(|file| file.as_ref().len()).collect();
    let mut line = serde_json::to_vec(&(message, lengths))?;
    line.push(b'\n');
    to.write_all(&line)?;
    files.iter().try_for_each(|file| to.write_all(file.as_ref()))?;
    to.flush()
}

pub fn read<M: DeserializeOwned>(from: &mut impl BufRead) -> io::Result<(M, Vec<Vec<u8>>)> {
    let mut line = Vec::new();
    from.by_ref().take(MAX_BYTES).read_until(b'\n', &mut line)?;
    let line = line.strip_suffix(b"\n").ok_or(io::ErrorKind::UnexpectedEof)?;
    let (message, lengths): (M, Vec<u64>) = serde_json::from_slice(line)?;
    let file = |length: u64| {
        if length > MAX_BYTES {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "the file is too large"));
        }
        let mut bytes = Vec::new();
        from.by_ref().take(length).read_to_end(&mut bytes)?;
        if bytes.len() as u64 == length { Ok(bytes) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
    };
    let files = lengths.into_iter().map(file).collect::<io::Result<_>>()?;
    Ok((message, files))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_read_back_and_truncated_ones_are_errors() {
        let (photo, file) = (Work::Make([("tile".into(), "full".into())].into()), Work::Write("format=zip".into()));
        let mut bytes = Vec::new();
        write(&mut bytes, &photo, &[b"abc".as_slice(), b"\n"]).unwrap();
        let end = bytes.len();
        write(&mut bytes, &file, &[b""]).unwrap();
        let mut from = bytes.as_slice();
        assert_eq!(read::<Work>(&mut from).unwrap(), (photo, vec![b"abc".to_vec(), b"\n".to_vec()]));
        assert_eq!(read::<Work>(&mut from).unwrap(), (file, vec![Vec::new()]));
        assert!(read::<Work>(&mut from).is_err());
        for end in 0..end {
            assert!(read::<Work>(&mut &bytes[..end]).is_err(), "cut to {end}");
        }
        let endless = format!("[{{\"Write\":\"\"}},[{}]]\n", MAX_BYTES + 1);
        assert_eq!(read::<Work>(&mut endless.as_bytes()).unwrap_err().kind(), io::ErrorKind::InvalidData);
    }
}
