//! Query parameters of an export.

use axum::http::Uri;

use crate::export::{ExportFormat, ModelOptions, ModelShape, ModelTextures};
use crate::server::problem::Problem;
use crate::server::routes::Pairs;

/// Format of an export.
#[derive(Clone, Debug, Default, PartialEq, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
pub struct ExportQuery {
    /// `html` (default), `glb`, `ora`, `rgbd` or `zip`.
    #[param(value_type = Option<String>)]
    pub format: ExportFormat,
    /// Space of a `glb`: `relief` (default), which fits into the frame that viewers put around a model, or `metric`, with true distances.
    #[param(value_type = Option<String>)]
    pub shape: ModelShape,
    /// Textures of a `glb`: `plain` (default), JPEG and PNG, which every program reads, or `webp`, which is smaller and needs
    /// `EXT_texture_webp`.
    #[param(value_type = Option<String>)]
    pub textures: ModelTextures,
    /// Version as in the photo's `links`: browsers then cache the file for a year.
    #[param(rename = "v")]
    pub version: Option<String>,
}

impl ExportQuery {
    /// Reads the query.
    ///
    /// # Errors
    /// 400 that names the first parameter that is unknown, given twice or wrong.
    pub fn read(uri: &Uri) -> Result<Self, Problem> {
        Self::of(Pairs::read(uri, &["format", "shape", "textures", "v"])?)
    }

    /// Like [`Self::read`], for parameters that are parsed already.
    pub fn of(mut pairs: Pairs) -> Result<Self, Problem> {
        let format = pairs.parse("format", "html, glb, ora, rgbd or zip", ExportFormat::from_name)?.unwrap_or_default();
        for name in ["shape", "textures"] {
            if format != ExportFormat::Glb && pairs.get(name).is_some() {
                return Err(Problem::parameter(name, "requires format=glb"));
            }
        }
        let (shape, textures) = (pairs.choice("shape")?.unwrap_or_default(), pairs.choice("textures")?.unwrap_or_default());
        Ok(Self { format, shape, textures, version: pairs.take("v") })
    }

    pub const fn model(&self) -> ModelOptions {
        ModelOptions { shape: self.shape, textures: self.textures }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_parameters_are_named() {
        let read = |query: &str| ExportQuery::read(&format!("/export?{query}").parse().unwrap());
        assert_eq!(read("").unwrap().format, ExportFormat::Html);
        assert_eq!(read("format=GLB").unwrap().format, ExportFormat::Glb);
        assert_eq!(read("format=glb&shape=metric").unwrap().shape, ModelShape::Metric);
        for (query, field) in [
            ("format=gltf", "format"),
            ("format=", "format"),
            ("format=zip&format=zip", "format"),
            ("w=3", "w"),
            ("shape=metric", "shape"),
            ("format=glb&shape=flat", "shape"),
            ("textures=webp", "textures"),
            ("format=glb&textures=jpeg", "textures"),
        ] {
            let p = read(query).unwrap_err();
            assert_eq!((p.status, p.field.as_deref()), (400, Some(field)), "{query}");
        }
    }
}
