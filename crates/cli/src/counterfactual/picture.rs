//! Imagined over real returns as a picture.

use isodream_telemetry::Rgb;
use isodream_telemetry::probe::{Probe, ProbeReport};

/// Before it is enlarged.
const SIDE: usize = 200;
const LEFT: usize = 40;
const TOP: usize = 14;
const BOTTOM: usize = 26;
const GAP: usize = 10;
const ENLARGED: usize = 2;
/// Ticks of an axis, its ends included.
const TICKS: usize = 5;

const PAPER: [u8; 3] = [255, 255, 255];
const INK: [u8; 3] = [60, 66, 72];
const GRID: [u8; 3] = [228, 230, 232];
/// Plans, in their order.
const COLORS: [[u8; 3]; 6] = [
    [47, 111, 181],
    [200, 85, 61],
    [60, 141, 90],
    [138, 90, 168],
    [176, 138, 30],
    [42, 140, 147],
];

/// One square for each kind of state: a point for each state and plan, on the diagonal where the model is right.
pub(super) fn scatter(probe: &Probe, report: &ProbeReport) -> Rgb {
    let all = || {
        let states = probe.states.iter();
        states.flat_map(|state| state.real.iter().chain(&state.imagined).copied())
    };
    let least = all().fold(f64::INFINITY, f64::min);
    let most = all().fold(f64::NEG_INFINITY, f64::max);
    let margin = 0.05 * (most - least).max(1e-3);
    let scale = Scale {
        low: least - margin,
        high: most + margin,
    };
    let mut squares = Vec::new();
    for (kind, scores) in &report.kinds {
        let rank = scores
            .rank_correlation
            .map_or("-".to_owned(), |value| format!("{value:.2}"));
        let mut square = axes(&scale, &format!("{kind}: rank correlation {rank}"));
        for state in probe.states.iter().filter(|state| state.kind == *kind) {
            for (plan, (real, imagined)) in state.real.iter().zip(&state.imagined).enumerate() {
                let (x, y) = (
                    LEFT + scale.place(*real),
                    TOP + SIDE - scale.place(*imagined),
                );
                let point = Rgb::filled(3, 3, COLORS[plan % COLORS.len()]);
                square.paste(&point, x - 1, y - 1);
            }
        }
        squares.push(square);
    }
    let width = squares.iter().map(|square| square.width + GAP).sum();
    let mut picture = Rgb::filled(width, TOP + SIDE + BOTTOM + legend_height(report), PAPER);
    for (index, square) in squares.iter().enumerate() {
        picture.paste(square, index * (square.width + GAP), 0);
    }
    for (plan, name) in report.plans.iter().enumerate() {
        let y = TOP + SIDE + BOTTOM + 10 * plan;
        picture.paste(&Rgb::filled(5, 5, COLORS[plan % COLORS.len()]), LEFT, y + 1);
        picture.text(name, LEFT + 10, y, INK);
    }
    picture.upscale(ENLARGED)
}

fn legend_height(report: &ProbeReport) -> usize {
    10 * report.plans.len() + 4
}

/// Both axes' range.
struct Scale {
    low: f64,
    high: f64,
}

impl Scale {
    fn place(&self, value: f64) -> usize {
        (SIDE as f64 * (value - self.low) / (self.high - self.low)).round() as usize
    }
}

/// Grid, diagonal and words.
fn axes(scale: &Scale, title: &str) -> Rgb {
    let mut square = Rgb::filled(LEFT + SIDE + 2, TOP + SIDE + BOTTOM, PAPER);
    for tick in 0..TICKS {
        let place = SIDE * tick / (TICKS - 1);
        let value = scale.low + (scale.high - scale.low) * tick as f64 / (TICKS - 1) as f64;
        let words = format!("{value:.1}");
        square.paste(&Rgb::filled(SIDE, 1, GRID), LEFT, TOP + SIDE - place);
        square.paste(&Rgb::filled(1, SIDE, GRID), LEFT + place, TOP);
        square.text(&words, 6, (TOP + SIDE - place).saturating_sub(3), INK);
        if tick + 1 < TICKS {
            square.text(&words, LEFT + place, TOP + SIDE + 4, INK);
        }
    }
    for place in 0..SIDE {
        square.paste(&Rgb::filled(1, 1, INK), LEFT + place, TOP + SIDE - place);
    }
    square.text(title, LEFT, 2, INK);
    square.text("imagined over real return", LEFT, TOP + SIDE + 15, INK);
    square
}
