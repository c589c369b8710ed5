//! What an embedded video shows: a field that flows through three colours, with particles over it or not.

use rand::{Rng, RngExt};

use super::wave::{sine, smooth};

/// Side of the texture's lattice, which repeats.
const LATTICE: usize = 8;

/// How strong a pattern is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Style {
    /// Share of the range of colours, in (0, 1].
    pub(crate) contrast: f32,
    /// Most cycles that anything makes per video.
    pub(crate) cycles: i32,
    /// Most ripples per picture.
    pub(crate) details: i32,
}

/// All that is drawn once per video. Positions are in pictures, time in videos: what moves a whole number
/// of cycles comes back to where it was.
#[derive(Debug)]
pub(crate) struct Pattern {
    palette: [[f32; 3]; 3],
    field: Field,
    particles: Vec<Particle>,
}

/// A number in `[0, 1]` per position and time.
#[derive(Debug)]
enum Field {
    /// One wide ramp that turns, or grows out of a point.
    Gradient {
        wave: Wave,
        centre: [f32; 2],
        radial: bool,
    },
    /// Plane waves on top of each other.
    Waves([Wave; 3]),
    /// Smooth noise that drifts over a copy of itself.
    Texture {
        lattice: Vec<f32>,
        drifts: [[i32; 2]; 2],
        scale: f32,
    },
}

#[derive(Debug)]
struct Wave {
    per_picture: [f32; 2],
    cycles: i32,
    phase: f32,
}

#[derive(Debug)]
struct Particle {
    start: [f32; 2],
    laps: [i32; 2],
    radius: f32,
    colour: [f32; 3],
}

impl Pattern {
    /// The pattern number `index`: the kinds take turns, all else is drawn from `rng`.
    pub(crate) fn new(index: usize, style: Style, rng: &mut impl Rng) -> Self {
        let palette = std::array::from_fn(|_| colour(style, rng));
        let mut particles = Vec::new();
        let field = match index % 4 {
            0 => gradient(style, rng),
            1 => Field::Waves(std::array::from_fn(|_| wave(style, rng))),
            2 => {
                let count = 4 * style.details + rng.random_range(4..8);
                particles = (0..count).map(|_| particle(style, rng)).collect();
                gradient(style, rng)
            }
            _ => Field::Texture {
                lattice: (0..LATTICE * LATTICE).map(|_| rng.random()).collect(),
                drifts: std::array::from_fn(|_| [cycles(style, rng), cycles(style, rng)]),
                scale: rng.random_range(0.4..0.9),
            },
        };
        Self {
            palette,
            field,
            particles,
        }
    }

    /// Paints `[height, width, 3]` at `phase` in `[0, 1)`.
    pub(crate) fn paint(&self, phase: f32, height: usize, width: usize, into: &mut [u8]) {
        let (pixels, _) = into.as_chunks_mut::<3>();
        for (row, line) in pixels.chunks_exact_mut(width).enumerate() {
            let y = (row as f32 + 0.5) / height as f32;
            for (column, pixel) in line.iter_mut().enumerate() {
                let x = (column as f32 + 0.5) / width as f32;
                *pixel = self.shade(self.field.at([x, y], phase));
            }
        }
        for particle in &self.particles {
            particle.paint(phase, height, width, pixels);
        }
    }

    fn shade(&self, value: f32) -> [u8; 3] {
        let along = value.clamp(0.0, 1.0) * 2.0;
        let [from, to] = if along < 1.0 {
            [self.palette[0], self.palette[1]]
        } else {
            [self.palette[1], self.palette[2]]
        };
        blend(from, to, if along < 1.0 { along } else { along - 1.0 })
    }
}

impl Field {
    fn at(&self, [x, y]: [f32; 2], phase: f32) -> f32 {
        match self {
            Self::Gradient {
                wave,
                centre,
                radial,
            } => {
                let from_centre = [x - centre[0], y - centre[1]];
                let [dx, dy] = from_centre;
                let place = if *radial {
                    [(dx * dx + dy * dy).sqrt(), 0.0]
                } else {
                    from_centre
                };
                0.5 + 0.5 * wave.at(place, phase)
            }
            Self::Waves(waves) => {
                let sum: f32 = waves.iter().map(|wave| wave.at([x, y], phase)).sum();
                0.5 + sum / 4.0
            }
            Self::Texture {
                lattice,
                drifts,
                scale,
            } => {
                let mut sum = 0.0;
                for (drift, share) in drifts.iter().zip([1.0, 2.0]) {
                    let along = |place: f32, drift: i32| {
                        (place * scale * share + drift as f32 * phase) * LATTICE as f32
                    };
                    sum += noise(lattice, along(x, drift[0]), along(y, drift[1])) / (1.0 + share);
                }
                // Means of uniform values gather around the middle: spread them out.
                smooth((sum / (1.0 / 2.0 + 1.0 / 3.0) - 0.2) / 0.6)
            }
        }
    }
}

