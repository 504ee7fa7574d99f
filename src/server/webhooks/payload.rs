//! The body of a webhook's request. It is small: receivers fetch the rest.

use serde_json::{Value, json};
use tmpi_library::{Delivery, EventData, EventType, ExportData, PhotoId};

use crate::server::base_path::BasePath;
use crate::server::exports::Recipe;
use crate::server::problem::Problem;
use crate::server::timestamps::rfc3339;

/// The body of a delivery: type, time and data, with paths below `base`. `origin` is `https://HOST` of this server, if it knows that;
/// paths then become addresses, too.
pub fn body(delivery: &Delivery, base: &BasePath, origin: Option<&str>) -> String {
    json!({ "type": delivery.event.name(), "timestamp": rfc3339(delivery.created_at), "data": data(delivery, base, origin) }).to_string()
}

/// The data of a delivery.
pub fn data(delivery: &Delivery, base: &BasePath, origin: Option<&str>) -> Value {
    let EventData { photo, title, export, problem, room } = &delivery.data;
    let mut data = match (photo, export, room) {
        (Some(photo), Some(export), _) => of_export(*photo, export, delivery.event, base),
        (Some(photo), None, _) => of_photo(*photo, delivery.event, base),
        (None, _, Some(room)) => json!({ "room": room, "path": base.at(&format!("/live/{room}")) }),
        (None, _, None) => json!({}),
    };
    if let Some(title) = title {
        data["title"] = title.as_str().into();
    }
    if let Some(problem) = problem {
        let Problem { kind, detail, field, .. } = Problem::of_library(problem);
        data["problem"] = json!({ "type": kind, "detail": detail });
        if let Some(field) = field {
            data["problem"]["field"] = field.as_ref().into();
        }
    }
    if let Some((origin, path)) = origin.zip(data["path"].as_str()) {
        data["url"] = format!("{origin}{path}").into();
    }
    data
}

fn of_photo(photo: PhotoId, event: EventType, base: &BasePath) -> Value {
    let path = base.at(&format!("/v1/photos/{photo}"));
    match event {
        EventType::PhotoDeleted => json!({ "id": photo, "state": "deleted" }),
        EventType::PhotoFailed => json!({ "id": photo, "state": "failed", "path": path }),
        _ => json!({ "id": photo, "state": "done", "path": path, "page": base.at(&format!("/view/{photo}")) }),
    }
}

fn of_export(photo: PhotoId, export: &ExportData, event: EventType, base: &BasePath) -> Value {
    let ExportData { key, payload, .. } = export;
    let (_, ending) = payload.as_str().and_then(Recipe::kind).unwrap_or_default();
    let path = base.at(&format!("/v1/photos/{photo}/exports/{key}"));
    let mut data = json!({ "photo": photo, "key": key, "format": ending, "state": "failed", "path": path });
    if event == EventType::ExportDone {
        data["state"] = "done".into();
        data["file"] = format!("{path}/file").into();
    }
    data
}

#[cfg(test)]
mod tests {
    use tmpi_library::{DeliveryState, JobKind};

    use super::*;

    fn told(event: EventType, data: EventData) -> Value {
        let (created_at, state) = (1_767_225_600_001, DeliveryState::Pending);
        let (run_after, attempts) = (created_at, 1);
        let delivery = Delivery {
            id: "msg_1".into(),
            event,
            data,
            created_at,
            run_after,
            attempts,
            state,
            status: None,
            error: None,
            took_ms: None,
            ended_at: None,
        };
        serde_json::from_str(&body(&delivery, &BasePath::default(), Some("https://photos.example"))).unwrap()
    }

    #[test]
    fn a_body_has_what_a_receiver_needs_to_fetch_the_rest() {
        let photo = PhotoId::from_bytes([7; 16]);
        let data = EventData { photo: Some(photo), title: Some("A \"title\"".into()), ..EventData::default() };
        let path = format!("/v1/photos/{photo}");
        let done = told(EventType::PhotoDone, data.clone());
        assert_eq!(
            done,
            json!({ "type": "photo.done", "timestamp": "2026-01-01T00:00:00.001Z", "data": {
                "id": photo, "state": "done", "title": "A \"title\"", "path": path, "page": format!("/view/{photo}"),
                "url": format!("https://photos.example{path}") } })
        );
        let problem = Some(tmpi_library::Problem { field: Some("photo".into()), ..tmpi_library::Problem::new("broken-photo", "why") });
        let failed = told(EventType::PhotoFailed, EventData { problem: problem.clone(), ..data.clone() });
        assert_eq!(failed["data"]["problem"], json!({ "type": "urn:tmpi:problem:broken-photo", "detail": "why", "field": "photo" }));
        assert_eq!(told(EventType::PhotoDeleted, data.clone())["data"], json!({ "id": photo, "state": "deleted", "title": "A \"title\"" }));
        let export = ExportData { key: "k".into(), kind: JobKind::Film, payload: "path=orbit&format=mp4".into() };
        let written = told(EventType::ExportDone, EventData { export: Some(export.clone()), ..data.clone() });
        assert_eq!(written["data"]["file"], format!("{path}/exports/k/file"));
        assert_eq!((&written["data"]["format"], &written["data"]["state"]), (&"mp4".into(), &"done".into()));
        let unwritten = told(EventType::ExportFailed, EventData { export: Some(export), problem, ..data });
        assert!(unwritten["data"]["file"].is_null() && unwritten["data"]["problem"].is_object());
        let room = told(EventType::RoomStarted, EventData { room: Some("attic".into()), ..EventData::default() });
        assert_eq!((&room["data"]["room"], &room["data"]["path"]), (&"attic".into(), &"/live/attic".into()));
        assert_eq!(told(EventType::Ping, EventData::default())["data"], json!({}));
    }
}
