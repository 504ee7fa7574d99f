//! How much one owner may have.

use std::collections::HashMap;

use axum::http::StatusCode;

use super::Jobs;
use crate::server::access::Owner;
use crate::server::problem::Problem;

impl Jobs {
    /// Looks whether `owner` may have one more photo, of at least so many bytes. This machine's own user may, and who is not known is not
    /// counted.
    ///
    /// # Errors
    /// 403 that names the limit.
    pub fn quota(&self, owner: Option<&Owner>, bytes: u64) -> Result<(), Problem> {
        let limits = &self.limits;
        if limits.quota_photos.is_none() && limits.quota_bytes.is_none() {
            return Ok(());
        }
        let Some(owner) = owner.filter(|owner| !owner.is_own()) else { return Ok(()) };
        let (photos, taken) = {
            let inner = self.lock();
            let theirs = inner.by_owner.get(owner);
            (theirs.map_or(0, HashMap::len), theirs.map_or(0, |all| all.values().map(|entry| entry.bytes()).sum::<u64>()))
        };
        let refused = |detail: String| Err(Problem::new(StatusCode::FORBIDDEN, "quota", detail));
        match (limits.quota_photos, limits.quota_bytes) {
            (Some(most), _) if photos >= most => refused(format!(
                "you have {photos} photos, and {most} is the limit (--quota-photos): delete one, and there is room for another"
            )),
            (_, Some(most)) if taken.saturating_add(bytes) > most => refused(format!(
                "your photos take {taken} bytes, this one {bytes}, and {most} is the limit (--quota-mib): delete some, and there is room"
            )),
            _ => Ok(()),
        }
    }
}
