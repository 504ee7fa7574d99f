//! Export files: their recipes, and how they are written.

mod query;
mod recipe;
mod run_export;
mod write;

pub use query::ExportQuery;
pub use recipe::Recipe;
pub use run_export::{WriteRequest, write_export};
pub use write::{Drawing, ExportTask, TITLE, timeout_problem};
