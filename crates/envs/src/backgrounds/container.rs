//! The part of an MP4 file that says where its H.264 video is.
//!
//! Own code, since files come from users: every length is checked before it is followed, so that a damaged
//! file gives an error.

use std::ops::Range;

const TOO_SHORT: &str = "it ends too early or is damaged";
const START_CODE: [u8; 4] = [0, 0, 0, 1];

/// Where the H.264 video of a file is.
#[derive(Debug)]
pub(crate) struct Track {
    /// Parameter sets, as NAL units with start codes.
    pub(crate) parameters: Vec<u8>,
    /// Where the samples are in the file, in decoding order; all of them lie within it.
    pub(crate) samples: Vec<Range<usize>>,
    /// Bytes of the length before every NAL unit of a sample.
    length_bytes: usize,
}

impl Track {
    /// Appends a sample's NAL units with start codes in place of lengths.
    pub(crate) fn append(&self, sample: &[u8], packet: &mut Vec<u8>) -> Result<(), String> {
        let mut rest = Reader(sample);
        while !rest.0.is_empty() {
            let length = rest.number(self.length_bytes)?;
            packet.extend(START_CODE);
            packet.extend(rest.take(length)?);
        }
        Ok(())
    }
}

/// Finds the video of the file `bytes`.
///
/// # Errors
/// A reason, if it is not a whole MP4 file with H.264 video in one piece.
pub(crate) fn read(bytes: &[u8]) -> Result<Track, String> {
    let movie = child(bytes, b"moov").map_err(|reason| format!("it is no whole MP4: {reason}"))?;
    let mut rest = Reader(movie);
    let mut other = None;
    while let Some((kind, content)) = rest.next_box()? {
        if kind != *b"trak" {
            continue;
        }
        let media = child(content, b"mdia")?;
        if child(media, b"hdlr")?.get(8..12) != Some(b"vide") {
            continue;
        }
        let table = child(child(media, b"minf")?, b"stbl")?;
        // Version, flags and number of entries come before the first entry.
        let mut description = Reader(child(table, b"stsd")?);
        description.take(8)?;
        match description.next_box()? {
            Some((kind, entry)) if kind == *b"avc1" => return track(entry, table, bytes.len()),
            _ => other = Some("its video is not H.264"),
        }
    }
    Err(other.unwrap_or("it holds no video track").to_owned())
}

fn track(entry: &[u8], table: &[u8], file_bytes: usize) -> Result<Track, String> {
    // A visual sample entry has 78 bytes of its own before its boxes.
    let config = child(entry.get(78..).ok_or(TOO_SHORT)?, b"avcC")?;
    let mut config = Reader(config);
    config.take(4)?;
    let length_bytes = (config.number(1)? & 3) + 1;
    let mut parameters = Vec::new();
    // Sequence parameter sets, whose number has three reserved bits, then picture parameter sets.
    for mask in [0x1f, 0xff] {
        for _ in 0..config.number(1)? & mask {
            let length = config.number(2)?;
            parameters.extend(START_CODE);
            parameters.extend(config.take(length)?);
        }
    }
    let samples = samples(table)?;
    if samples.is_empty() {
        return Err("it has no frames, or is fragmented".to_owned());
    }
    let cut = samples
        .iter()
        .filter(|sample| sample.end > file_bytes)
        .count();
    if cut > 0 {
        return Err(format!("{cut} of its {} frames are cut off", samples.len()));
    }
    Ok(Track {
        parameters,
        samples,
        length_bytes,
    })
}

/// From sizes, chunks per run and chunk offsets.
fn samples(table: &[u8]) -> Result<Vec<Range<usize>>, String> {
    let mut sizes = Reader(child(table, b"stsz")?);
    sizes.take(4)?;
    let (common, count) = (sizes.number(4)?, sizes.number(4)?);
    if common != 0 {
        return Err("all its frames are of one size, as in no compressed video".to_owned());
    }
    let mut sizes = Reader(sizes.take(count.checked_mul(4).ok_or(TOO_SHORT)?)?);
    let (mut offsets, offset_bytes) = match child(table, b"stco") {
        Ok(offsets) => (Reader(offsets), 4),
        Err(_) => (Reader(child(table, b"co64")?), 8),
    };
    offsets.take(4)?;
    let chunks = offsets.number(4)?;
    let mut runs = Reader(child(table, b"stsc")?);
    runs.take(8)?;

    let mut samples = Vec::with_capacity(count);
    // Every run says at which chunk it begins and how many samples its chunks have.
    let mut per_chunk = 0;
    let mut next_run = runs.number(4)?;
    for chunk in 1..=chunks {
        while chunk == next_run {
            per_chunk = runs.number(4)?;
            runs.take(4)?;
            next_run = if runs.0.is_empty() {
                0
            } else {
                runs.number(4)?
            };
        }
        let mut at = offsets.number(offset_bytes)?;
        for _ in 0..per_chunk {
            if samples.len() == count {
                break;
            }
            let end = at.checked_add(sizes.number(4)?).ok_or(TOO_SHORT)?;
            samples.push(at..end);
            at = end;
        }
    }
    if samples.len() < count {
        return Err(TOO_SHORT.to_owned());
    }
    Ok(samples)
}

