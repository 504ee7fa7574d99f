//! Export files: their recipes, and how they are written.

mod query;
mod recipe;
mod work;
mod write;

pub use query::ExportQuery;
pub use recipe::Recipe;
pub use work::{Wanted, written};
pub use write::{Drawing, TITLE, Work, late};
