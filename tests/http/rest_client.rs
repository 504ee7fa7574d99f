//! The Rust client against a running server.

use tmpi_client::{Client, Error, Settings, State, Upload, Visibility};
use tmpi_testing::{Answer, StandIn};

use crate::prelude::*;

fn client(server: &Running) -> Client {
    Client::new(&format!("http://{}", server.addr)).unwrap()
}

fn kind(error: &Error) -> String {
    let Error::Problem(problem) = error else { panic!("{error:?}") };
    problem.kind.trim_start_matches("urn:tmpi:problem:").to_owned()
}

#[test]
fn a_photo_is_uploaded_and_everything_fetched() {
    let server = Running::open();
    let client = client(&server);
    block_on(async {
        let upload = Upload::of(jpeg(1)).depth(depth_map()).option("title", "a \"sea\" & more").option("quality", "80");
        let accepted = client.upload(upload.clone()).await.unwrap();
        let photo = client.finished(&accepted.id, |_| ()).await.unwrap();
        assert_eq!((photo.state, photo.settings.title.as_deref()), (State::Done, Some("a \"sea\" & more")));
        assert_eq!(photo.options["quality"], "80");
        let again = client.upload(upload.wait(Duration::from_secs(20))).await.unwrap();
        assert_eq!((&again.id, again.state), (&photo.id, State::Done));
        let container = client.container(&photo.id).await.unwrap();
        assert_eq!(container, get(server.addr, &format!("/v1/photos/{}/atlas", photo.id)).body);
        let scene = client.scene(&photo.id).await.unwrap();
        assert_eq!((Some(scene.photo.width), Some(scene.photo.height)), (photo.width, photo.height));
        assert!(client.part(&photo.id, "/atlas?level=1").await.unwrap().len() < container.len());
        let view = client.view(&photo.id, &[("w", "40"), ("tx", "0.01"), ("format", "png")]).await.unwrap();
        assert!(view.starts_with(b"\x89PNG"));
        assert!(client.part(&photo.id, "/depth").await.unwrap().starts_with(b"\x89PNG"));
        let glb = client.export(&photo.id, &[("format", "glb")]).await.unwrap();
        assert!(glb.starts_with(b"glTF") && glb != client.export(&photo.id, &[("format", "glb"), ("shape", "metric")]).await.unwrap());
        let wrong = client.export(&photo.id, &[("format", "glb"), ("path", "orbit"), ("frames", "2")]).await.unwrap_err();
        assert!(matches!(&wrong, Error::Problem(p) if p.field.as_deref() == Some("format")), "{wrong:?}");
        let sky = json!({ "strokes": [{ "points": [[0.2, 0.1]], "radius": 0.1, "to": 0.0 }] });
        client.change(&photo.id, "/strokes", &sky).await.unwrap();
        let touched = client.finished(&photo.id, |_| ()).await.unwrap();
        assert!(touched.version != photo.version && touched.more["atlas_bytes"].is_u64(), "{touched:?}");
        let named = client.change(&photo.id, "", &Settings { title: Some("Sea".into()), ..Settings::default() }).await.unwrap();
        assert_eq!(named.settings.title.as_deref(), Some("Sea"));
        assert_eq!(client.photos().await.unwrap().iter().map(|p| p.id.as_str()).collect::<Vec<_>>(), [photo.id.as_str()]);
        let html = client.embedding(&photo, None).unwrap();
        assert!(html.contains(&format!("http://{}/embed/{}", server.addr, photo.id)) && html.contains("aspect-ratio:80/60"), "{html}");
        client.delete(&photo.id).await.unwrap();
        assert_eq!(client.photo(&photo.id).await.unwrap_err().status(), Some(404));
    });
}

#[test]
fn errors_have_their_kind_and_field() {
    let server = Running::open();
    let client = client(&server);
    block_on(async {
        let refused = client.upload(Upload::of(jpeg(1)).option("planes", "many")).await.unwrap_err();
        assert!(matches!(&refused, Error::Problem(p) if p.status == 400 && p.field.as_deref() == Some("planes")), "{refused:?}");
        let refused = client.upload(Upload::of(&b"no picture"[..])).await.unwrap_err();
        assert_eq!(refused.status(), Some(415), "{refused}");
        for id in ["nothing", "../../healthz", "00000000000000000000000000000000"] {
            assert_eq!(kind(&client.photo(id).await.unwrap_err()), "not-found", "{id}");
        }
        let photo = client.upload(Upload::of(jpeg(1)).wait(Duration::from_secs(20))).await.unwrap();
        let wrong = client.view(&photo.id, &[("w", "0")]).await.unwrap_err();
        assert_eq!(wrong.status(), Some(400));
        let unreachable = Client::new("http://127.0.0.1:1").unwrap().patience(Duration::ZERO);
        assert!(matches!(unreachable.photo(&photo.id).await, Err(Error::Network(_))));
    });
}