/// The content of the first box `kind` in `content`.
fn child<'a>(content: &'a [u8], kind: &[u8; 4]) -> Result<&'a [u8], String> {
    let mut rest = Reader(content);
    while let Some((found, content)) = rest.next_box()? {
        if found == *kind {
            return Ok(content);
        }
    }
    let name = String::from_utf8_lossy(kind);
    Err(format!("its part `{name}` is missing"))
}

/// Kind and content.
type Part<'a> = ([u8; 4], &'a [u8]);

/// What is left to read.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, bytes: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.0.split_at_checked(bytes).ok_or(TOO_SHORT)?;
        self.0 = rest;
        Ok(taken)
    }

    /// A big-endian number of at most 8 bytes.
    fn number(&mut self, bytes: usize) -> Result<usize, String> {
        let digits = self.take(bytes)?.iter();
        Ok(digits.fold(0, |number, byte| number << 8 | usize::from(*byte)))
    }

    /// The next box and its content, or nothing at the end.
    fn next_box(&mut self) -> Result<Option<Part<'a>>, String> {
        if self.0.is_empty() {
            return Ok(None);
        }
        let short = self.number(4)?;
        let kind = self.take(4)?;
        let content = match short {
            // To the end of the file.
            0 => self.0.len(),
            1 => self.number(8)?.checked_sub(16).ok_or(TOO_SHORT)?,
            _ => short.checked_sub(8).ok_or(TOO_SHORT)?,
        };
        let kind = kind.try_into().map_err(|_| TOO_SHORT)?;
        Ok(Some((kind, self.take(content)?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn boxed(kind: &[u8; 4], content: &[u8]) -> Vec<u8> {
        let size = (content.len() as u32 + 8).to_be_bytes();
        [&size, kind.as_slice(), content].concat()
    }

    fn numbers(numbers: &[u32]) -> Vec<u8> {
        numbers
            .iter()
            .flat_map(|number| number.to_be_bytes())
            .collect()
    }

    fn table(sizes: &[u32], runs: &[u32], offsets: &[u32]) -> Vec<u8> {
        let sizes = [&[0, 0, sizes.len() as u32], sizes].concat();
        let runs = [&[0, runs.len() as u32 / 3], runs].concat();
        let offsets = [&[0, offsets.len() as u32], offsets].concat();
        [
            boxed(b"stsz", &numbers(&sizes)),
            boxed(b"stsc", &numbers(&runs)),
            boxed(b"stco", &numbers(&offsets)),
        ]
        .concat()
    }

    #[test]
    fn samples_follow_chunks_and_runs() {
        // Chunks 1 and 2 hold two samples each, chunk 3 holds one.
        let table = table(&[5, 6, 7, 8, 9], &[1, 2, 1, 3, 1, 1], &[100, 200, 300]);
        let expected = [100..105, 105..111, 200..207, 207..215, 300..309];
        assert_eq!(samples(&table).unwrap(), expected);
    }

    #[test]
    fn tables_that_do_not_fit_together_are_refused() {
        let fewer_chunks = table(&[5, 6, 7], &[1, 2, 1], &[100]);
        assert!(samples(&fewer_chunks).is_err());
        let no_runs = table(&[5], &[], &[100]);
        assert!(samples(&no_runs).is_err());
        let mut lying = table(&[5], &[1, 1, 1], &[100]);
        lying[16..20].copy_from_slice(&u32::MAX.to_be_bytes());
        assert!(samples(&lying).is_err());
    }

    #[test]
    fn sizes_of_boxes_are_checked() {
        let inner = boxed(b"free", b"abc");
        assert_eq!(child(&inner, b"free").unwrap(), b"abc");
        let mut wide = vec![0, 0, 0, 1];
        wide.extend(*b"free");
        wide.extend(19_u64.to_be_bytes());
        wide.extend(*b"abc");
        assert_eq!(child(&wide, b"free").unwrap(), b"abc");
        for size in [2_u32, 7, 12, u32::MAX] {
            let mut lying = inner.clone();
            lying[..4].copy_from_slice(&size.to_be_bytes());
            assert!(child(&lying, b"free").is_err(), "{size}");
        }
        wide[8..16].copy_from_slice(&u64::MAX.to_be_bytes());
        assert!(child(&wide, b"free").is_err());
        assert!(
            child(&inner, b"moov")
                .unwrap_err()
                .contains("`moov` is missing")
        );
    }
}
