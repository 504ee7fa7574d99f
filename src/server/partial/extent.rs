//! How far an upload in parts is: what each request says is held against what came before.

use serde::{Deserialize, Serialize};

/// How much of an upload is there, and how much there is to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Extent {
    /// Bytes that are there; it never shrinks.
    pub offset: u64,
    /// Bytes of the whole, once it is known; it never changes then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub length: Option<u64>,
}

/// What a request that brings a part says of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Said {
    /// Byte of the whole at which the part begins: `Upload-Offset`.
    pub at: u64,
    /// Bytes of the part, where that is told: `Content-Length`.
    pub content: Option<u64>,
    /// Bytes of the whole, where that is told: `Upload-Length`.
    pub length: Option<u64>,
    /// The whole ends with the part: `Upload-Complete: ?1`.
    pub complete: bool,
}

/// Why a part is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// It does not begin where what is there ends.
    #[error("the part begins at byte {provided}, and byte {expected} is next")]
    Offset {
        /// Where it has to begin.
        expected: u64,
        /// Where it begins.
        provided: u64,
    },
    /// It does not agree with the length that was told before, or with itself.
    #[error("the part does not agree with the length of the upload")]
    Length,
    /// The whole is larger than this many bytes.
    #[error("the upload is over the limit of {0} bytes")]
    TooLarge(u64),
}

impl Extent {
    /// Of an upload of which nothing is there.
    pub const NOTHING: Self = Self { offset: 0, length: None };

    /// Begins with a part of an upload of at most `most` bytes. The length is known from now on where the request tells it.
    ///
    /// # Errors
    /// [`Refused`]: nothing has changed then.
    pub fn begin(&mut self, said: &Said, most: u64) -> Result<(), Refused> {
        if said.at != self.offset {
            return Err(Refused::Offset { expected: self.offset, provided: said.at });
        }
        let same = |a: Option<u64>, b: Option<u64>| match (a, b) {
            (Some(a), Some(b)) if a != b => Err(Refused::Length),
            (a, b) => Ok(a.or(b)),
        };
        let end = said.content.map(|bytes| self.offset.saturating_add(bytes));
        let mut length = same(self.length, said.length)?;
        if said.complete {
            length = same(length, end)?;
        }
        if length.max(end).is_some_and(|bytes| bytes > most) {
            return Err(Refused::TooLarge(most));
        }
        if length.is_some_and(|bytes| bytes < end.unwrap_or(self.offset)) {
            return Err(Refused::Length);
        }
        self.length = length;
        Ok(())
    }

    /// Takes so many more bytes of a part.
    ///
    /// # Errors
    /// They are more than there are to be, or than `most`: none of them counts then.
    pub fn take(&mut self, bytes: u64, most: u64) -> Result<(), Refused> {
        let offset = self.offset.saturating_add(bytes);
        match self.length {
            Some(length) if offset > length => Err(Refused::Length),
            None if offset > most => Err(Refused::TooLarge(most)),
            _ => {
                self.offset = offset;
                Ok(())
            }
        }
    }

