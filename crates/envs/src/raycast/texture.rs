//! Textures with mipmaps, filtered as OpenGL does it.

use super::maths::{floor, log2};
use super::vec3::Vec3;

/// An image that repeats in both directions.
#[derive(Debug)]
pub struct Texture {
    /// From the image itself down to a single texel.
    levels: Vec<Level>,
}

/// Six square images around a point.
#[derive(Debug)]
pub struct CubeTexture {
    /// Towards +x, -x, +y, -y, +z and -z.
    faces: [Texture; 6],
}

#[derive(Debug)]
struct Level {
    width: usize,
    height: usize,
    /// `[height, width]`, the fourth byte of each is not used.
    texels: Vec<[u8; 4]>,
}

/// What happens beyond an image's edge.
#[derive(Debug, Clone, Copy)]
enum Wrap {
    Repeat,
    Clamp,
}

impl Texture {
    /// The image `texels`, `[height, width]` red, green and blue.
    ///
    /// # Panics
    /// If there are not `width * height > 0` texels.
    pub fn new(width: usize, height: usize, texels: Vec<[u8; 3]>) -> Self {
        assert!(
            !texels.is_empty() && texels.len() == width * height,
            "a texture of {width} x {height} cannot have {} texels",
            texels.len()
        );
        let mut levels = vec![Level {
            width,
            height,
            texels: texels.into_iter().map(|[r, g, b]| [r, g, b, 0]).collect(),
        }];
        while let Some(next) = levels.last().and_then(Level::halved) {
            levels.push(next);
        }
        Self { levels }
    }

    /// One colour everywhere.
    pub fn plain(colour: [u8; 3]) -> Self {
        Self::new(1, 1, vec![colour])
    }

    /// The colour at `(u, v)`, 1 being the image's size, where a pixel's step to the right moves by `right` and
    /// one down by `down`. Colours are in `[0, 1]`.
    pub(crate) fn sample(&self, at: [f32; 2], right: [f32; 2], down: [f32; 2]) -> [f32; 3] {
        self.filter(at, right, down, Wrap::Repeat)
    }

    fn filter(&self, at: [f32; 2], right: [f32; 2], down: [f32; 2], wrap: Wrap) -> [f32; 3] {
        let base = &self.levels[0];
        let size = [base.width as f32, base.height as f32];
        let square = |step: [f32; 2]| {
            let (x, y) = (step[0] * size[0], step[1] * size[1]);
            x * x + y * y
        };
        let square = square(right).max(square(down));
        if square <= 1.0 {
            return base.bilinear(at, wrap);
        }
        // Half the logarithm of a square is that of its root.
        let lod = (0.5 * log2(square)).min((self.levels.len() - 1) as f32);
        let fine = lod as usize;
        let share = lod - fine as f32;
        let colour = self.levels[fine].bilinear(at, wrap);
        match self.levels.get(fine + 1) {
            Some(coarse) if share > 0.0 => {
                let other = coarse.bilinear(at, wrap);
                std::array::from_fn(|c| colour[c] + share * (other[c] - colour[c]))
            }
            _ => colour,
        }
    }
}

impl CubeTexture {
    /// The cube with these images towards +x, -x, +y, -y, +z and -z.
    pub fn new(faces: [Texture; 6]) -> Self {
        Self { faces }
    }

    /// One colour everywhere.
    pub fn plain(colour: [u8; 3]) -> Self {
        Self::new(std::array::from_fn(|_| Texture::plain(colour)))
    }

    /// The colour in direction `at`, where the pixels to the right and below look in `right` and `down`.
    pub(crate) fn sample(&self, at: Vec3, right: Vec3, down: Vec3) -> [f32; 3] {
        let face = face_of(at);
        let [centre, right, down] = [at, right, down].map(|direction| on_face(face, direction));
        let step = |to: [f32; 2]| [to[0] - centre[0], to[1] - centre[1]];
        self.faces[face].filter(centre, step(right), step(down), Wrap::Clamp)
    }
}

/// The image that direction `at` hits.
fn face_of(at: Vec3) -> usize {
    let size = at.abs();
    if size.x >= size.y && size.x >= size.z {
        usize::from(at.x < 0.0)
    } else if size.y >= size.z {
        2 + usize::from(at.y < 0.0)
    } else {
        4 + usize::from(at.z < 0.0)
    }
}

/// Where direction `at` hits the plane of an image, in `[0, 1]` on it.
fn on_face(face: usize, at: Vec3) -> [f32; 2] {
    let (s, t, major) = match face {
        0 => (-at.z, -at.y, at.x),
        1 => (at.z, -at.y, -at.x),
        2 => (at.x, at.z, at.y),
        3 => (at.x, -at.z, -at.y),
        4 => (at.x, -at.y, at.z),
        _ => (-at.x, -at.y, -at.z),
    };
    [0.5 * (s / major + 1.0), 0.5 * (t / major + 1.0)]
}

impl Level {
    /// The next mipmap level, half as large; none after a single texel.
    fn halved(&self) -> Option<Self> {
        if self.width * self.height == 1 {
            return None;
        }
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let u = (x as f32 + 0.5) / width as f32;
                let v = (y as f32 + 0.5) / height as f32;
                let colour = self.bilinear([u, v], Wrap::Clamp);
                let [r, g, b] = colour.map(|value| (value * 255.0 + 0.5) as u8);
                texels.push([r, g, b, 0]);
            }
        }
        Some(Self {
            width,
            height,
            texels,
        })
    }

    fn bilinear(&self, at: [f32; 2], wrap: Wrap) -> [f32; 3] {
        let (left, right, across) = neighbours(at[0], self.width, wrap);
        let (top, bottom, along) = neighbours(at[1], self.height, wrap);
        let texel = |x: usize, y: usize| self.texels[y * self.width + x].map(f32::from);
        let mix = |a: [f32; 4], b: [f32; 4], share: f32| -> [f32; 4] {
            std::array::from_fn(|c| a[c] + share * (b[c] - a[c]))
        };
        let upper = mix(texel(left, top), texel(right, top), across);
        let lower = mix(texel(left, bottom), texel(right, bottom), across);
        let [r, g, b, _] = mix(upper, lower, along).map(|value| value * (1.0 / 255.0));
        [r, g, b]
    }
}

/// The texels around coordinate `at` in a row of `size`, and the share of the second.
fn neighbours(at: f32, size: usize, wrap: Wrap) -> (usize, usize, f32) {
    let last = size - 1;
    match wrap {
        Wrap::Repeat => {
            let position = (at - floor(at)) * size as f32 - 0.5;
            let whole = floor(position);
            // From -1 to the size: rounding may give the very end.
            let first = whole as i32;
            let wrapped = |index: i32| match index {
                index if index < 0 => last,
                index if index as usize > last => 0,
                index => index as usize,
            };
            (wrapped(first), wrapped(first + 1), position - whole)
        }
        Wrap::Clamp => {
            let position = (at * size as f32 - 0.5).clamp(0.0, last as f32);
            let first = position as usize;
            (first, (first + 1).min(last), position - first as f32)
        }
    }
}
