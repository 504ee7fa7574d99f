//! Multipart forms (RFC 7578), used to upload a photo with a depth map.

use bytes::{BufMut as _, Bytes, BytesMut};

use crate::{Error, hex};

/// Encodes a form; returns its media type and body.
pub(crate) fn form(parts: &[(&str, &[u8])]) -> Result<(String, Bytes), Error> {
    let mut random = [0; 16];
    getrandom::fill(&mut random).map_err(|_| Error::Key)?;
    // 128 random bits do not occur in any part
    let boundary = hex(&random);
    let mut body = BytesMut::with_capacity(parts.iter().map(|(name, bytes)| name.len() + bytes.len() + 128).sum::<usize>() + 64);
    for (name, bytes) in parts {
        body.put_slice(format!("--{boundary}\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n").as_bytes());
        body.put_slice(bytes);
        body.put_slice(b"\r\n");
    }
    body.put_slice(format!("--{boundary}--\r\n").as_bytes());
    Ok((format!("multipart/form-data; boundary={boundary}"), body.freeze()))
}
