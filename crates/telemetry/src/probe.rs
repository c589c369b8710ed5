//! How well a world model foretells what other actions would bring: real returns beside imagined ones.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// A state at which every plan was followed, really and in imagination.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProbedState {
    /// What kind of state it is, for example `contact`.
    pub kind: String,
    /// Real return of each plan: undiscounted sum of rewards.
    pub real: Vec<f64>,
    /// Imagined return of each plan.
    pub imagined: Vec<f64>,
}

/// What a probe of the world model found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Probe {
    /// Steps of a plan; fewer where an episode ended.
    pub horizon: u32,
    /// Names of the plans.
    pub plans: Vec<String>,
    /// The states, each with one value per plan.
    pub states: Vec<ProbedState>,
}

/// How well imagined returns agree with real ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProbeScores {
    /// States that were probed.
    pub states: usize,
    /// Those of them where all plans really return the same: they have no order and do not count in `rank_correlation`.
    pub states_without_order: usize,
    /// Spearman's rank correlation over the plans at one state, averaged over the states: 1 is perfect, 0 is guessing.
    /// None where no state has an order.
    pub rank_correlation: Option<f64>,
    /// Slope of the least-squares line of imagined over real returns, 1 where differences are foretold in their size;
    /// none where all real returns are equal.
    pub calibration_slope: Option<f64>,
    /// Pearson's correlation of imagined and real returns over all states and plans; none where one of them is constant.
    pub correlation: Option<f64>,
    /// Mean of imagined minus real return.
    pub bias: f64,
    /// Root of the mean squared difference.
    pub rmse: f64,
    /// Mean real return of each plan.
    pub real: Vec<f64>,
    /// Mean imagined return of each plan.
    pub imagined: Vec<f64>,
}

/// The scores of a probe, over all states and by their kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProbeReport {
    /// Steps of a plan.
    pub horizon: u32,
    /// Names of the plans.
    pub plans: Vec<String>,
    /// Over all states.
    pub all: ProbeScores,
    /// Over the states of each kind.
    pub kinds: BTreeMap<String, ProbeScores>,
}

impl Probe {
    /// The scores. They are no numbers where there is no state.
    pub fn report(&self) -> ProbeReport {
        let mut kinds = BTreeMap::<&str, Vec<&ProbedState>>::new();
        for state in &self.states {
            kinds.entry(&state.kind).or_default().push(state);
        }
        let all: Vec<&ProbedState> = self.states.iter().collect();
        ProbeReport {
            horizon: self.horizon,
            plans: self.plans.clone(),
            all: ProbeScores::of(&all),
            kinds: kinds
                .into_iter()
                .map(|(kind, states)| (kind.to_owned(), ProbeScores::of(&states)))
                .collect(),
        }
    }
}

impl ProbeReport {
    /// The curves of a run: `probe/rank_correlation` and `probe/bias`, and the first by kind where there are several.
    pub fn metrics(&self) -> Vec<(String, f64)> {
        let mut values = vec![("probe/bias".to_owned(), self.all.bias)];
        let mut add = |name: String, value: Option<f64>| {
            values.extend(value.map(|value| (name, value)));
        };
        add("probe/rank_correlation".into(), self.all.rank_correlation);
        if self.kinds.len() > 1 {
            for (kind, scores) in &self.kinds {
                add(
                    format!("probe/rank_correlation/{kind}"),
                    scores.rank_correlation,
                );
            }
        }
        values
    }
}

impl ProbeScores {
    fn of(states: &[&ProbedState]) -> Self {
        let by_state: Vec<f64> = states
            .iter()
            .filter_map(|state| rank_correlation(&state.real, &state.imagined))
            .collect();
        let real: Vec<f64> = states.iter().flat_map(|s| &s.real).copied().collect();
        let imagined: Vec<f64> = states.iter().flat_map(|s| &s.imagined).copied().collect();
        let errors: Vec<f64> = imagined.iter().zip(&real).map(|(i, r)| i - r).collect();
        let squares: Vec<f64> = errors.iter().map(|error| error * error).collect();
        let plans = states.first().map_or(0, |state| state.real.len());
        let by_plan = |values: fn(&ProbedState) -> &[f64]| {
            let of_plan = |plan: usize| -> Vec<f64> {
                let of_state = |state: &&ProbedState| values(state).get(plan).copied();
                states.iter().filter_map(of_state).collect()
            };
            (0..plans).map(|plan| mean(&of_plan(plan))).collect()
        };
        Self {
            states: states.len(),
            states_without_order: states.len() - by_state.len(),
            rank_correlation: (!by_state.is_empty()).then(|| mean(&by_state)),
            calibration_slope: slope(&real, &imagined),
            correlation: correlation(&real, &imagined),
            bias: mean(&errors),
            rmse: mean(&squares).sqrt(),
            real: by_plan(|state| &state.real),
            imagined: by_plan(|state| &state.imagined),
        }
    }
}

/// Spearman's rank correlation of `guess` with `truth`; equal values share the mean of their ranks. None where all of
/// `truth` is equal, 0 where all of `guess` is.
pub fn rank_correlation(truth: &[f64], guess: &[f64]) -> Option<f64> {
    let truth = ranks(truth);
    (spread(&truth) > 0.0).then(|| correlation(&truth, &ranks(guess)).unwrap_or(0.0))
}

