//! Answers of which the bytes also lie in a file: there the system sends its own pages (sendfile(2)), and nothing is copied.

use std::fs::File;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};

use bytes::Bytes;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;

/// Bytes of fewer are sent from memory: the calls cost more than the copy.
#[cfg(target_os = "linux")]
const LEAST: usize = 16 << 10;

/// An answer, or a range of one, that lies in memory and in a file: an extension of its response.
#[derive(Clone, Debug)]
pub struct InFile {
    bytes: Bytes,
    file: Arc<File>,
    /// Where it begins in the file.
    at: usize,
}

impl InFile {
    /// `bytes` are those of `file` from `at` on, and that does not change.
    #[must_use]
    pub fn new(bytes: Bytes, file: Arc<File>, at: usize) -> Self {
        Self { bytes, file, at }
    }

    /// Where in the file the bytes of `part` lie, where they are bytes of this very memory.
    #[cfg(target_os = "linux")]
    fn find(&self, part: &[u8]) -> Option<usize> {
        // as long as it is held here, nothing else lies at its addresses
        let within = part.as_ptr().addr().checked_sub(self.bytes.as_ptr().addr())?;
        (part.len() >= LEAST && within.checked_add(part.len())? <= self.bytes.len()).then_some(self.at + within)
    }
}

/// What a connection sends at the moment, where that lies in a file.
#[derive(Clone, Debug, Default)]
pub struct Sending(Arc<Mutex<Option<InFile>>>);

impl Sending {
    /// From now on it is `answer`.
    pub fn set(&self, answer: Option<InFile>) {
        *self.lock() = answer;
    }

    fn lock(&self) -> MutexGuard<'_, Option<InFile>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A connection that leaves what lies in a file to the system.
#[derive(Debug)]
pub struct FileStream {
    /// The connection itself.
    pub stream: TcpStream,
    sending: Sending,
}

impl FileStream {
    /// Sends what `sending` tells.
    #[must_use]
    pub fn new(stream: TcpStream, sending: Sending) -> Self {
        Self { stream, sending }
    }

    /// Writes `head`, and `length` bytes of `file` from `at` on.
    #[cfg(target_os = "linux")]
    fn poll_send(&self, cx: &mut Context<'_>, head: &[IoSlice<'_>], file: &File, (at, length): (usize, usize)) -> Poll<io::Result<usize>> {
        let before: usize = head.iter().map(|part| part.len()).sum();
        let send = || {
            let socket = socket2::SockRef::from(&self.stream);
            // in one packet with what follows
            let sent = if before > 0 { socket.send_vectored_with_flags(head, libc::MSG_MORE)? } else { 0 };
            if sent < before {
                return Ok(sent);
            }
            match socket.sendfile(file, at, std::num::NonZeroUsize::new(length)) {
                // the next call tells the same
                Ok(0) | Err(_) if sent > 0 => Ok(sent),
                Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(more) => Ok(sent + more),
                Err(error) => Err(error),
            }
        };
        loop {
            std::task::ready!(self.stream.poll_write_ready(cx))?;
            match self.stream.try_io(tokio::io::Interest::WRITABLE, send) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                done => return Poll::Ready(done),
            }
        }
    }
}

