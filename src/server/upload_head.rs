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

    use tmpi_pipeline::{MakeError, Options, Sink};

    use super::*;
    use crate::server::maker::{Fault, Product};

    /// Wants twice as many bytes each time, and counts how often it is asked.
    #[derive(Default)]
    struct Doubles(AtomicUsize);

    impl Maker for Doubles {
        fn check(&self, _: &[u8], _: Option<&[u8]>, _: &Options) -> Result<(), MakeError> {
            Ok(())
        }

        fn check_head(&self, _: HeadOf<'_>, head: &[u8]) -> Result<Option<usize>, MakeError> {
            self.0.fetch_add(1, Ordering::SeqCst);
            Ok(Some(2 * head.len()))
        }

        fn make(&self, _: &[u8], _: Option<&[u8]>, _: &Options, _: &dyn Sink) -> Result<Product, Fault> {
            Err(Fault::Cancelled)
        }
    }

    #[test]
    fn a_maker_that_always_wants_more_is_asked_seldom_and_of_a_bounded_head() {
        let maker = Arc::new(Doubles::default());
        let mut head = UploadHead::new(&(maker.clone() as Arc<dyn Maker>));
        for _ in 0..2 * MOST {
            assert!(head.see(&[1], HeadOf::Depth).is_ok() && head.head.len() <= MOST);
        }
        assert!(head.head.is_empty() && maker.0.load(Ordering::SeqCst) < 20);
    }
}
