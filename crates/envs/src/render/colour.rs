//! Colours as three channels in `[0, 1]`.

pub(super) type Rgb = [f32; 3];

pub(super) fn scale(colour: Rgb, factor: f32) -> Rgb {
    colour.map(|channel| channel * factor)
}

/// `a` at 0, `b` at 1.
pub(super) fn mix(a: Rgb, b: Rgb, part: f32) -> Rgb {
    std::array::from_fn(|i| a[i] + (b[i] - a[i]) * part)
}

pub(super) fn to_bytes(colour: Rgb) -> [u8; 3] {
    colour.map(|channel| (channel.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
}

/// A well-mixed hash in `[0, 1)` of a place and the purpose it is drawn for.
pub(super) fn noise(place: i64, purpose: u32) -> f32 {
    let mut x = (place as u64) ^ (u64::from(purpose) << 40);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x ^ (x >> 31)) >> 40) as f32 / (1_u64 << 24) as f32
}
