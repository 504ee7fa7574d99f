//! Webhooks: requests that tell other servers of events, by the Standard Webhooks specification (<https://www.standardwebhooks.com>).
//!
//! | file | what |
//! |---|---|
//! | `configured` | the webhooks of the configuration |
//! | `dispatch` | the task that sends them |
//! | `payload` | the body of a request |
//! | `signature` | secrets, and signatures by them |

mod configured;
mod dispatch;
mod payload;
mod signature;

pub use configured::{ConfiguredWebhook, event_types};
pub use dispatch::{Clients, deliver};
pub use payload::data;
pub use signature::SigningSecret;
