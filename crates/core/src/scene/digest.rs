//! A digest of a scene, to compare decoders.

use sha2::{Digest, Sha256};

use super::Scene;

impl Scene {
    /// SHA-256 of a decoded scene, as hexadecimal digits. Hashes, little-endian, each layer's tile (u32), plane (three f64) and rectangle
    /// (four u32); then all classes, alphas and hidden colours.
    pub fn digest(&self) -> String {
        let mut hash = Sha256::new();
        for l in &self.layers {
            hash.update(l.tile.to_le_bytes());
            for value in [l.plane.a, l.plane.b, l.plane.c] {
                hash.update(value.to_le_bytes());
            }
            for value in [l.rect.x, l.rect.y, l.rect.w, l.rect.h] {
                hash.update(value.to_le_bytes());
            }
        }
        hash.update(&self.texels.class);
        hash.update(&self.texels.alpha);
        hash.update(self.texels.hidden.as_flattened());
        hash.finalize().iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"))
    }
}
