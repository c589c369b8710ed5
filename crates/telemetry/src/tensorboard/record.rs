//! TFRecord framing: `length u64 | masked crc32c of length | data | masked crc32c of data`, little-endian.

/// Frames one record.
pub(super) fn frame(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut record = Vec::with_capacity(data.len() + 16);
    record.extend_from_slice(&length);
    record.extend_from_slice(&masked_crc(&length).to_le_bytes());
    record.extend_from_slice(data);
    record.extend_from_slice(&masked_crc(data).to_le_bytes());
    record
}

/// The format masks its checksums so that a checksum of data that holds checksums stays a good one.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data)
        .rotate_right(15)
        .wrapping_add(0xa282_ead8)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Splits a file into its records and checks every checksum.
    pub(in crate::tensorboard) fn unframe(mut bytes: &[u8]) -> Vec<&[u8]> {
        let mut records = Vec::new();
        while !bytes.is_empty() {
            let (length, rest) = bytes.split_at(8);
            let (length_crc, rest) = rest.split_at(4);
            let (data, rest) =
                rest.split_at(u64::from_le_bytes(length.try_into().unwrap()) as usize);
            let (data_crc, rest) = rest.split_at(4);
            assert_eq!(length_crc, masked_crc(length).to_le_bytes());
            assert_eq!(data_crc, masked_crc(data).to_le_bytes());
            records.push(data);
            bytes = rest;
        }
        records
    }

    // The expected bytes of these two tests come from the writer of TensorBoard 2.21 itself.
    #[test]
    fn the_checksum_is_that_of_tensorboard() {
        assert_eq!(masked_crc(b"123456789"), 0xc78a_b0e5);
    }

    #[test]
    fn the_framing_is_that_of_tensorboard() {
        let mut expected = Vec::from(*b"\x08\0\0\0\0\0\0\0\xff\x86\x24\x0f");
        expected.extend_from_slice(b"isodream\xb8\x3b\x05\x44");
        assert_eq!(frame(b"isodream"), expected);
    }
}
