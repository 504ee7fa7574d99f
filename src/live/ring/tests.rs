use super::*;
use proptest::prelude::*;

fn message(n: u8, length: usize) -> Bytes {
    vec![n; length].into()
}

/// Frames of 10 kB, a key every `gop`, 30 a second, from `start` on.
fn frames(ring: &mut Ring, numbers: std::ops::Range<u32>, gop: u32, start: Instant) {
    for n in numbers {
        let what = if n.is_multiple_of(gop) { MessageKind::Key } else { MessageKind::Frame { layer: 0 } };
        ring.push(what, message(n as u8, 10_000), start + Duration::from_millis(u64::from(n) * 33));
    }
}

fn read(ring: &Ring, cursor: &mut Cursor, now: Instant) -> Vec<u8> {
    let mut read = Vec::new();
    while let Step::Send(bytes) = ring.step(cursor, now) {
        read.push(bytes[0]);
    }
    read
}

#[test]
fn a_late_viewer_begins_with_the_last_key_frame() {
    let (mut ring, start) = (Ring::default(), Instant::now());
    frames(&mut ring, 0..100, 60, start);
    let now = start + Duration::from_millis(100 * 33);
    let mut cursor = ring.begin(now);
    assert_eq!(read(&ring, &mut cursor, now), (60..100).collect::<Vec<u8>>());
    assert_eq!((ring.step(&mut cursor, now), cursor.skipped), (Step::Wait, 0));
}

#[test]
fn a_viewer_without_a_key_frame_waits_for_one() {
    let (mut ring, now) = (Ring::default(), Instant::now());
    let mut cursor = ring.begin(now);
    ring.push(MessageKind::Frame { layer: 0 }, message(1, 10), now);
    ring.push(MessageKind::Geometry { frame: 1 }, message(2, 10), now);
    ring.push(MessageKind::Key, message(3, 10), now);
    ring.push(MessageKind::Frame { layer: 0 }, message(4, 10), now);
    assert_eq!(ring.step(&mut cursor, now), Step::Skipped { wants_key: false }, "the dropped tiles come first");
    assert_eq!(cursor.known(), None);
    cursor.set_known(1);
    assert_eq!(read(&ring, &mut cursor, now), [3, 4]);
    assert_eq!(ring.step(&mut cursor, now), Step::Wait);
}

#[test]
fn a_viewer_that_stops_reading_skips_to_a_key_frame_and_never_gets_half_a_group() {
    let (mut ring, start) = (Ring::default(), Instant::now());
    let mut cursor = ring.begin(start);
    frames(&mut ring, 0..10, 60, start);
    assert_eq!(read(&ring, &mut cursor, start + Duration::from_millis(330)).len(), 10);
    frames(&mut ring, 10..130, 60, start);
    let now = start + Duration::from_millis(130 * 33);
    assert_eq!(ring.step(&mut cursor, now), Step::Skipped { wants_key: false });
    assert_eq!(read(&ring, &mut cursor, now), (120..130).collect::<Vec<u8>>());
    assert!(cursor.skipped > 50, "{}", cursor.skipped);
    // past the key and behind again: waits for the next key
    frames(&mut ring, 130..175, 60, start);
    let now = start + Duration::from_millis(175 * 33);
    assert_eq!(ring.step(&mut cursor, now), Step::Skipped { wants_key: true });
    frames(&mut ring, 175..182, 60, start);
    assert_eq!(read(&ring, &mut cursor, start + Duration::from_millis(182 * 33)), [180, 181]);
}

#[test]
fn a_hidden_viewer_gets_only_sound_then_resumes_with_a_key_frame_and_no_sound_twice() {
    let (mut ring, start) = (Ring::default(), Instant::now());
    let at = |n: u8| start + Duration::from_millis(u64::from(n) * 20);
    let mut cursor = ring.begin(start);
    // sound between the frames, a key frame at 0, 20, 40, …; geometry at 5, 25, …
    let push = |ring: &mut Ring, numbers: std::ops::Range<u8>| {
        for n in numbers {
            let what = match n % 20 {
                0 => MessageKind::Key,
                5 => MessageKind::Geometry { frame: n.into() },
                k if k % 2 == 1 => MessageKind::Sound,
                _ => MessageKind::Frame { layer: 0 },
            };
            ring.push(what, message(n, 10), at(n));
        }
    };
    push(&mut ring, 0..4);
    assert_eq!(read(&ring, &mut cursor, at(4)), [0, 1, 2, 3]);
    cursor.pause(true);
    push(&mut ring, 4..30);
    let sounds = |range: std::ops::Range<u8>| range.filter(|n| n % 2 == 1 && n % 20 != 5).collect::<Vec<u8>>();
    assert_eq!(read(&ring, &mut cursor, at(30)), sounds(4..30));
    push(&mut ring, 30..34);
    assert_eq!((ring.step(&mut cursor, at(200)), cursor.skipped), (Step::Wait, 0), "sound older than a second is dropped");
    push(&mut ring, 34..36);
    cursor.pause(false);
    assert_eq!(ring.step(&mut cursor, at(36)), Step::Skipped { wants_key: false });
    assert_eq!(cursor.known(), None, "the tiles were dropped");
    cursor.set_known(25);
    assert_eq!(read(&ring, &mut cursor, at(36)), [20, 22, 24, 25, 26, 28, 30, 32, 34, 35], "no sound comes twice");
    // nothing changes for a visible viewer
    cursor.pause(false);
    push(&mut ring, 36..38);
    assert_eq!(read(&ring, &mut cursor, at(38)), [36, 37]);
    // a place in another publisher's ring
    cursor.pause(true);
    let other = Ring::default();
    let mut cursor = cursor.restarted(&other, at(38));
    assert!(cursor.is_paused());
    cursor.pause(false);
    assert_eq!(other.step(&mut cursor, at(38)), Step::Skipped { wants_key: true });
}

