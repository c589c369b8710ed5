//! NumPy's legacy `RandomState`, draw for draw, because a task's seed means what it means in dm_control.
//!
//! Mersenne Twister: Matsumoto and Nishimura 1998, with its `init_genrand` seeding. Gaussians: Marsaglia's polar
//! method, whose second value is kept for the next call.

const SIZE: usize = 624;
const SHIFT: usize = 397;
const UPPER_BIT: u32 = 0x8000_0000;
const TWIST: u32 = 0x9908_b0df;

/// A source of random numbers.
#[derive(Debug, Clone)]
pub(super) struct RandomState {
    words: [u32; SIZE],
    /// Words of the present block that are used up.
    used: usize,
    /// Left over from the last pair of gaussians.
    gauss: Option<f64>,
}

impl RandomState {
    /// The state of `numpy.random.RandomState(seed)`.
    pub(super) fn new(seed: u32) -> Self {
        let mut words = [seed; SIZE];
        for i in 1..SIZE {
            let previous = words[i - 1];
            words[i] = 1_812_433_253_u32
                .wrapping_mul(previous ^ (previous >> 30))
                .wrapping_add(i as u32);
        }
        Self {
            words,
            used: SIZE,
            gauss: None,
        }
    }

    /// Uniform in `[0, 1)` with 53 random bits.
    pub(super) fn random_sample(&mut self) -> f64 {
        let high = f64::from(self.next() >> 5);
        let low = f64::from(self.next() >> 6);
        (high * 67_108_864.0 + low) / 9_007_199_254_740_992.0
    }

    /// Uniform in `[low, high)`.
    pub(super) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.random_sample()
    }

    /// Standard normal.
    pub(super) fn randn(&mut self) -> f64 {
        if let Some(value) = self.gauss.take() {
            return value;
        }
        loop {
            let x = 2.0 * self.random_sample() - 1.0;
            let y = 2.0 * self.random_sample() - 1.0;
            let square = x * x + y * y;
            if square < 1.0 && square != 0.0 {
                let scale = (-2.0 * square.ln() / square).sqrt();
                self.gauss = Some(scale * x);
                return scale * y;
            }
        }
    }

    fn next(&mut self) -> u32 {
        if self.used == SIZE {
            self.refill();
        }
        let mut y = self.words[self.used];
        self.used += 1;
        y ^= y >> 11;
        y ^= (y << 7) & 0x9d2c_5680;
        y ^= (y << 15) & 0xefc6_0000;
        y ^ (y >> 18)
    }

    fn refill(&mut self) {
        for i in 0..SIZE {
            let y = (self.words[i] & UPPER_BIT) | (self.words[(i + 1) % SIZE] & !UPPER_BIT);
            let twist = if y & 1 == 1 { TWIST } else { 0 };
            self.words[i] = self.words[(i + SHIFT) % SIZE] ^ (y >> 1) ^ twist;
        }
        self.used = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_are_those_of_numpy() {
        // numpy.random.RandomState(7)
        let mut random = RandomState::new(7);
        let uniform: Vec<f64> = (0..3).map(|_| random.uniform(-1.5, 2.5)).collect();
        assert_eq!(
            uniform,
            [-1.1947668425041713, 1.6196751689604585, 0.253636925763574]
        );
        let normal: Vec<f64> = (0..3).map(|_| random.randn()).collect();
        assert_eq!(
            normal,
            [0.09316606097975175, 3.200914709117712, -0.1569886595634109]
        );
        assert_eq!(random.uniform(0.0, 1.0), 0.49988250082555996);
        assert_eq!(random.randn(), -0.2901313829291646);
    }

    #[test]
    fn the_greatest_seed_and_the_second_block_are_those_of_numpy() {
        // numpy.random.RandomState(2**32 - 1).random_sample(700)[[0, 699]]
        let mut random = RandomState::new(u32::MAX);
        let drawn: Vec<f64> = (0..700).map(|_| random.random_sample()).collect();
        assert_eq!(
            (drawn[0], drawn[699]),
            (0.0976320289940138, 0.008352749376617896)
        );
    }
}
