//! How a node reaches the others over NATS.

use std::fmt;
use std::time::Duration;

use async_nats::ConnectOptions;
pub use async_nats::ServerAddr as Address;

/// Longest pause before a lost NATS server is tried again.
const AGAIN: Duration = Duration::from_millis(500);
/// Pause between two looks whether the connection lives; the second that is not answered ends it.
const PING: Duration = Duration::from_secs(2);

/// How a node finds the others.
#[derive(Clone)]
pub struct Config {
    /// Addresses of NATS servers, as `nats://HOST:PORT`; user and password, or a token as user, may stand in them.
    pub servers: Vec<Address>,
    /// `USER:PASSWORD` or a token, for all of them.
    pub login: Option<String>,
    /// Name of this node, as those of rooms; it need not be its alone.
    pub name: String,
}

impl fmt::Debug for Config {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // addresses may hold passwords
        f.debug_struct("Config").field("name", &self.name).finish_non_exhaustive()
    }
}

impl Config {
    /// Options of a connection that is tried again and again, and does not hear what it says itself.
    pub(crate) fn options(&self) -> ConnectOptions {
        let options = ConnectOptions::new();
        let options = match self.login.as_deref().map(str::trim) {
            None => options,
            Some(login) => match login.split_once(':') {
                Some((user, password)) => options.user_and_password(user.to_owned(), password.to_owned()),
                None => options.token(login.to_owned()),
            },
        };
        options
            .name(format!("tmpi {}", self.name))
            .no_echo()
            .retry_on_initial_connect()
            .ping_interval(PING)
            .connection_timeout(PING)
            .reconnect_delay_callback(|attempts| AGAIN.min(Duration::from_millis(50 * attempts as u64)))
    }
}
