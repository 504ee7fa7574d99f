//! Limits the headers of form parts, since the form parser buffers each of them whole.

use std::error::Error;
use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;
use futures_util::Stream;
use memchr::memmem::Finder;

/// Most bytes of a part's header.
const HEADER: usize = 8 << 10;

/// The header of a part is too long.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the header of a part of the form is over the limit of {HEADER} bytes")]
pub struct HeaderTooLong;

/// The parser's position in a form.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum At {
    /// Before the first delimiter.
    Preamble,
    /// In the rest of a delimiter's line; its end is not part of the header that follows.
    Line,
    /// In a header.
    Header,
    /// In the bytes of a part.
    Data,
}

/// The bytes of a form as they arrive, up to a header that is too long.
pub struct LimitedHeaders<S> {
    stream: S,
    /// Finds the first delimiter; the parser accepts it at any position.
    first: Finder<'static>,
    delimiter: Finder<'static>,
    line_end: Finder<'static>,
    header_end: Finder<'static>,
    at: At,
    /// Bytes since the last part, which the parser holds.
    held: usize,
    /// The last bytes, which may begin a delimiter.
    tail: Vec<u8>,
}

impl<S> LimitedHeaders<S> {
    /// A form whose parts are separated by `boundary`.
    pub fn new(stream: S, boundary: &str) -> Self {
        let finder = |text: &str| Finder::new(text).into_owned();
        Self {
            stream,
            first: finder(&format!("--{boundary}")),
            delimiter: finder(&format!("\r\n--{boundary}")),
            line_end: finder("\r\n"),
            header_end: finder("\r\n\r\n"),
            at: At::Preamble,
            held: 0,
            tail: Vec::new(),
        }
    }

    /// Tracks the position over `piece`.
    fn see(&mut self, piece: &[u8]) -> Result<(), HeaderTooLong> {
        let carried = self.tail.len();
        let mut bytes = std::mem::take(&mut self.tail);
        bytes.extend_from_slice(piece);
        let (mut from, mut fresh) = (0, carried);
        loop {
            let rest = &bytes[from..];
            let (finder, next) = match self.at {
                At::Preamble => (&self.first, At::Line),
                At::Line => (&self.line_end, At::Header),
                At::Header => (&self.header_end, At::Data),
                At::Data => (&self.delimiter, At::Line),
            };
            let length = finder.needle().len();
            let found = finder.find(rest).map(|at| from + at + length);
            let end = found.unwrap_or(bytes.len());
            if self.at == At::Data {
                self.held = 0;
            } else {
                self.held += end.saturating_sub(fresh.max(from));
                if self.held > HEADER {
                    return Err(HeaderTooLong);
                }
            }
            let Some(end) = found else {
                let kept = bytes.len().saturating_sub(length - 1).max(from);
                self.tail = bytes.split_off(kept);
                return Ok(());
            };
            self.at = next;
            (from, fresh) = (end, end);
        }
    }
}

impl<S, E> Stream for LimitedHeaders<S>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
    E: Into<Box<dyn Error + Send + Sync>>,
{
    type Item = Result<Bytes, Box<dyn Error + Send + Sync>>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let next = std::task::ready!(Pin::new(&mut self.stream).poll_next(cx));
        Poll::Ready(next.map(|piece| {
            let piece = piece.map_err(Into::into)?;
            self.see(&piece)?;
            Ok(piece)
        }))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn form(headers: &[usize], data: usize) -> Vec<u8> {
        let mut form = Vec::new();
        for header in headers {
            form.extend(b"--b\r\n");
            form.extend(vec![b'h'; *header]);
            form.extend(b"\r\n\r\n");
            form.extend(vec![b'\r'; data]);
            form.extend(b"\r\n");
        }
        form.extend(b"--b--\r\n");
        form
    }

    fn passes(form: &[u8], pieces: usize) -> bool {
        let mut bounded = LimitedHeaders::new(futures_util::stream::empty::<Result<Bytes, std::io::Error>>(), "b");
        form.chunks(pieces).all(|piece| bounded.see(piece).is_ok())
    }

    #[test]
    fn headers_of_form_parts_are_limited_and_their_data_is_not() {
        // the delimiter counts as part of the header
        for pieces in [1, 7, 1000, 1 << 20] {
            assert!(passes(&form(&[10, HEADER - 20, 10], 3 * HEADER), pieces), "{pieces}");
            assert!(!passes(&form(&[10, HEADER + 1], 5), pieces), "{pieces}");
            assert!(!passes(&form(&[HEADER + 1], 5), pieces), "{pieces}");
        }
    }

    #[test]
    fn a_header_is_limited_wherever_the_form_parser_sees_one() {
        let long = vec![b'h'; HEADER + 1];
        // empty lines before and right after the first delimiter end no header
        for before in [b"\r\n\r\n--b\r\n".as_slice(), b"--b\r\n\r\n", b"x--b\r\n", b"--b \t\r\n\r\n"] {
            for pieces in [1, 3, 1000, 1 << 20] {
                let form = [before, &long, b"\r\n\r\n"].concat();
                assert!(!passes(&form, pieces), "{:?} in pieces of {pieces}", String::from_utf8_lossy(before));
                assert!(passes(&[before, &long[..HEADER - 20], b"\r\n\r\n", &long, &long].concat(), pieces));
            }
        }
        assert!(!passes(&[b"\r\n\r\n".as_slice(), &long].concat(), 1000), "nor does it before any delimiter");
    }

    proptest! {
        #[test]
        fn the_size_of_chunks_makes_no_difference(headers in prop::collection::vec(HEADER - 30..HEADER + 30, 1..4), data in 0..40_usize, pieces in 1..9000_usize) {
            let form = form(&headers, data);
            prop_assert_eq!(passes(&form, pieces), passes(&form, form.len()));
        }
    }
}
