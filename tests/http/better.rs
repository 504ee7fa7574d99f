//! `better_depth`: which callers see it, and making the photo again with the better network.

use std::sync::atomic::AtomicBool;

use tmpi::server::PipelineMaker;

use crate::key_fixture;
use crate::prelude::*;

const WORSE: &str = "tmpi";
const BETTER: &str = "depth-anything-v2-small-fp16";

/// Makes photos with a worse network until the better one is set.
struct Renewing {
    worse: PipelineMaker,
    better: PipelineMaker,
    is_here: AtomicBool,
}

impl Renewing {
    fn new() -> Arc<Self> {
        Arc::new(Self { worse: with_network(WORSE), better: with_network(BETTER), is_here: AtomicBool::new(false) })
    }

    fn now(&self) -> &PipelineMaker {
        if self.is_here.load(Ordering::SeqCst) { &self.better } else { &self.worse }
    }

    fn set(&self, is_here: bool) {
        self.is_here.store(is_here, Ordering::SeqCst);
    }
}

impl Maker for Renewing {
    fn network(&self) -> &str {
        self.now().network()
    }

    fn check(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options) -> Result<(), MakeError> {
        self.now().check(photo, depth, options)
    }

    fn make(&self, photo: &[u8], depth: Option<&[u8]>, options: &Options, sink: &dyn Sink) -> Result<Product, Fault> {
        self.now().make(photo, depth, options, sink)
    }
}

#[test]
fn callers_who_may_make_a_photo_again_are_told_of_a_better_network() {
    let maker = Renewing::new();
    let server = private_with(Limits::default(), maker.clone());
    let (ann, bob) = (secret("a"), secret("b"));
    let key = |name: &str, scope| key_fixture::add(server.data(), name, &[scope]);
    let (reader, boss) = (key("reader", Scope::Read), key("boss", Scope::Admin));
    let photo = format!("/v1/photos/{}", id(&upload(&server, Some(&ann), 1)));
    let state = |who: &str| ask(&server, "GET", &photo, &[("authorization", who)], &[]);
    let told = |who: &str| state(who).json()["better_depth"].clone();
    assert_eq!((state(&ann).json()["state"].clone(), told(&ann)), (json!("done"), Value::Null), "made with the best network");

    maker.set(true);
    for who in [&ann, &boss] {
        assert_eq!(told(who), BETTER);
    }
    assert_eq!(get(server.addr, &photo).json()["better_depth"], BETTER, "this machine's own user");
    state(&bob).problem(404);
    // callers who may only see the photo do not see `better_depth`
    let headers = [("authorization", ann.as_str()), JSON];
    assert_eq!(ask(&server, "PATCH", &photo, &headers, br#"{"visibility": "link"}"#).status, 200);
    let (owners, others) = (state(&ann), state(&bob));
    assert_eq!((&owners.json()["better_depth"], &others.json()["better_depth"]), (&json!(BETTER), &Value::Null));
    assert_eq!(ask(&server, "GET", &photo, &[], &[]).json()["better_depth"], Value::Null, "a stranger");
    assert_eq!(told(&reader), Value::Null);
    assert!(owners.all("cache-control").contains("private") && owners.header("etag") != others.header("etag"));
    let seen = [("authorization", bob.as_str()), ("if-none-match", owners.header("etag").unwrap())];
    assert_eq!(ask(&server, "GET", &photo, &seen, &[]).status, 200, "the owner's tag does not match a stranger's answer");

    // a photo with its own depth map has no better network
    let given =
        post_form(server.addr, &[HOST, ("authorization", &ann), ("prefer", "wait=60")], &[("photo", &jpeg(2)), ("depth", &depth_map())]);
    let given = ask(&server, "GET", &format!("/v1/photos/{}", id(&given.json())), &[("authorization", &ann)], &[]).json();
    assert_eq!((&given["state"], &given["better_depth"]), (&json!("done"), &Value::Null));

    let made = ask(&server, "POST", &format!("{photo}/remake"), &[("authorization", &ann), ("prefer", "wait=60")], &[]);
    assert_eq!((made.status, made.json()["state"].clone()), (200, json!("done")));
    assert_eq!(ask(&server, "GET", &format!("{photo}/report"), &[("authorization", &ann)], &[]).json()["depth_model"], BETTER);
    assert_eq!(told(&ann), Value::Null, "made with the best network");
    // a worse network than the photo's is not offered
    maker.set(false);
    assert_eq!(told(&ann), Value::Null);
}

#[test]
fn without_authentication_every_caller_is_told_of_a_better_network() {
    fn better(server: &Running, path: &str) -> Value {
        request(server.addr, "GET", path, &[HOST], &[]).json()["better_depth"].clone()
    }
    let maker = Renewing::new();
    let server = Running::with(Limits::default(), maker.clone());
    let id = server.make(&jpeg(1));
    let photo = format!("/v1/photos/{id}");
    assert_eq!(better(&server, &photo), Value::Null);
    maker.set(true);
    let server = server.again(Limits::default(), maker.clone());
    assert_eq!(better(&server, &photo), BETTER, "after a restart");
    let list = get(server.addr, "/v1/photos").json();
    assert!(list["photos"][0]["id"] == id.as_str() && list["photos"][0].get("better_depth").is_none(), "{list}");
    // a photo without its report is damaged: nothing is offered
    std::fs::remove_file(&contents(server.data(), &id, "report")[0]).unwrap();
    let server = server.again(Limits::default(), maker);
    assert_eq!(better(&server, &photo), Value::Null);
}