#[test]
fn stages_are_reported_until_the_photo_is_made() {
    let gate = Gate::new(0);
    let server = Running::with(Limits::default(), gate.clone());
    let client = client(&server);
    block_on(async {
        let id = client.upload(Upload::of(jpeg(1))).await.unwrap().id;
        let early = client.container(&id).await.unwrap_err();
        assert_eq!(early.status(), Some(409));
        let mut stages = Vec::new();
        let made = client.finished(&id, |stage| {
            stages.push(stage.stage.clone());
            // the gate opens after the first event
            if stages.len() == 1 {
                gate.open(1);
            }
        });
        assert_eq!(made.await.unwrap().state, State::Done);
        assert!(stages.len() > 3 && stages[0] == "photo", "{stages:?}");
    });
}

#[test]
fn photos_belong_to_their_owner_and_a_link_shows_one() {
    let server = private();
    block_on(async {
        let owner = client(&server).with_fresh_owner().unwrap();
        let other = client(&server).with_fresh_owner().unwrap();
        let photo = owner.upload(Upload::of(jpeg(1)).wait(Duration::from_secs(20))).await.unwrap();
        assert_eq!(photo.visibility, Some(Visibility::Private));
        assert_eq!(other.container(&photo.id).await.unwrap_err().status(), Some(404));
        assert_eq!((owner.photos().await.unwrap().len(), other.photos().await.unwrap().len()), (1, 0));
        let link = owner.link(&photo.id, Some(60)).await.unwrap();
        assert_eq!(get(server.addr, &link.atlas).status, 200);
        let html = owner.embedding(&photo, Some(&link)).unwrap();
        assert!(html.contains(&link.query.as_ref().unwrap().replace('&', "&amp;")), "{html}");
        let token = link.manage.as_ref().unwrap().split_once("#manage=").unwrap().1;
        let friend = client(&server).with_key(token).unwrap();
        assert_eq!(friend.photo(&photo.id).await.unwrap().id, photo.id);
        let titled = Settings { title: Some("A friend's".into()), ..Settings::default() };
        assert_eq!(friend.change(&photo.id, "", &titled).await.unwrap().settings.title, titled.title);
        assert_eq!(friend.photos().await.unwrap_err().status(), Some(403));
        owner.take_links_back(&photo.id).await.unwrap();
        assert_eq!(friend.photo(&photo.id).await.unwrap_err().status(), Some(404));
        let shown = Settings { visibility: Some(Visibility::Link), ..Settings::default() };
        assert_eq!(owner.change(&photo.id, "", &shown).await.unwrap().visibility, Some(Visibility::Link));
        assert!(other.container(&photo.id).await.is_ok());
        assert_eq!(other.delete(&photo.id).await.unwrap_err().status(), Some(404));
        let unknown = client(&server).with_key("tmpi_k_nobody").unwrap();
        assert_eq!(unknown.photos().await.unwrap_err().status(), Some(401));
    });
}

/// A server that answers each connection with the next text.
fn answers(texts: &'static [&str]) -> StandIn {
    StandIn::start(|request| Answer::bytes(texts[request.number]))
}

#[test]
fn refused_requests_are_repeated_and_possibly_completed_ones_are_not() {
    const BUSY: &str = "HTTP/1.1 503 Service Unavailable\r\nretry-after: 0\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
    const OFTEN: &str = "HTTP/1.1 429 Too Many Requests\r\nretry-after: 0\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
    const CUT: &str = "HTTP/1.1 200 OK\r\ncontent-length: 100\r\nconnection: close\r\n\r\nnot all";
    const NONE: &str = "HTTP/1.1 404 Not Found\r\ncontent-length: 4\r\nconnection: close\r\n\r\nnone";
    block_on(async {
        let server = answers(&[BUSY, CUT, NONE]);
        let error = Client::new(&server.url("")).unwrap().photo("a").await.unwrap_err();
        assert!(matches!(&error, Error::Problem(p) if p.status == 404 && p.detail == "none"), "{error:?}");
        assert_eq!(server.begun(), 3);
        // an upload without an owner is not repeated after it may have arrived
        let server = answers(&[OFTEN, CUT]);
        let error = Client::new(&server.url("")).unwrap().upload(Upload::of(&b"x"[..])).await.unwrap_err();
        assert!(matches!(error, Error::Network(_)), "{error:?}");
        assert_eq!(server.begun(), 2);
        let server = answers(&[BUSY]);
        assert_eq!(Client::new(&server.url("")).unwrap().upload(Upload::of(&b"x"[..])).await.unwrap_err().status(), Some(503));
        assert_eq!(server.begun(), 1);
        // an owner's upload is repeated, because it gives the same photo
        let server = answers(&[CUT, NONE]);
        let owner = Client::new(&server.url("")).unwrap().with_fresh_owner().unwrap();
        assert_eq!(owner.upload(Upload::of(&b"x"[..])).await.unwrap_err().status(), Some(404));
        assert_eq!(server.begun(), 2);
        let server = answers(&[BUSY]);
        let error = Client::new(&server.url("")).unwrap().patience(Duration::ZERO).photo("a").await.unwrap_err();
        assert_eq!(error.status(), Some(503));
        assert_eq!(server.begun(), 1);
    });
}
