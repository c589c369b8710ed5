//! Images of another size, the same bytes on every machine.

/// The two source indices and the weight of the second one for each of `to` samples along a side of `from`:
/// sample centres are aligned, corners are not, and the borders repeat.
pub(crate) fn bilinear_taps(from: usize, to: usize) -> Vec<(usize, usize, f32)> {
    let scale = from as f32 / to as f32;
    (0..to)
        .map(|index| {
            let at = ((index as f32 + 0.5) * scale - 0.5).max(0.0);
            let first = (at as usize).min(from - 1);
            (first, (first + 1).min(from - 1), at - first as f32)
        })
        .collect()
}

/// Bilinear resampling of an image that is known by its pixels, without antialiasing: four pixels make
/// one, whatever lies between them. The result `[height, width, 3]` is truncated.
pub(crate) fn bilinear(
    (from_height, from_width): (usize, usize),
    (height, width): (usize, usize),
    pixel: impl Fn(usize, usize) -> [u8; 3],
) -> Vec<u8> {
    let rows = bilinear_taps(from_height, height);
    let columns = bilinear_taps(from_width, width);
    let mut image = Vec::with_capacity(height * width * 3);
    for &(top, bottom, down) in &rows {
        for &(left, right, along) in &columns {
            let corners = [(top, left), (top, right), (bottom, left), (bottom, right)]
                .map(|(row, column)| pixel(row, column));
            image.extend((0..3).map(|channel| {
                let [a, b, c, d] = corners.map(|corner| f32::from(corner[channel]));
                let upper = a * (1.0 - along) + b * along;
                let lower = c * (1.0 - along) + d * along;
                (upper * (1.0 - down) + lower * down) as u8
            }));
        }
    }
    image
}

/// Which source samples each of `to` samples covers along a side of `from`, and how much of each: the
/// weights of one sample sum to 1.
pub(crate) fn area_spans(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    // In units of 1 / (from * to) of the side, so that borders are whole numbers.
    (0..to)
        .map(|index| {
            let (start, end) = (index * from, (index + 1) * from);
            (start / to..end.div_ceil(to))
                .map(|source| {
                    let covered = end.min((source + 1) * to) - start.max(source * to);
                    (source, covered as f32 / from as f32)
                })
                .collect()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bilinear_matches_numbers_by_hand() {
        // A row 0, 10, 20, 30 to two samples: centres at .5 and 2.5.
        let row = |_: usize, column: usize| [column as u8 * 10, 7, 255];
        let half = bilinear((1, 4), (1, 2), row);
        assert_eq!(half, [5, 7, 255, 25, 7, 255]);
        // To eight: centres at -.25 (clamped to 0), .25, .75, 1.25, ...; 2.5, 7.5, 12.5 are truncated.
        let double = bilinear((1, 4), (1, 8), row);
        let red: Vec<u8> = double.chunks(3).map(|pixel| pixel[0]).collect();
        assert_eq!(red, [0, 2, 7, 12, 17, 22, 27, 30]);
    }

    #[test]
    fn bilinear_mixes_four_pixels_and_skips_the_rest() {
        // Six to one: the centre is at 2.5, between pixels 2 and 3.
        let pixel = |row: usize, column: usize| {
            let inside = (2..4).contains(&row) && (2..4).contains(&column);
            [if inside {
                (row * 10 + column) as u8
            } else {
                200
            }; 3]
        };
        // (22 + 23 + 32 + 33) / 4 = 27.5.
        assert_eq!(bilinear((6, 6), (1, 1), pixel), [27; 3]);
    }

    #[test]
    fn the_same_size_is_the_same_image() {
        let pixel = |row: usize, column: usize| [row as u8, column as u8, 9];
        let image = bilinear((3, 5), (3, 5), pixel);
        assert_eq!(image[3 * (2 * 5 + 4)..], [2, 4, 9]);
    }

    #[test]
    fn area_spans_cover_every_source_sample_once() {
        assert_eq!(
            area_spans(3, 2),
            [
                vec![(0, 2.0 / 3.0), (1, 1.0 / 3.0)],
                vec![(1, 1.0 / 3.0), (2, 2.0 / 3.0)]
            ]
        );
        assert_eq!(area_spans(4, 2)[1], [(2, 0.5), (3, 0.5)]);
        assert_eq!(area_spans(1, 3), vec![vec![(0, 1.0)]; 3]);
    }
}
