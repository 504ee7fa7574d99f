//! The checksum of label bands: CRC-32 of IEEE 802.3, four bits at a time. Crates are faster, but many times as large in wasm.

/// Remainders of all four-bit values.
const TABLE: [u32; 16] = table();

const fn table() -> [u32; 16] {
    let mut table = [0; 16];
    let mut bits = 0;
    while bits < table.len() {
        let (mut value, mut bit) = (bits as u32, 0);
        while bit < 4 {
            value = if value & 1 == 1 { value >> 1 ^ 0xEDB8_8320 } else { value >> 1 };
            bit += 1;
        }
        table[bits] = value;
        bits += 1;
    }
    table
}

/// CRC-32 of `bytes`.
pub fn crc32(bytes: &[u8]) -> u32 {
    let half = |crc: u32| TABLE[(crc & 15) as usize] ^ crc >> 4;
    !bytes.iter().fold(!0, |crc, &byte| half(half(crc ^ u32::from(byte))))
}

#[cfg(test)]
mod tests {
    #[test]
    fn crc_matches_the_check_value_of_the_standard() {
        assert_eq!(super::crc32(b"123456789"), 0xCBF4_3926);
    }
}
