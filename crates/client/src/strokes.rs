//! Touch-up of a photo's depth by strokes over it.

use reqwest::Method;
use reqwest::header::{CONTENT_TYPE, ETAG, IF_MATCH};
use serde::{Deserialize, Serialize};

use crate::answer::Call;
use crate::photos::part;
use crate::{Client, Error, PhotoState};

/// How a stroke changes the depth below it, as disparity: 0 is infinitely far, 1 the nearest thing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Touch {
    /// Change by this much; negative values move farther.
    By(f64),
    /// As near as this place, in shares of the photo's width and height.
    Like([f64; 2]),
    /// This disparity.
    To(f64),
}

/// A stroke over a photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stroke {
    /// Its middle line, in shares of the photo's width and height, each 0 to 1.
    pub points: Vec<[f64; 2]>,
    /// Half its width as a share of the photo's longer side, 0.002 to 0.25.
    pub radius: f64,
    /// What it changes.
    #[serde(flatten)]
    pub touch: Touch,
}

/// The strokes of a photo.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct Strokes {
    /// In their order.
    pub strokes: Vec<Stroke>,
    /// Tag of these strokes, to change them only if they have not changed meanwhile.
    #[serde(skip)]
    pub tag: Option<String>,
}

/// A change.
#[derive(Serialize)]
struct Patch<'a> {
    strokes: Option<&'a [Stroke]>,
}

impl Client {
    /// The strokes that a photo's depth is touched up with.
    ///
    /// # Errors
    /// [`Error`]; status 404 where there is no such photo, or it is another's.
    pub async fn strokes(&self, id: &str) -> Result<Strokes, Error> {
        let answer = self.ask(Call::new(Method::GET, part(id, "/strokes"))).await?;
        let tag = answer.headers.get(ETAG).and_then(|v| v.to_str().ok()).map(str::to_owned);
        Ok(Strokes { tag, ..answer.json()? })
    }

    /// Replaces all strokes of a photo, at most 100 with 8192 points together; the photo is made again with them, under the same id
    /// ([`Client::finished`]). Without any its depth is as it was, and all but the last undo that one. With `seen`, the tag of strokes,
    /// only if these are still there.
    ///
    /// # Errors
    /// [`Error`]; status 400 names the stroke, 409: the photo is being made, 412: others have changed them.
    pub async fn touch_up(&self, id: &str, strokes: &[Stroke], seen: Option<&str>) -> Result<PhotoState, Error> {
        let patch = Patch { strokes: (!strokes.is_empty()).then_some(strokes) };
        let body = serde_json::to_vec(&patch).map_err(|e| Error::Answer(e.to_string()))?;
        let mut call = Call::new(Method::PATCH, part(id, "/strokes")).header(CONTENT_TYPE, "application/merge-patch+json")?.body(body);
        if let Some(seen) = seen {
            call = call.header(IF_MATCH, seen)?;
        }
        // not idempotent: afterwards the tag has changed, and the photo is being made
        call.again = false;
        self.ask(call).await?.json()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stroke_asks_one_thing() {
        let stroke = Stroke { points: vec![[0.25, 0.5]], radius: 0.125, touch: Touch::By(-0.25) };
        let text = r#"{"points":[[0.25,0.5]],"radius":0.125,"by":-0.25}"#;
        assert_eq!(serde_json::to_string(&stroke).unwrap(), text);
        assert_eq!(serde_json::from_str::<Stroke>(text).unwrap(), stroke);
        let whole = r#"{"points":[[1,0]],"radius":0.25,"to":0}"#;
        assert_eq!(serde_json::from_str::<Stroke>(whole).unwrap().touch, Touch::To(0.0));
        assert!(serde_json::from_str::<Stroke>(r#"{"points":[[1,0]],"radius":0.25}"#).is_err());
    }
}