#[test]
fn higher_temporal_layers_are_dropped_before_anything_is_skipped() {
    let (mut ring, now) = (Ring::default(), Instant::now());
    let mut cursor = ring.begin(now);
    ring.push(MessageKind::Key, message(0, 100), now);
    for n in 1..=60u8 {
        let layer = [0, 2, 1, 2][usize::from(n % 4)];
        ring.push(MessageKind::Frame { layer }, message(n, 15_000), now);
    }
    let got = read(&ring, &mut cursor, now);
    let has = |layer: [u8; 2], range: std::ops::Range<u8>| range.filter(|n| layer.contains(&(n % 4))).all(|n| got.contains(&n));
    assert!(has([0, 0], 1..61) && has([1, 3], 50..61) && !got.contains(&1) && !got.contains(&2));
    assert!(got.is_sorted() && cursor.skipped > 20);
}

#[test]
fn frames_that_may_refer_to_a_dropped_frame_are_dropped() {
    let (mut ring, now) = (Ring::default(), Instant::now());
    let mut cursor = ring.begin(now);
    ring.push(MessageKind::Key, message(0, 100), now);
    // a frame of layer 1 far from the end, and the next near it
    for (n, layer, length) in [(1, 1, 100), (2, 2, 600_000), (3, 1, 100), (4, 0, 100), (5, 2, 100), (6, 1, 100)] {
        ring.push(MessageKind::Frame { layer }, message(n, length), now);
    }
    assert_eq!(read(&ring, &mut cursor, now), [0, 4, 5, 6]);
    assert_eq!(cursor.skipped, 3);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// For any input and any reader: memory is bounded, order is kept, and no frame is sent without those that it refers to.
    #[test]
    fn any_reader_gets_whole_groups_in_order(steps in prop::collection::vec((0u8..12, 0u16..60_000, 0u64..200, 0u8..4), 1..400)) {
        let (mut ring, mut now) = (Ring::default(), Instant::now());
        let mut cursor = ring.begin(now);
        let (mut sent, mut got, mut next): (Vec<(u32, MessageKind)>, Option<u32>, u32) = (Vec::new(), None, 0);
        let frame_of = |what: &MessageKind| if let MessageKind::Geometry { frame } = what { Some(*frame) } else { None };
        for (kind, length, ms, reads) in steps {
            now += Duration::from_millis(ms);
            let what = match kind { 0 => MessageKind::Key, 1 => MessageKind::Geometry { frame: next.into() }, 2 => MessageKind::Sound, _ => MessageKind::Frame { layer: 0 } };
            let mut bytes = next.to_le_bytes().to_vec();
            bytes.resize(usize::from(length).max(4), 0);
            ring.push(what, bytes.into(), now);
            sent.push((next, what));
            next += 1;
            prop_assert!(ring.kept <= KEPT_BYTES);
            for _ in 0..reads {
                let step = ring.step(&mut cursor, now);
                if matches!(step, Step::Skipped { .. })
                    && let Some(newest) = sent.iter().filter_map(|(_, w)| frame_of(w)).next_back()
                {
                    cursor.set_known(newest);
                }
                if let Step::Send(bytes) = step {
                    let n = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                    prop_assert!(got.is_none_or(|g| g < n));
                    // the viewer has all tiles that came before this message
                    let tiles = sent[..n as usize].iter().filter_map(|(_, w)| frame_of(w)).next_back();
                    let is_sound = sent[n as usize].1 == MessageKind::Sound;
                    prop_assert!(is_sound || tiles <= cursor.known(), "{tiles:?} before {n}, known are those of {:?}", cursor.known());
                    if let MessageKind::Frame { .. } = sent[n as usize].1 {
                        let before = sent[..n as usize].iter().rev().find(|(_, w)| matches!(w, MessageKind::Key | MessageKind::Frame { .. }));
                        // it has the frame to which this one refers, too
                        prop_assert!(before.is_some_and(|(b, _)| got.is_some_and(|g| g >= *b)), "frame {n} after {got:?}");
                    }
                    got = Some(n);
                }
            }
        }
    }
}
