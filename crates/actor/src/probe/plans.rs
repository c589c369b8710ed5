//! What is tried at a state: plans of actions.

use isodream_envs::{Driver, EnvError, Environment, RandomDriver};

/// Pedals that are held: full brake to full throttle.
const PEDALS: [f32; 5] = [-0.5, 0.0, 0.25, 0.5, 1.0];
/// Steps for which the car rolls before it drives on.
const ROLL: usize = 5;
/// Constant actions that are drawn where nothing is known of the world.
const DRAWN: usize = 3;

/// What is done from a state on.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Plan {
    /// What the policy does, times this.
    Policy(f32),
    /// One action all the time.
    Hold(Vec<f32>),
    /// The policy steers; the pedal is the first value for [`ROLL`] steps, then the second.
    Pedal(f32, f32),
}

impl Plan {
    /// The action of step `step`, where the policy would do `policy`.
    pub(super) fn action(&self, step: usize, policy: &[f32]) -> Vec<f32> {
        match self {
            Self::Policy(factor) => policy.iter().map(|value| value * factor).collect(),
            Self::Hold(action) => action.clone(),
            Self::Pedal(first, then) => {
                vec![policy[0], if step < ROLL { *first } else { *then }]
            }
        }
    }

    /// Whether the policy has a say.
    pub(super) fn asks_policy(&self) -> bool {
        !matches!(self, Self::Hold(_))
    }
}

/// The plans for `env` with their names: pedals where it is driving, `[steer, pedal]`, and else what any actions allow.
/// Equal seeds draw equal actions.
pub(super) fn plans(env: &dyn Environment, seed: u64) -> Result<Vec<(String, Plan)>, EnvError> {
    let dim = env.spec().action_dim;
    if env.privileged().is_some() && dim == 2 {
        let held = PEDALS.map(|pedal| (format!("pedal {pedal}"), Plan::Pedal(pedal, pedal)));
        let rolled = ("pedal 0, then 0.5".to_owned(), Plan::Pedal(0.0, 0.5));
        return Ok(held.into_iter().chain([rolled]).collect());
    }
    let mut plans = vec![
        ("policy".to_owned(), Plan::Policy(1.0)),
        ("negated".to_owned(), Plan::Policy(-1.0)),
        ("zero".to_owned(), Plan::Hold(vec![0.0; dim])),
    ];
    let mut driver = RandomDriver::new(seed);
    for number in 1..=DRAWN {
        plans.push((format!("constant {number}"), Plan::Hold(driver.act(env)?)));
    }
    Ok(plans)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plans_change_what_they_say_and_nothing_else() {
        let policy = [0.5, 0.75];
        assert_eq!(Plan::Policy(-1.0).action(3, &policy), [-0.5, -0.75]);
        assert_eq!(Plan::Hold(vec![0.1]).action(3, &policy), [0.1]);
        let rolled = Plan::Pedal(0.0, 0.5);
        assert_eq!(rolled.action(ROLL - 1, &policy), [0.5, 0.0]);
        assert_eq!(rolled.action(ROLL, &policy), [0.5, 0.5]);
    }
}
