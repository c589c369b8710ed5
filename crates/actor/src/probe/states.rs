//! Where a probe begins: states that the policy met, spread over its episodes and over what may lie ahead.

use isodream_core::Steps;
use isodream_envs::PrivilegedView;

use crate::rollout::Moment;

/// Steps that the policy has seen before a state is probed, so that its latents know more than one picture.
const SEEN: usize = 5;
/// Gap between bumpers below which a car ahead is touched, or will be at once.
const CONTACT_M: f64 = 0.5;
/// Gap below which a car ahead decides what can be done.
const NEAR_M: f64 = 12.0;

/// What is ahead in the own lane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    /// A car within [`CONTACT_M`].
    Contact,
    /// A car within [`NEAR_M`].
    Near,
    /// Nothing of that.
    Free,
    /// The world does not tell.
    All,
}

impl Kind {
    const ALL: [Self; 4] = [Self::Contact, Self::Near, Self::Free, Self::All];

    fn of(view: Option<&PrivilegedView>) -> Self {
        let Some(view) = view else { return Self::All };
        let ahead = view
            .vehicles
            .iter()
            .filter(|car| car.ahead_m > 0.0 && car.lanes >> view.lane & 1 == 1);
        let gaps = ahead.map(|car| car.ahead_m - (view.length_m + car.length_m) / 2.0);
        match gaps.fold(f64::INFINITY, f64::min) {
            gap if gap <= CONTACT_M => Self::Contact,
            gap if gap <= NEAR_M => Self::Near,
            _ => Self::Free,
        }
    }

    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Contact => "contact",
            Self::Near => "near",
            Self::Free => "free",
            Self::All => "all",
        }
    }
}

/// An episode that the policy drove.
#[derive(Debug)]
pub struct Episode {
    pub(super) seed: u64,
    pub(super) steps: Steps,
    kinds: Vec<Kind>,
}

impl Episode {
    /// An episode of `seed` that begins.
    pub fn new(seed: u64) -> Self {
        Self {
            seed,
            steps: Steps::default(),
            kinds: Vec::new(),
        }
    }

    /// Takes in the episode, moment after moment.
    pub fn take(&mut self, moment: &Moment<'_>) {
        if self.kinds.is_empty() {
            self.steps = Steps::new(moment.step.image.len(), moment.step.action.len());
        }
        self.steps.push(moment.step);
        self.kinds.push(Kind::of(moment.view));
    }
}

/// A row of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) episode: usize,
    pub(super) row: usize,
    pub(super) kind: Kind,
}

/// How many states are probed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum States {
    /// In all, as evenly from the kinds there are as can be.
    Total(usize),
    /// Of each kind.
    PerKind(usize),
}

/// Rows up to `latest` after which the policy drove on for `horizon` steps, evenly spread over those of their kind.
pub(super) fn choose(
    episodes: &[Episode],
    horizon: usize,
    latest: usize,
    states: States,
) -> Vec<Place> {
    let mut met = Kind::ALL.map(|_| Vec::new());
    for (index, episode) in episodes.iter().enumerate() {
        let end = episode.kinds.len().saturating_sub(horizon);
        for row in SEEN..end.min(latest.saturating_add(1)) {
            let kind = episode.kinds[row];
            met[kind as usize].push(Place {
                episode: index,
                row,
                kind,
            });
        }
    }
    // What a rare kind leaves of its share goes to the others.
    met.sort_by_key(Vec::len);
    let mut kinds_left = met.iter().filter(|places| !places.is_empty()).count();
    let mut left = match states {
        States::Total(count) => count,
        States::PerKind(count) => count * kinds_left,
    };
    let mut chosen = Vec::new();
    for places in met.iter().filter(|places| !places.is_empty()) {
        let share = match states {
            States::Total(_) => left.div_ceil(kinds_left),
            States::PerKind(count) => count,
        };
        let count = share.min(places.len());
        // The middle of each of `count` equal parts.
        chosen.extend((0..count).map(|part| places[(2 * part + 1) * places.len() / (2 * count)]));
        left = left.saturating_sub(count);
        kinds_left -= 1;
    }
    chosen.sort_by_key(|place| (place.episode, place.row));
    chosen
}

#[cfg(test)]
mod tests {
    use isodream_envs::NearbyVehicle;

    use super::*;

    fn view(cars: &[(f64, u8)]) -> PrivilegedView {
        PrivilegedView {
            speed_m_s: 8.0,
            d_m: 0.0,
            heading_error_rad: 0.0,
            curvature_per_m: 0.0,
            lane: 1,
            lanes: 4,
            lane_width_m: 3.5,
            length_m: 4.0,
            max_steer_rad: 0.5,
            wheelbase_m: 2.5,
            vehicles: cars
                .iter()
                .map(|&(ahead_m, lanes)| NearbyVehicle {
                    ahead_m,
                    d_m: 0.0,
                    speed_m_s: 8.0,
                    length_m: 5.0,
                    lanes,
                })
                .collect(),
        }
    }

    #[test]
    fn the_nearest_leader_in_the_own_lane_decides() {
        let kind = |cars: &[(f64, u8)]| Kind::of(Some(&view(cars)));
        // Bumpers are 4.5 m from the centres.
        assert_eq!(kind(&[(30.0, 0b10), (4.9, 0b110)]), Kind::Contact);
        assert_eq!(kind(&[(5.1, 0b10)]), Kind::Near);
        assert_eq!(kind(&[(16.4, 0b10), (4.9, 0b100)]), Kind::Near);
        assert_eq!(kind(&[(16.6, 0b10), (-4.0, 0b10)]), Kind::Free);
        assert_eq!(Kind::of(None), Kind::All);
    }

    fn episode(kinds: &[Kind]) -> Episode {
        Episode {
            seed: 0,
            steps: Steps::default(),
            kinds: kinds.to_vec(),
        }
    }

    #[test]
    fn a_rare_kind_leaves_its_share_to_the_others() {
        let mut kinds = vec![Kind::Free; 40];
        kinds[7] = Kind::Contact;
        let episodes = [episode(&kinds), episode(&[Kind::Near; 20])];
        let chosen = choose(&episodes, 10, usize::MAX, States::Total(7));
        let count = |kind| chosen.iter().filter(|place| place.kind == kind).count();
        assert_eq!(count(Kind::Contact), 1);
        assert_eq!((count(Kind::Near), count(Kind::Free)), (3, 3));
        for place in &chosen {
            let rows = episodes[place.episode].kinds.len();
            assert!((SEEN..rows - 10).contains(&place.row), "{place:?}");
        }
        let chosen = choose(&episodes, 10, usize::MAX, States::PerKind(2));
        assert_eq!(chosen.len(), 5, "{chosen:?}");
        assert!(choose(&episodes, 40, usize::MAX, States::Total(7)).is_empty());
    }

    #[test]
    fn states_are_spread_over_the_episode() {
        let rows = |latest| -> Vec<usize> {
            let episode = episode(&[Kind::All; 115]);
            let chosen = choose(&[episode], 10, latest, States::Total(4));
            chosen.iter().map(|place| place.row).collect()
        };
        assert_eq!(rows(usize::MAX), [17, 42, 67, 92]);
        assert_eq!(rows(8), [5, 6, 7, 8]);
    }
}
