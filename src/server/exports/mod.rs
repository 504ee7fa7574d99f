//! Export files: their recipes, and how they are written.

mod query;
mod recipe;
mod run_export;
mod write;

pub use query::ExportQuery;
pub use recipe::Recipe;
pub use run_export::{export_for_client, write_export};
pub use write::{Drawing, ExportTask, timeout_problem};
