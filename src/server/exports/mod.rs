//! Export files: their recipes, and how they are written.

mod query;
mod recipe;
mod write;
mod write_limits;

pub use query::ExportQuery;
pub use recipe::Recipe;
pub use write::{Drawing, ExportTask, TITLE, timeout_problem};
pub use write_limits::{WriteRequest, write_export};
