//! TensorBoard's event files: a sequence of framed protocol buffers, only ever added to.
//!
//! A frame is the length of its message (u64, little-endian), the checksum of those eight bytes, the message, and the
//! checksum of the message. Checksums are CRC-32C, "masked" so that one of data that hold checksums is no special case.
//! After TensorFlow's `record_writer.h` and `event.proto`.

mod histogram;
mod message;
mod read;
mod write;

pub use histogram::Histogram;
pub use message::{Event, Image, Point, SessionLog, Status, Summary, What, Worth};
pub use read::{EventFile, read_events};
pub use write::{EventWriter, FILE_VERSION};

/// The checksum of a part of a frame.
fn checksum(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CRC-32C of "123456789" is the published check value of that polynomial.
    #[test]
    fn checksums_are_masked_castagnoli() {
        assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(checksum(b"123456789"), 0xc78a_b0e5);
        // The length of the first event of every file that TensorFlow has written: 24 bytes.
        assert_eq!(checksum(&24u64.to_le_bytes()), u32::from_le_bytes([0xa3, 0x7f, 0x4b, 0x22]));
    }
}
