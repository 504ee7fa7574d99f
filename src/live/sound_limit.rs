//! Rate limit for a publisher's sound, which goes to every viewer unparsed.

use tokio::time::Instant;

/// Packets a second: four times those of Opus with its usual 20 ms packets.
const MESSAGES: u32 = 200;
/// Bytes a second: the highest bit rate of Opus.
const BYTES: u32 = 64 << 10;
/// Burst size in seconds: a connection that stalled delivers its packets all at once.
const BURST: u32 = 3;

/// A token bucket for packets and bytes.
pub struct Allowance {
    messages: f64,
    bytes: f64,
    at: Instant,
}

impl Allowance {
    /// Starts with a full bucket.
    pub fn new(now: Instant) -> Self {
        Self { messages: f64::from(MESSAGES * BURST), bytes: f64::from(BYTES * BURST), at: now }
    }

    /// Counts a packet.
    ///
    /// # Errors
    /// The publisher exceeds a limit; the text is for the publisher.
    pub fn take(&mut self, bytes: usize, now: Instant) -> Result<(), String> {
        let seconds = now.saturating_duration_since(self.at).as_secs_f64();
        let filled = |left: f64, rate: u32| f64::from(rate).mul_add(seconds, left).min(f64::from(rate * BURST));
        (self.messages, self.bytes, self.at) = (filled(self.messages, MESSAGES), filled(self.bytes, BYTES), now);
        (self.messages, self.bytes) = (self.messages - 1.0, self.bytes - bytes as f64);
        if self.messages < 0.0 {
            return Err(format!("more than {MESSAGES} packets of sound a second"));
        }
        if self.bytes < 0.0 {
            return Err(format!("more than {BYTES} bytes of sound a second"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn sound_at_the_limit_is_accepted_and_one_packet_or_byte_more_is_not() {
        let start = Instant::now();
        let after = |seconds: u64| start + Duration::from_secs(seconds);
        let mut packets = Allowance::new(start);
        assert!((0..MESSAGES * BURST).all(|_| packets.take(9, start).is_ok()));
        // then at the limit indefinitely
        for second in 1..100 {
            assert!((0..MESSAGES).all(|_| packets.take(9, after(second)).is_ok()), "second {second}");
        }
        assert!(packets.take(9, after(99)).is_err_and(|reason| reason.contains("200 packets")));
        let mut bytes = Allowance::new(start);
        assert!((0..BURST * 4).all(|_| bytes.take(16 << 10, start).is_ok()));
        assert!((0..4).all(|_| bytes.take(16 << 10, after(1)).is_ok()));
        assert!(bytes.take(1, after(1)).is_err_and(|reason| reason.contains("65536 bytes")));
    }
}
