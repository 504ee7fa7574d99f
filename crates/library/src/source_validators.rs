//! What the sources of photos said of them, so that they can be asked whether that has changed.

use crate::Library;
use crate::digest::Digest;
use crate::error::Result;
use crate::ids::PhotoId;

/// The photo that was made of a source, and what the source said of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// The photo.
    pub photo: PhotoId,
    /// Its entity tag at the source.
    pub etag: Option<String>,
    /// When it changed last, in the words of the source.
    pub last_modified: Option<String>,
}

impl Library {
    /// The photo of a source, if it is remembered; `digest` is of the address and all else that makes the photo the same.
    pub async fn source(&self, digest: &Digest) -> Result<Option<Source>> {
        let select = sqlx::query_as("SELECT photo, etag, last_modified FROM sources WHERE digest = $1").bind(digest.as_str());
        let found: Option<(String, _, _)> = select.fetch_optional(self.database().reader()).await?;
        found.map(|(photo, etag, last_modified)| Ok(Source { photo: photo.parse()?, etag, last_modified })).transpose()
    }

    /// Remembers a source until its photo is deleted.
    ///
    /// # Errors
    /// [`LibraryError::NotFound`](crate::LibraryError::NotFound) if the photo is deleted.
    pub async fn remember_source(&self, digest: &Digest, source: &Source) -> Result<()> {
        let mut tx = self.database().write().await?;
        let insert = "INSERT INTO sources (digest, photo, etag, last_modified) VALUES ($1, $2, $3, $4)
            ON CONFLICT (digest) DO UPDATE SET photo = excluded.photo, etag = excluded.etag, last_modified = excluded.last_modified";
        crate::photos::locked_photo(&mut tx, source.photo).await?;
        let insert = sqlx::query(insert).bind(digest.as_str()).bind(source.photo.to_string());
        insert.bind(&source.etag).bind(&source.last_modified).execute(tx.connection()).await?;
        tx.commit().await
    }
}
