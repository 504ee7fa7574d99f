//! Corrects a photo's depth with strokes (touch-up).

use reqwest::Method;
use reqwest::header::{CONTENT_TYPE, ETAG, IF_MATCH};
use serde::{Deserialize, Serialize};

use crate::photos::photo_path;
use crate::request::Call;
use crate::{Client, Error, PhotoState};

/// How a stroke changes the disparity below it: 0 is infinitely far, 1 is the nearest surface.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Touch {
    /// Add this disparity; negative values move the pixels farther away.
    By(f64),
    /// Use the disparity at this point, given as fractions of the photo's width and height.
    Like([f64; 2]),
    /// Set this disparity.
    To(f64),
}

/// A stroke over a photo.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stroke {
    /// Centre line, as fractions of the photo's width and height, each 0 to 1.
    pub points: Vec<[f64; 2]>,
    /// Half of the stroke's width, as a fraction of the photo's longer side, 0.002 to 0.25.
    pub radius: f64,
    /// How it changes the disparity.
    #[serde(flatten)]
    pub touch: Touch,
}

/// The strokes of a photo.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[non_exhaustive]
pub struct Strokes {
    /// The strokes, in the order in which they apply.
    pub strokes: Vec<Stroke>,
    /// Entity tag of these strokes. Pass it to [`Client::touch_up`] to detect concurrent changes.
    #[serde(skip)]
    pub tag: Option<String>,
}

/// Body of a merge patch.
#[derive(Serialize)]
struct Patch<'a> {
    strokes: Option<&'a [Stroke]>,
}

impl Client {
    /// The strokes of a photo.
    ///
    /// # Errors
    /// [`Error`]; status 404 if the photo does not exist or has another owner.
    pub async fn strokes(&self, id: &str) -> Result<Strokes, Error> {
        let answer = self.request(Call::new(Method::GET, photo_path(id, "/strokes"))).await?;
        let tag = answer.headers.get(ETAG).and_then(|v| v.to_str().ok()).map(str::to_owned);
        Ok(Strokes { tag, ..answer.json()? })
    }

    /// Replaces all strokes of a photo: at most 100, with at most 8192 points in total. The server then processes the photo again under
    /// the same id; wait for it with [`Client::finished`].
    ///
    /// To undo the last stroke, pass all but the last; to restore the original depth, pass none. If `tag` is set to
    /// [`Strokes::tag`], the change applies only if the strokes have not changed since.
    ///
    /// # Errors
    /// [`Error`]; status 400 names the invalid stroke, 409: the photo is being processed, 412: the strokes have changed.
    pub async fn touch_up(&self, id: &str, strokes: &[Stroke], tag: Option<&str>) -> Result<PhotoState, Error> {
        let patch = Patch { strokes: (!strokes.is_empty()).then_some(strokes) };
        let body = serde_json::to_vec(&patch).map_err(|e| Error::Answer(e.to_string()))?;
        let mut call =
            Call::new(Method::PATCH, photo_path(id, "/strokes")).header(CONTENT_TYPE, "application/merge-patch+json")?.body(body);
        if let Some(tag) = tag {
            call = call.header(IF_MATCH, tag)?;
        }
        // not idempotent: the first try changes the tag and starts processing
        call.idempotent = false;
        self.request(call).await?.json()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stroke_has_exactly_one_effect() {
        let stroke = Stroke { points: vec![[0.25, 0.5]], radius: 0.125, touch: Touch::By(-0.25) };
        let text = r#"{"points":[[0.25,0.5]],"radius":0.125,"by":-0.25}"#;
        assert_eq!(serde_json::to_string(&stroke).unwrap(), text);
        assert_eq!(serde_json::from_str::<Stroke>(text).unwrap(), stroke);
        let whole = r#"{"points":[[1,0]],"radius":0.25,"to":0}"#;
        assert_eq!(serde_json::from_str::<Stroke>(whole).unwrap().touch, Touch::To(0.0));
        assert!(serde_json::from_str::<Stroke>(r#"{"points":[[1,0]],"radius":0.25}"#).is_err());
    }
}