    /// Ends a part that came whole; true where the upload is whole with it.
    ///
    /// # Errors
    /// It was said to be, and is not.
    pub fn end(&mut self, complete: bool) -> Result<bool, Refused> {
        if complete && self.length.is_some_and(|length| length != self.offset) {
            return Err(Refused::Length);
        }
        if complete {
            self.length = Some(self.offset);
        }
        Ok(complete)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MOST: u64 = 100;

    fn at(offset: u64, length: Option<u64>) -> Extent {
        Extent { offset, length }
    }

    #[test]
    fn what_does_not_agree_is_refused_and_changes_nothing() {
        let said = |at, content, length, complete| Said { at, content, length, complete };
        for (extent, said, refused) in [
            (at(5, None), said(4, None, None, false), Refused::Offset { expected: 5, provided: 4 }),
            (at(5, None), said(6, Some(0), None, true), Refused::Offset { expected: 5, provided: 6 }),
            (at(5, Some(9)), said(5, None, Some(10), false), Refused::Length),
            (at(5, Some(9)), said(5, Some(5), None, false), Refused::Length),
            (at(5, Some(9)), said(5, Some(3), None, true), Refused::Length),
            (at(5, None), said(5, Some(3), Some(9), true), Refused::Length),
            (at(5, None), said(5, None, Some(4), false), Refused::Length),
            (at(0, None), said(0, None, Some(MOST + 1), false), Refused::TooLarge(MOST)),
            (at(5, None), said(5, Some(MOST - 4), None, false), Refused::TooLarge(MOST)),
            (at(5, None), said(5, Some(u64::MAX), None, true), Refused::TooLarge(MOST)),
        ] {
            let mut now = extent;
            assert_eq!((now.begin(&said, MOST), now), (Err(refused), extent), "{said:?}");
        }
        let mut now = at(5, None);
        assert_eq!((now.begin(&said(5, Some(4), None, true), MOST), now), (Ok(()), at(5, Some(9))));
        assert_eq!((now.take(5, MOST), now.take(4, MOST), now.end(true)), (Err(Refused::Length), Ok(()), Ok(true)));
    }

    /// A request of a client that is interrupted, mistaken or right.
    #[derive(Clone, Debug)]
    struct Request {
        /// By how much its offset is off.
        off: i64,
        bytes: u64,
        tells_content: bool,
        tells_length: bool,
        /// Bytes after which the connection is lost.
        cut: Option<u64>,
    }

    fn request() -> impl Strategy<Value = Request> {
        let off = prop_oneof![8 => Just(0_i64), 1 => -3_i64..=3];
        let cut = prop_oneof![2 => Just(None), 1 => (0..40_u64).prop_map(Some)];
        (off, 0..40_u64, any::<bool>(), any::<bool>(), cut).prop_map(|(off, bytes, tells_content, tells_length, cut)| Request {
            off,
            bytes,
            tells_content,
            tells_length,
            cut,
        })
    }

    proptest! {
        #[test]
        fn whatever_is_lost_on_the_way_the_upload_is_what_was_sent(
            whole in prop::collection::vec(any::<u8>(), 0..MOST as usize),
            requests in prop::collection::vec(request(), 0..30),
            piece in 1..9_usize,
        ) {
            let (mut extent, mut file, mut done) = (Extent::NOTHING, Vec::new(), false);
            for Request { off, bytes, tells_content, tells_length, cut } in requests {
                prop_assert!(!done && extent.offset == file.len() as u64);
                let from = extent.offset.saturating_add_signed(off).min(whole.len() as u64) as usize;
                let to = (from + bytes as usize).min(whole.len());
                let (part, complete, before) = (&whole[from..to], to == whole.len(), extent);
                let told = |tells: bool, bytes: usize| tells.then_some(bytes as u64);
                let said = Said { at: from as u64, content: told(tells_content, part.len()), length: told(tells_length, whole.len()), complete };
                let begun = extent.begin(&said, MOST);
                prop_assert_eq!(begun.is_ok(), from as u64 == before.offset);
                if begun.is_err() {
                    prop_assert_eq!(extent, before);
                    continue;
                }
                let sent = cut.map_or(part.len(), |bytes| part.len().min(bytes as usize));
                for piece in part[..sent].chunks(piece) {
                    extent.take(piece.len() as u64, MOST).unwrap();
                    file.extend_from_slice(piece);
                }
                if sent == part.len() {
                    done = extent.end(complete).unwrap();
                    prop_assert_eq!(done, complete);
                }
                prop_assert!(extent.offset >= before.offset && before.length.is_none_or(|l| extent.length == Some(l)));
                prop_assert_eq!(&file, &whole[..file.len()]);
                if done {
                    prop_assert_eq!((file.len(), extent.length), (whole.len(), Some(whole.len() as u64)));
                    break;
                }
            }
        }

        #[test]
        fn nothing_makes_it_longer_than_it_may_be(
            said in prop::collection::vec((0..150_u64, prop::option::of(0..150_u64), prop::option::of(0..150_u64), any::<bool>(), 0..150_u64), 0..20),
        ) {
            let mut extent = Extent::NOTHING;
            for (at, content, length, complete, bytes) in said {
                let before = extent;
                if extent.begin(&Said { at, content, length, complete }, MOST).is_ok() && extent.take(bytes, MOST).is_ok() {
                    let _ = extent.end(complete);
                }
                prop_assert!(extent.offset >= before.offset && extent.offset <= extent.length.unwrap_or(MOST));
                prop_assert!(extent.length.is_none_or(|l| l <= MOST));
                prop_assert!(before.length.is_none_or(|l| extent.length == Some(l)));
            }
        }
    }
}