impl AsyncRead for FileStream {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for FileStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }

    fn poll_write_vectored(self: Pin<&mut Self>, cx: &mut Context<'_>, bufs: &[IoSlice<'_>]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        #[cfg(target_os = "linux")]
        {
            let mut answer = this.sending.lock();
            let found = answer.as_ref().and_then(|answer| {
                let (i, at) = bufs.iter().enumerate().find_map(|(i, part)| answer.find(part).map(|at| (i, at)))?;
                let (head, rest) = bufs.split_at_checked(i)?;
                Some(this.poll_send(cx, head, &answer.file, (at, rest.first()?.len())))
            });
            match found {
                // a file system that cannot
                Some(Poll::Ready(Err(error))) if matches!(error.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => {
                    *answer = None;
                }
                Some(done) => return done,
                None => {}
            }
        }
        Pin::new(&mut this.stream).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use std::io::Write as _;

    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;

    use super::*;

    /// What the other side gets of `head` and the bytes of `answer` from `from` on.
    async fn sent(answer: &InFile, head: &'static [u8], from: usize) -> Vec<u8> {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut theirs = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (ours, _) = listener.accept().await.unwrap();
        let read = tokio::spawn(async move {
            let mut all = Vec::new();
            theirs.read_to_end(&mut all).await.map(|_| all)
        });
        let sending = Sending::default();
        sending.set(Some(answer.clone()));
        let mut ours = FileStream::new(ours, sending);
        let (mut head, mut body) = (Bytes::from_static(head), answer.bytes.slice(from..));
        while !head.is_empty() || !body.is_empty() {
            let n = ours.write_vectored(&[IoSlice::new(&head), IoSlice::new(&body)]).await.unwrap();
            assert_ne!(n, 0);
            let of_head = n.min(head.len());
            bytes::Buf::advance(&mut head, of_head);
            bytes::Buf::advance(&mut body, n - of_head);
        }
        ours.shutdown().await.unwrap();
        read.await.unwrap().unwrap()
    }

    fn pair(bytes: Vec<u8>, in_file: &[u8]) -> (Bytes, Arc<File>) {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(in_file).unwrap();
        (bytes.into(), Arc::new(file))
    }

    #[tokio::test]
    async fn what_lies_in_a_file_is_sent_from_there_and_the_head_before_it() {
        let memory: Vec<u8> = (0..3_000_000_u32).map(|i| (i * 7 / 5) as u8).collect();
        // told apart by their bytes, as they never are otherwise
        let other: Vec<u8> = memory.iter().map(|b| !b).collect();
        let (bytes, file) = pair(memory.clone(), &other);
        for (range, from) in [(0..memory.len(), 0), (0..memory.len(), 1_000), (100..2_000_000, 0), (2_000_000..3_000_000, 77)] {
            let answer = InFile::new(bytes.slice(range.clone()), Arc::clone(&file), range.start);
            let got = sent(&answer, b"a head", from).await;
            assert_eq!(got.strip_prefix(b"a head".as_slice()).unwrap(), &other[range][from..]);
        }
        // little is not worth it
        let little = InFile::new(bytes.slice(..LEAST - 1), Arc::clone(&file), 0);
        assert_eq!(sent(&little, b"", 0).await, memory[..LEAST - 1]);
    }

    #[tokio::test]
    async fn other_memory_is_sent_as_it_is() {
        let memory = vec![1; 100_000];
        let (bytes, file) = pair(memory.clone(), &vec![2; 100_000]);
        let answer = InFile::new(bytes.slice(..50_000), file, 0);
        assert!(answer.find(&bytes[..50_000]).is_some() && answer.find(&bytes[10_000..50_000]) == Some(10_000));
        // beyond its end, before its beginning, elsewhere
        assert_eq!((answer.find(&bytes[1..50_001]), answer.find(&bytes[60_000..]), answer.find(&memory[..50_000])), (None, None, None));
        let later = InFile::new(bytes.slice(50_000..), Arc::clone(&answer.file), 50_000);
        assert_eq!((later.find(&bytes[..50_000]), later.find(&bytes[50_000..])), (None, Some(50_000)));
    }

    #[tokio::test]
    async fn a_file_that_is_shorter_than_it_was_is_an_error_and_one_that_cannot_be_sent_is_sent_from_memory() {
        let (bytes, file) = pair(vec![5; 100_000], &[5; 10]);
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let theirs = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let sending = Sending::default();
        let mut ours = FileStream::new(listener.accept().await.unwrap().0, sending.clone());
        sending.set(Some(InFile::new(bytes.slice(10..), file, 10)));
        assert_eq!(ours.write_vectored(&[IoSlice::new(&bytes[10..])]).await.unwrap_err().kind(), io::ErrorKind::UnexpectedEof);
        // pages of a folder are nobody's
        let folder = Arc::new(File::open("/").unwrap());
        sending.set(Some(InFile::new(bytes.clone(), folder, 0)));
        assert!(ours.write_vectored(&[IoSlice::new(&bytes)]).await.unwrap() > 0);
        drop(theirs);
    }
}
