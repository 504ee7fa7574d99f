//! Bytes of an answer: in memory, or a file that is read while it is sent.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::sync::Arc;

use axum::body::Body;
use bytes::Bytes;
use futures_util::stream;
use tmpi_library::{Blob, BlobStore};

use super::answer_memory::{ANSWERS, AnswerMemory, LEAST};

/// Most bytes of a file to read at a time. A client that does not read holds one piece, and one more in the transport.
const PIECE: usize = 32 << 10;

/// Bytes of an object to read first. Object stores have a high latency, so each piece is twice as large as the one before. A client holds
/// memory only in proportion to what it has read.
const FIRST_OBJECT_PIECE: usize = 64 << 10;

/// Most bytes of an object to read at a time.
const OBJECT_PIECE: usize = 1 << 20;

/// Bytes of an answer.
#[derive(Clone, Debug)]
pub enum Source {
    Memory(Bytes),
    /// A file and its length in bytes.
    File(Arc<File>, usize),
    Object(BlobStore, Arc<Blob>),
}

impl Source {
    pub fn len(&self) -> usize {
        match self {
            Self::Memory(bytes) => bytes.len(),
            Self::File(_, length) => *length,
            Self::Object(_, blob) => blob.bytes as usize,
        }
    }

    /// Its first `most` bytes, or all if it has fewer.
    pub async fn head(&self, most: usize) -> io::Result<Bytes> {
        self.read(0..most.min(self.len())).await
    }

    async fn read(&self, range: Range<usize>) -> io::Result<Bytes> {
        match self {
            Self::Memory(bytes) => Ok(bytes.slice(range)),
            Self::File(file, _) => {
                let file = Arc::clone(file);
                tokio::task::spawn_blocking(move || read_at(&file, range).map(Bytes::from)).await?
            }
            Self::Object(store, blob) => store.read_range(blob, range.start as u64..range.end as u64).await.map_err(io::Error::other),
        }
    }

    pub fn body(self, range: Range<usize>) -> Body {
        self.body_within(range, &ANSWERS)
    }

    /// The same, with the pieces of a file within `memory`.
    fn body_within(self, range: Range<usize>, memory: &'static AnswerMemory) -> Body {
        // each piece of an object is a request
        let (least, first, most) = match &self {
            Self::Memory(bytes) => return Body::from(bytes.slice(range)),
            Self::File(..) => (LEAST, PIECE, PIECE),
            Self::Object(..) => (FIRST_OBJECT_PIECE, FIRST_OBJECT_PIECE, OBJECT_PIECE),
        };
        let pieces = stream::try_unfold((self, range, first), move |(source, left, length)| async move {
            if left.is_empty() {
                return Ok::<_, io::Error>(None);
            }
            let share = memory.take(length.min(left.len()), least);
            let end = left.start + share.bytes;
            let piece = source.read(left.start..end).await?;
            Ok(Some((share.attach(piece), (source, end..left.end, most.min(2 * length)))))
        });
        Body::from_stream(pieces)
    }
}

impl From<Bytes> for Source {
    fn from(bytes: Bytes) -> Self {
        Self::Memory(bytes)
    }
}

#[cfg(unix)]
fn read_at(file: &File, range: Range<usize>) -> io::Result<Vec<u8>> {
    use std::os::unix::fs::FileExt as _;
    let mut piece = vec![0; range.len()];
    file.read_exact_at(&mut piece, range.start as u64)?;
    Ok(piece)
}

#[cfg(windows)]
fn read_at(file: &File, range: Range<usize>) -> io::Result<Vec<u8>> {
    use std::os::windows::fs::FileExt as _;
    let (mut piece, mut done) = (vec![0; range.len()], 0);
    while done < piece.len() {
        match file.seek_read(&mut piece[done..], (range.start + done) as u64)? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            n => done += n,
        }
    }
    Ok(piece)
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use http_body_util::BodyExt as _;

    use super::*;

    #[tokio::test]
    async fn a_file_is_sent_in_pieces_and_a_shorter_one_is_an_error() {
        static NONE: AnswerMemory = AnswerMemory::new(0);
        let bytes: Vec<u8> = (0..PIECE * 3 + 77).map(|i| (i * 7) as u8).collect();
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(&bytes).unwrap();
        let file = Arc::new(file);
        let mut body = Source::File(Arc::clone(&file), bytes.len()).body(0..bytes.len());
        let mut lengths = Vec::new();
        while let Some(frame) = body.frame().await {
            lengths.push(frame.unwrap().into_data().unwrap().len());
        }
        assert_eq!(lengths, [PIECE, PIECE, PIECE, 77]);
        let send = async |length, range| {
            Source::File(Arc::clone(&file), length).body(range).collect().await.map(http_body_util::Collected::to_bytes)
        };
        assert_eq!(send(bytes.len(), 0..bytes.len()).await.unwrap(), bytes);
        assert_eq!(send(bytes.len(), 5..PIECE + 9).await.unwrap(), bytes[5..PIECE + 9]);
        for most in [0, 9, bytes.len(), bytes.len() + 1] {
            let whole = &bytes[..most.min(bytes.len())];
            assert_eq!(Source::File(Arc::clone(&file), bytes.len()).head(most).await.unwrap(), whole);
            assert_eq!(Source::from(Bytes::from(bytes.clone())).head(most).await.unwrap(), whole);
        }
        assert_eq!(send(bytes.len(), 5..5).await.unwrap().len(), 0);
        assert!(send(bytes.len() + 1, 0..bytes.len() + 1).await.is_err());
        // others hold all memory
        let mut body = Source::File(Arc::clone(&file), bytes.len()).body_within(0..bytes.len(), &NONE);
        let first = body.frame().await.unwrap().unwrap().into_data().unwrap();
        assert_eq!((first.len(), NONE.held()), (4 << 10, 4 << 10));
        assert_eq!([first, body.collect().await.unwrap().to_bytes()].concat(), bytes);
        assert_eq!(NONE.held(), 0);
    }
}
