//! Checks the first bytes of an upload as they arrive, to refuse wrong kinds and sizes before the client sends the rest.

use std::sync::Arc;

use super::maker::{HeadOf, Maker};
use super::problem::Problem;

/// Most bytes to check; beyond that, the check of the whole upload decides.
pub const MOST: usize = 256 << 10;
/// Fewest bytes of which a maker can tell anything.
const LEAST: usize = 12;

/// One part of an upload on its way in.
pub struct UploadHead {
    maker: Arc<dyn Maker>,
    /// The first bytes, while more of them may matter.
    head: Vec<u8>,
    /// Size at which to check again; `None` if the check is complete.
    needs: Option<usize>,
}

impl UploadHead {
    /// Nothing has come yet.
    #[must_use]
    pub fn new(maker: &Arc<dyn Maker>) -> Self {
        Self { maker: Arc::clone(maker), head: Vec::new(), needs: Some(LEAST) }
    }

    /// Checks the next bytes.
    ///
    /// # Errors
    /// As for the whole upload: 400, 413, 415 and 422.
    pub fn see(&mut self, bytes: &[u8], of: HeadOf<'_>) -> Result<(), Problem> {
        let Some(needs) = self.needs else { return Ok(()) };
        let room = MOST.saturating_sub(self.head.len());
        self.head.extend_from_slice(&bytes[..bytes.len().min(room)]);
        if self.head.len() < needs {
            return Ok(());
        }
        self.needs = self.maker.check_head(of, &self.head).map_err(|e| Problem::from(&e))?.filter(|needs| *needs <= MOST);
        if self.needs.is_none() {
            self.head = Vec::new();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::server::maker::{Fault, Product};
    use tmpi_pipeline::photo::PhotoError;
    use tmpi_pipeline::{MakeError, Options, Sink};

    /// Needs more bytes until it has enough, then refuses those with a 9 in them.
    struct Wants {
        bytes: usize,
        step: usize,
        looks: AtomicUsize,
    }

    impl Maker for Wants {
        fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
            Ok(())
        }

        fn check_head(&self, _: HeadOf<'_>, head: &[u8]) -> Result<Option<usize>, MakeError> {
            self.looks.fetch_add(1, Ordering::SeqCst);
            if head.len() < self.bytes {
                return Ok(Some((head.len() + self.step).min(self.bytes)));
            }
            if head.contains(&9) { Err(PhotoError::Unsupported.into()) } else { Ok(None) }
        }

        fn make(&self, _: &[u8], _: Option<&[u8]>, _: &Options, _: &dyn Sink) -> Result<Product, Fault> {
            Err(Fault::Cancelled)
        }
    }

    /// Sends `all` in pieces; returns how many bytes were sent when it was refused, and the number of checks.
    fn sent(bytes: usize, step: usize, all: &[u8], piece: usize) -> (Option<usize>, usize) {
        let wants = Arc::new(Wants { bytes, step, looks: AtomicUsize::new(0) });
        let mut head = UploadHead::new(&(wants.clone() as Arc<dyn Maker>));
        let mut came = 0;
        let refused = all.chunks(piece).find_map(|piece| {
            came += piece.len();
            let refused = head.see(piece, HeadOf::Depth).err()?;
            assert_eq!(refused.status, 415);
            Some(came)
        });
        assert!(head.head.len() <= MOST);
        (refused, wants.looks.load(Ordering::SeqCst))
    }

    #[test]
    fn the_head_is_checked_as_soon_as_enough_bytes_have_arrived() {
        let nine = [vec![1; 20], vec![9], vec![1; 1000]].concat();
        for piece in [1, 7, 64] {
            assert_eq!(sent(100, 30, &nine, piece).0, Some(100_usize.next_multiple_of(piece)), "pieces of {piece}");
        }
        assert_eq!(sent(100, 30, &nine, 2000), (Some(nine.len()), 1));
        assert_eq!(sent(15, 30, &nine, 1), (None, 2), "what comes behind is not looked at");
        assert_eq!(sent(100, 30, &nine[..99], 1).0, None);
        // bounded, whatever the maker asks for
        let long = vec![9; 2 * MOST];
        assert_eq!(sent(MOST, MOST, &long, 1000).0, Some(MOST.next_multiple_of(1000)));
        assert_eq!(sent(MOST + 1, MOST, &long, 1000), (None, 1));
    }
}
