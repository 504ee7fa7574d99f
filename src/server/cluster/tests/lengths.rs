//! Parts of blobs, and what tells their lengths.

use super::*;

/// A store whose parts are read whole.
#[derive(Debug)]
struct Whole(folder::Folder);

impl Blobs for Whole {
    fn put(&self, name: &str, bytes: Vec<u8>) -> io::Result<()> {
        self.0.put(name, bytes)
    }

    fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        self.0.read(name)
    }

    fn discard(&self, name: &str) -> io::Result<()> {
        self.0.discard(name)
    }
}

#[test]
fn a_store_that_knows_no_ranges_keeps_what_the_ports_promise() {
    let dir = tempfile::tempdir().unwrap();
    let whole = Whole(folder::Folder::open(dir.path()).unwrap());
    keeps_its_promises(&whole, &whole.0, 16);
}

#[test]
fn blobs_of_another_length_than_their_records_say_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let one = node(dir.path(), 9000);
    let id = accepted(&one);
    let held = claimed(&one, &hint(&one));
    let of = one.name_of(&held);
    let done = crate::server::records::Done { at_ms: 7, width: 1, height: 1, atlas_bytes: 3, atlas_hash: digest(b"two") };
    let (outcome, blobs) = (crate::server::records::End::Done(done), format!("{}{of}", records::blobs(id)));
    let parts = [(Part::Atlas, b"two"), (Part::Disparity, b"..."), (Part::Thumbnail, b"..."), (Part::Report, b"...")];
    let parts = parts.map(|(part, bytes)| (part, bytes.to_vec()));
    one.end(&held, &of, &End { version: records::VERSION, outcome, blobs }, &parts).unwrap();
    let photo = one.look(id).unwrap().unwrap().photo;
    let names = [records::blob(id, &of, Part::Atlas), records::blob(id, &photo.source, Part::Upload)];
    let told = || audit(&format!("file://{}", dir.path().display()), Duration::from_hours(24), Remedy::Tell).unwrap();
    let sound = told();
    assert!(sound.is_sound() && sound.done == 1, "{sound:?}");
    for (name, whole) in names.iter().zip([&b"two"[..], b"photo"]) {
        for wrong in [&whole[..whole.len() - 1], &[whole, b"."].concat(), b""] {
            one.blobs.put(name, wrong.to_vec()).unwrap();
            let found = told();
            assert_eq!(found.cut, std::slice::from_ref(name), "{} bytes", wrong.len());
            assert!(!found.is_sound());
        }
        one.blobs.put(name, whole.to_vec()).unwrap();
        assert!(told().is_sound());
    }
    one.blobs.discard(&names[0]).unwrap();
    let gone = told();
    assert!(gone.cut.is_empty() && gone.missing.contains(&names[0]), "{gone:?}");
}