/// Ranks from 1, equal values share the mean of theirs.
fn ranks(values: &[f64]) -> Vec<f64> {
    let rank = |value: &f64| {
        let below = values.iter().filter(|other| *other < value).count();
        let equal = values.iter().filter(|other| *other == value).count();
        below as f64 + (equal as f64 + 1.0) / 2.0
    };
    values.iter().map(rank).collect()
}

/// Pearson's correlation; none where one of the two is constant.
fn correlation(x: &[f64], y: &[f64]) -> Option<f64> {
    let size = (spread(x) * spread(y)).sqrt();
    (size > 0.0).then(|| covariance(x, y) / size)
}

/// Slope of the least-squares line of `y` over `x`; none where `x` is constant.
fn slope(x: &[f64], y: &[f64]) -> Option<f64> {
    let size = spread(x);
    (size > 0.0).then(|| covariance(x, y) / size)
}

/// Sum of squared deviations from the mean; exactly 0 where all values are equal.
fn spread(values: &[f64]) -> f64 {
    if values.iter().all(|value| *value == values[0]) {
        return 0.0;
    }
    covariance(values, values)
}

fn covariance(x: &[f64], y: &[f64]) -> f64 {
    let (mean_x, mean_y) = (mean(x), mean(y));
    let products = x.iter().zip(y).map(|(x, y)| (x - mean_x) * (y - mean_y));
    products.sum()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn close(found: f64, wanted: f64) {
        assert!((found - wanted).abs() < 1e-12, "{found} {wanted}");
    }

    fn state(kind: &str, real: &[f64], imagined: &[f64]) -> ProbedState {
        ProbedState {
            kind: kind.into(),
            real: real.into(),
            imagined: imagined.into(),
        }
    }

    #[test]
    fn equal_values_share_their_ranks() {
        assert_eq!(ranks(&[30.0, 10.0, 20.0, 10.0]), [4.0, 1.5, 3.0, 1.5]);
        assert_eq!(ranks(&[5.0; 3]), [2.0; 3]);
    }

    #[test]
    fn spearman_by_hand() {
        let of = |truth: &[f64], guess: &[f64]| rank_correlation(truth, guess).unwrap();
        close(of(&[1.0, 2.0, 3.0], &[10.0, 200.0, 3e4]), 1.0);
        close(of(&[1.0, 2.0, 3.0], &[3.0, 2.0, 1.0]), -1.0);
        // Rank differences 1, 1, 0, 0 of four: 1 - 6 * 2 / (4 * 15).
        close(of(&[1.0, 2.0, 3.0, 4.0], &[2.0, 1.0, 3.0, 4.0]), 0.8);
        // Ranks 1, 2.5, 2.5, 4 and 1, 3, 2, 4: covariance 4.5, spreads 4.5 and 5.
        close(
            of(&[1.0, 2.0, 2.0, 3.0], &[1.0, 3.0, 2.0, 4.0]),
            4.5 / 22.5_f64.sqrt(),
        );
        assert_eq!(rank_correlation(&[0.1; 3], &[1.0, 2.0, 3.0]), None);
        assert_eq!(rank_correlation(&[1.0, 2.0, 3.0], &[0.1; 3]), Some(0.0));
        assert_eq!(rank_correlation(&[], &[]), None);
    }

    #[test]
    fn a_model_that_halves_all_differences() {
        let probe = Probe {
            horizon: 15,
            plans: vec!["a".into(), "b".into(), "c".into()],
            states: vec![state("all", &[0.0, 2.0, 4.0], &[1.0, 2.0, 3.0])],
        };
        let scores = probe.report().all;
        close(scores.rank_correlation.unwrap(), 1.0);
        close(scores.calibration_slope.unwrap(), 0.5);
        close(scores.correlation.unwrap(), 1.0);
        close(scores.bias, 0.0);
        // Errors 1, 0, -1.
        close(scores.rmse, (2.0_f64 / 3.0).sqrt());
    }

    #[test]
    fn kinds_have_scores_of_their_own_and_states_without_an_order_are_counted() {
        let probe = Probe {
            horizon: 2,
            plans: vec!["a".into(), "b".into()],
            states: vec![
                state("free", &[1.0, 2.0], &[2.0, 4.0]),
                state("contact", &[1.0, 2.0], &[5.0, 4.0]),
                state("contact", &[3.0, 3.0], &[5.0, 4.0]),
            ],
        };
        let report = probe.report();
        close(report.all.rank_correlation.unwrap(), 0.0);
        // Errors 1, 2, 4, 2, 2, 1.
        close(report.all.bias, 2.0);
        close(report.all.rmse, 5.0_f64.sqrt());
        let contact = &report.kinds["contact"];
        assert_eq!((contact.states, contact.states_without_order), (2, 1));
        close(contact.rank_correlation.unwrap(), -1.0);
        assert_eq!(contact.real, [2.0, 2.5]);
        assert_eq!(contact.imagined, [5.0, 4.0]);
        let names: Vec<String> = report.metrics().into_iter().map(|(name, _)| name).collect();
        assert_eq!(
            names,
            [
                "probe/bias",
                "probe/rank_correlation",
                "probe/rank_correlation/contact",
                "probe/rank_correlation/free",
            ]
        );
    }

    #[test]
    fn what_has_no_order_has_no_curve() {
        let probe = Probe {
            horizon: 2,
            plans: vec!["a".into(), "b".into()],
            states: vec![state("all", &[1.0, 1.0], &[2.0, 4.0])],
        };
        let report = probe.report();
        assert_eq!(report.all.calibration_slope, None);
        assert_eq!(report.metrics(), [("probe/bias".to_owned(), 2.0)]);
    }
}
