//! Webhooks: requests that tell other servers of events, by the Standard Webhooks specification (<https://www.standardwebhooks.com>).
//!
//! | file | what |
//! |---|---|
//! | `configured` | the webhooks of the configuration |
//! | `event` | the body of a request |
//! | `dispatch` | the task that sends them |
//! | `signature` | secrets, and signatures by them |

mod configured;
mod dispatch;
mod event;
mod signature;

pub use configured::ConfiguredWebhook;
pub use dispatch::{Clients, deliver};
pub use event::data;
pub use signature::SigningSecret;

use tmpi_library::EventType;

/// Reads the names of events; none stands for all.
///
/// # Errors
/// What is wrong with them.
pub fn events<S: AsRef<str>>(names: &[S]) -> Result<Vec<EventType>, String> {
    let known = || EventType::ALL.map(EventType::name).join(", ");
    let one = |name: &S| EventType::of_name(name.as_ref()).ok_or_else(|| format!("must be of {}, not {:?}", known(), name.as_ref()));
    let mut all: Vec<EventType> = names.iter().map(one).collect::<Result<_, _>>()?;
    all.sort_unstable();
    all.dedup();
    Ok(if all.is_empty() { EventType::ALL.to_vec() } else { all })
}
