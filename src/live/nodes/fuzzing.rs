//! A door to what reads messages of other nodes, for [`crate::fuzzing`].

use bytes::Bytes;

use super::wire::{HEAD, Joined, Joiner, Packet, Start};

/// Bytes of the parts that a message is split into again.
const PART: usize = HEAD + 64;

/// Takes payloads, each after its length in two bytes, as they come from another node. A message that is whole is the same after it was split and
/// joined again, and so is a start after it was read and written.
pub fn messages(data: &[u8]) {
    let (mut joiner, mut rest) = (Joiner::default(), data);
    while let Some((length, body)) = rest.split_first_chunk::<2>() {
        let (payload, after) = body.split_at(usize::from(u16::from_le_bytes(*length)).min(body.len()));
        rest = after;
        if let Joined::Whole(packet) = joiner.push(&Bytes::copy_from_slice(payload)) {
            same_again(&packet);
            if let Some(start) = Start::read(packet.bytes.clone()) {
                assert_eq!(start.write(), packet.bytes);
            }
        }
    }
}

fn same_again(packet: &Packet) {
    let (mut joiner, parts) = (Joiner::default(), packet.split(PART).unwrap_or_default());
    assert!(parts.iter().all(|p| p.len() <= PART));
    if let Some(last) = parts.iter().map(|part| joiner.push(part)).last() {
        assert_eq!(last, Joined::Whole(packet.clone()));
    }
}
