//! A token bucket, which limits the rate of a client's messages.

use tokio::time::Instant;

pub struct Bucket {
    rate: f64,
    most: f64,
    left: f64,
    at: Instant,
}

impl Bucket {
    /// A full bucket of `most` tokens, which gets `rate` tokens a second.
    pub fn new(rate: f64, most: f64) -> Self {
        Self { rate, most, left: most, at: Instant::now() }
    }

    /// Takes tokens; false if it has fewer.
    pub fn take(&mut self, tokens: f64, now: Instant) -> bool {
        let seconds = now.saturating_duration_since(self.at).as_secs_f64();
        (self.left, self.at) = (self.rate.mul_add(seconds, self.left).min(self.most) - tokens, now);
        self.left >= 0.0
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_burst_and_then_the_rate_are_allowed_and_one_more_is_not() {
        let mut bucket = Bucket::new(200.0, 600.0);
        let after = |seconds: u64| bucket.at + Duration::from_secs(seconds);
        let times: Vec<_> = (0..100).map(after).collect();
        assert!((0..600).all(|_| bucket.take(1.0, times[0])));
        for now in &times[1..] {
            assert!((0..100).all(|_| bucket.take(2.0, *now)));
        }
        assert!(!bucket.take(1.0, times[99]));
    }
}
