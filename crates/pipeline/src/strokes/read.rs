//! Strokes as JSON: `{"version": 1, "strokes": [{"points": [[x, y], …], "radius": r, "by": 0.1}, …]}`.

use serde_json::{Map, Value, json};

use super::{BYTES, Effect, Stroke, VERSION, check};

/// What is wrong with strokes, and where.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}{detail}", before(.field.as_deref()))]
pub struct StrokeError {
    /// Path of the invalid field, such as `strokes[2].points[0]`; `None` if the file as a whole is invalid.
    pub field: Option<String>,
    /// What is allowed, and what was given.
    pub detail: String,
}

/// Prefix of a message.
fn before(field: Option<&str>) -> String {
    field.map_or_else(String::new, |field| format!("{field}: "))
}

impl StrokeError {
    pub(super) fn at(field: &str, detail: impl Into<String>) -> Self {
        Self { field: Some(field.to_owned()), detail: detail.into() }
    }

    fn whole(detail: impl Into<String>) -> Self {
        Self { field: None, detail: detail.into() }
    }

    /// The same error for a field of `outer`.
    pub(super) fn within(self, outer: &str) -> Self {
        let field = match self.field {
            Some(inner) if !inner.is_empty() => format!("{outer}.{inner}"),
            _ => outer.to_owned(),
        };
        Self { field: Some(field), ..self }
    }
}

/// Reads a file of strokes.
///
/// # Errors
/// [`StrokeError`] that names the field.
pub fn read(bytes: &[u8]) -> Result<Vec<Stroke>, StrokeError> {
    patch(bytes).map(Option::unwrap_or_default)
}

/// Reads a merge patch (RFC 7396) of a file of strokes. Returns all strokes, none of them if they are null, and `None` if the patch
/// leaves them unchanged.
///
/// # Errors
/// [`StrokeError`] that names the field.
pub fn patch(bytes: &[u8]) -> Result<Option<Vec<Stroke>>, StrokeError> {
    if bytes.len() > BYTES {
        return Err(StrokeError::whole(format!("strokes have at most {BYTES} bytes")));
    }
    let all: Value = serde_json::from_slice(bytes).map_err(|e| StrokeError::whole(format!("this is not JSON: {e}")))?;
    let Value::Object(all) = all else { return Err(StrokeError::whole("this must be a JSON object")) };
    let mut strokes = None;
    for (name, value) in &all {
        match (name.as_str(), value) {
            ("version", v) if v.as_u64() == Some(VERSION.into()) => {}
            ("version", v) => return Err(StrokeError::at(name, format!("must be {VERSION}, not {}", short(v)))),
            ("strokes", Value::Null) => strokes = Some(Vec::new()),
            ("strokes", Value::Array(list)) => {
                let one = |(i, v)| stroke(v).map_err(|e| e.within(&format!("strokes[{i}]")));
                strokes = Some(list.iter().enumerate().map(one).collect::<Result<_, _>>()?);
            }
            ("strokes", v) => return Err(StrokeError::at(name, format!("must be a list, not {}", short(v)))),
            _ => return Err(StrokeError::at(name, "unknown field; the fields are version, strokes")),
        }
    }
    if let Some(strokes) = &strokes {
        check(strokes)?;
    }
    Ok(strokes)
}

/// Writes a file of strokes, which [`read`] reads.
pub fn write(strokes: &[Stroke]) -> Vec<u8> {
    json!({ "version": VERSION, "strokes": strokes }).to_string().into_bytes()
}

fn stroke(value: &Value) -> Result<Stroke, StrokeError> {
    const ASKS: &str = "exactly one of by, like, to";
    let fields: &Map<String, Value> = value.as_object().ok_or_else(|| StrokeError::at("", "must be an object"))?;
    let (mut points, mut radius, mut effect) = (None, None, None);
    for (name, value) in fields {
        let asked = match name.as_str() {
            "points" => {
                let list = value.as_array().ok_or_else(|| StrokeError::at(name, "must be a list of points"))?;
                let one = |(i, v)| point(v).map_err(|e: StrokeError| e.within(&format!("points[{i}]")));
                points = Some(list.iter().enumerate().map(one).collect::<Result<Vec<_>, _>>()?);
                continue;
            }
            "radius" => {
                radius = Some(number(name, value)?);
                continue;
            }
            "by" => Effect::By(number(name, value)?),
            "to" => Effect::To(number(name, value)?),
            "like" => Effect::Like(point(value).map_err(|e| e.within(name))?),
            _ => return Err(StrokeError::at(name, "unknown field; the fields are points, radius, by, like, to")),
        };
        if effect.replace(asked).is_some() {
            return Err(StrokeError::at(name, format!("a stroke has {ASKS}")));
        }
    }
    let points = points.ok_or_else(|| StrokeError::at("points", "is missing"))?;
    let radius = radius.ok_or_else(|| StrokeError::at("radius", "is missing"))?;
    let effect = effect.ok_or_else(|| StrokeError::at("by", format!("is missing: a stroke has {ASKS}")))?;
    Ok(Stroke { points, radius, effect })
}

fn point(value: &Value) -> Result<[f64; 2], StrokeError> {
    let two = value.as_array().and_then(|v| <&[Value; 2]>::try_from(v.as_slice()).ok());
    let numbers = two.and_then(|[x, y]| Some([x.as_f64()?, y.as_f64()?]));
    numbers.ok_or_else(|| StrokeError::at("", format!("must be [x, y], not {}", short(value))))
}

fn number(name: &str, value: &Value) -> Result<f64, StrokeError> {
    value.as_f64().ok_or_else(|| StrokeError::at(name, format!("must be a number, not {}", short(value))))
}

/// A foreign value as it is repeated in a message: at most 40 characters.
fn short(value: &Value) -> String {
    value.to_string().chars().take(40).collect()
}