impl Wave {
    fn at(&self, [x, y]: [f32; 2], phase: f32) -> f32 {
        let turns = x * self.per_picture[0] + y * self.per_picture[1];
        sine(turns + self.cycles as f32 * phase + self.phase)
    }
}

impl Particle {
    /// A soft disc, on a picture whose opposite borders meet.
    fn paint(&self, phase: f32, height: usize, width: usize, pixels: &mut [[u8; 3]]) {
        let centre = |axis: usize, side: usize| {
            let at = self.start[axis] + self.laps[axis] as f32 * phase;
            (at - at.floor()) * side as f32
        };
        let (x, y) = (centre(0, width), centre(1, height));
        let radius = self.radius * height.min(width) as f32;
        let reach = radius.ceil() as isize + 1;
        for down in -reach..=reach {
            for along in -reach..=reach {
                let (row, column) = (y as isize + down, x as isize + along);
                let (dy, dx) = (row as f32 + 0.5 - y, column as f32 + 0.5 - x);
                let cover = smooth((radius - (dx * dx + dy * dy).sqrt()) / (0.5 * radius) + 0.5);
                if cover > 0.0 {
                    let row = row.rem_euclid(height as isize) as usize;
                    let column = column.rem_euclid(width as isize) as usize;
                    let pixel = &mut pixels[row * width + column];
                    *pixel = blend(pixel.map(f32::from), self.colour, cover);
                }
            }
        }
    }
}

fn blend(from: [f32; 3], to: [f32; 3], share: f32) -> [u8; 3] {
    std::array::from_fn(|channel| {
        (from[channel] + (to[channel] - from[channel]) * share + 0.5) as u8
    })
}

/// Values of the lattice, smoothly interpolated; the lattice repeats.
fn noise(lattice: &[f32], x: f32, y: f32) -> f32 {
    let (left, top) = (x.floor(), y.floor());
    let at = |dx: i32, dy: i32| {
        let wrap = |index: i32| index.rem_euclid(LATTICE as i32) as usize;
        lattice[wrap(top as i32 + dy) * LATTICE + wrap(left as i32 + dx)]
    };
    let (along, down) = (smooth(x - left), smooth(y - top));
    let upper = at(0, 0) + (at(1, 0) - at(0, 0)) * along;
    let lower = at(0, 1) + (at(1, 1) - at(0, 1)) * along;
    upper + (lower - upper) * down
}

fn gradient(style: Style, rng: &mut impl Rng) -> Field {
    let mut wave = wave(style, rng);
    // Wide: at most one and a half ramps per picture.
    wave.per_picture = [rng.random_range(0.4..1.5), rng.random_range(-1.0..1.0)];
    Field::Gradient {
        wave,
        centre: [rng.random(), rng.random()],
        radial: rng.random(),
    }
}

fn wave(style: Style, rng: &mut impl Rng) -> Wave {
    let most = style.details as f32;
    Wave {
        per_picture: [rng.random_range(-most..most), rng.random_range(-most..most)],
        cycles: cycles(style, rng),
        phase: rng.random(),
    }
}

fn particle(style: Style, rng: &mut impl Rng) -> Particle {
    Particle {
        start: [rng.random(), rng.random()],
        laps: [cycles(style, rng), cycles(style, rng)],
        radius: rng.random_range(0.03..0.11),
        colour: colour(style, rng),
    }
}

/// A whole number of cycles, of either sign, never zero.
fn cycles(style: Style, rng: &mut impl Rng) -> i32 {
    let count = rng.random_range(1..=style.cycles);
    if rng.random() { count } else { -count }
}

fn colour(style: Style, rng: &mut impl Rng) -> [f32; 3] {
    std::array::from_fn(|_| {
        let level: f32 = rng.random_range(-1.0..1.0);
        127.5 + 127.0 * style.contrast * level
    })
}
