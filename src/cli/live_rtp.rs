//! Receives Opus packets from a program by RTP (RFC 3550, RFC 7587) and passes them on unchanged.

use std::net::Ipv4Addr;
use std::time::Duration;

use bytes::Bytes;
use tokio::net::UdpSocket;
use tokio::time::sleep;

use super::live_client::micros;

/// Length of an RTP header without CSRC list and extensions, as ffmpeg writes it.
const HEAD: usize = 12;
/// First byte of such a header: version 2, no flags.
const PLAIN: u8 = 0x80;
/// RTCP packet types, where RTP has the marker bit and the payload type.
const REPORTS: std::ops::RangeInclusive<u8> = 200..=207;
/// RTP clock rate.
const TICKS: u64 = 48_000;
/// Microseconds by which that clock may drift from this machine's before it is reset: the source paused.
const APART: u64 = 300_000;
/// Longest packet in bytes: more than 20 ms of Opus at its highest bit rate.
const MOST: usize = 4096;
/// Pause after a socket error.
const PAUSE: Duration = Duration::from_millis(20);

/// A local port that receives sound. Nothing is queued beyond the socket's buffer: packets that are not read in time are lost.
pub(super) struct Sound {
    socket: UdpSocket,
    port: u16,
    clock: Clock,
    buffer: Vec<u8>,
}

impl Sound {
    /// Opens a port on loopback.
    pub(super) async fn open() -> std::io::Result<Self> {
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await?;
        let port = socket.local_addr()?.port();
        Ok(Self { socket, port, clock: Clock::default(), buffer: vec![0; MOST] })
    }

    pub(super) const fn port(&self) -> u16 {
        self.port
    }

    /// The next packet and its time in microseconds by this machine's clock. Cancel safe.
    pub(super) async fn next(&mut self) -> (u64, Bytes) {
        loop {
            match self.socket.recv(&mut self.buffer).await {
                Ok(length) => {
                    if let Some((stream, ticks, data)) = packet(&self.buffer[..length])
                        && let Some(time) = self.clock.at(stream, ticks, micros())
                    {
                        return (time, Bytes::copy_from_slice(data));
                    }
                }
                // on some systems the end of the sender shows up as an error
                Err(_) => sleep(PAUSE).await,
            }
        }
    }

    /// Drops unread packets: they are late.
    pub(super) fn skip(&mut self) {
        while self.socket.try_recv(&mut self.buffer).is_ok() {}
    }
}

/// Stream (SSRC), timestamp and payload of a packet; `None` if it is not sound.
fn packet(bytes: &[u8]) -> Option<(u32, u32, &[u8])> {
    let (head, data) = bytes.split_first_chunk::<HEAD>()?;
    let number = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    (head[0] == PLAIN && !REPORTS.contains(&head[1]) && !data.is_empty()).then(|| (number(8), number(4), data))
}

/// Maps the packets' timestamps, which are evenly spaced, to this machine's clock.
#[derive(Debug, Default)]
struct Clock {
    stream: Option<u32>,
    /// The last packet's ticks and microseconds.
    last: Option<(u32, u64)>,
}

impl Clock {
    /// Time of a packet that arrived at `now`, in microseconds; `None` for any stream but the first.
    fn at(&mut self, stream: u32, ticks: u32, now: u64) -> Option<u64> {
        if *self.stream.get_or_insert(stream) != stream {
            return None;
        }
        let even = self.last.map(|(before, time)| time + u64::from(ticks.wrapping_sub(before)) * 1_000_000 / TICKS);
        let time = even.filter(|even| even.abs_diff(now) <= APART).unwrap_or(now);
        self.last = Some((ticks, time));
        Some(time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rtp_sound_is_distinguished_from_rtcp_and_other_packets() {
        // as ffmpeg sends them: a report, then a packet
        let report = [0x80, 0xC8, 0, 6, 0x78, 0xC4, 0x32, 0x20, 1, 2, 3, 4, 5, 6];
        assert_eq!(packet(&report), None);
        let sound = [0x80, 0xE1, 0x0F, 0xAB, 0xD6, 0x44, 0xE9, 0x50, 0x78, 0xC4, 0x32, 0x20, 0xF8, 0xB4];
        assert_eq!(packet(&sound), Some((0x78C4_3220, 0xD644_E950, &[0xF8, 0xB4][..])));
        assert_eq!(packet(&sound[..12]), None, "nothing in it");
        assert_eq!(packet(&sound[..5]), None);
        assert_eq!(packet(&[&[0x90], &sound[1..]].concat()), None, "an extension");
    }

    #[test]
    fn timestamps_survive_jitter_and_wraparound_and_restart_after_a_pause() {
        let mut clock = Clock::default();
        let first = u32::MAX - 1000;
        let tick = |n: u32| first.wrapping_add(960 * n);
        assert_eq!(clock.at(7, tick(0), 5_000_000), Some(5_000_000));
        for n in 1..50 {
            let late = u64::from(n % 5) * 3_000;
            assert_eq!(clock.at(7, tick(n), 5_000_000 + u64::from(n) * 20_000 + late), Some(5_000_000 + u64::from(n) * 20_000));
        }
        assert_eq!(clock.at(8, tick(50), 6_000_000), None, "another sender");
        assert_eq!(clock.at(7, tick(50), 9_000_000), Some(9_000_000), "the source paused");
        assert_eq!(clock.at(7, tick(51), 9_010_000), Some(9_020_000));
        // a jump of the timestamps does not shift the sound
        assert_eq!(clock.at(7, tick(51).wrapping_sub(960), 9_040_000), Some(9_040_000));
    }

    #[tokio::test]
    async fn packets_are_forwarded_and_late_ones_dropped() {
        let mut sound = Sound::open().await.expect("a port");
        let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("a port");
        let send = async |n: u8| {
            let packet = [0x80, 0xE1, 0, n, 0, 0, 0, n, 0, 0, 0, 1, n];
            sender.send_to(&packet, (Ipv4Addr::LOCALHOST, sound.port())).await.expect("it is sent");
        };
        send(1).await;
        send(2).await;
        sound.socket.readable().await.expect("something came");
        assert_eq!(sound.next().await.1[..], [1]);
        sound.skip();
        let port = sound.port();
        sender.send_to(&[0x80, 0xE1, 0, 3, 0, 0, 0, 3, 0, 0, 0, 1, 3], (Ipv4Addr::LOCALHOST, port)).await.expect("it is sent");
        assert_eq!(sound.next().await.1[..], [3]);
    }
}
