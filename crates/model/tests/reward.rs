//! Imagined returns of given actions, by the reward head that is published.

use std::sync::{Mutex, MutexGuard, PoisonError};

use isodream_core::config::{Config, Source};
use isodream_core::{EnvSpec, ImageShape};
use isodream_model::reward::{Plans, imagined_returns};
use isodream_model::rssm::{Latent, State};
use isodream_model::{ActingModel, Agent, RewardModel};
use tch::{Device, Kind, Tensor};

const ACTIONS: usize = 2;
const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

/// libtorch has one generator per process: tests that share a process take turns.
static NOISE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    NOISE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn agent(set: &[&str]) -> (Agent, Config) {
    let config = Config::load(&Source {
        preset: Some("debug".into()),
        file: None,
        set: set.iter().map(|s| (*s).to_owned()).collect(),
    })
    .expect("a valid configuration");
    let spec = EnvSpec {
        id: "test".into(),
        image: ImageShape {
            height: 64,
            width: 64,
            channels: 3,
        },
        action_dim: ACTIONS,
        action_repeat: 1,
        time_limit: 50,
    };
    (Agent::new(&config, &spec, Device::Cpu), config)
}

fn states(config: &Config, count: i64) -> State {
    let latent = || Latent {
        stoch: Tensor::randn([count, config.model.stoch], FLOAT),
        deter: Tensor::randn([count, config.model.deter], FLOAT),
    };
    State {
        controllable: latent(),
        noncontrollable: latent(),
    }
}

fn values(x: &Tensor) -> Vec<f32> {
    Vec::try_from(x.flatten(0, -1)).expect("floats")
}

#[test]
fn the_published_head_is_the_learners() {
    let _alone = alone();
    for set in [
        &[][..],
        &["model.indicator=false"],
        &["model.discount_head=true"],
    ] {
        let (agent, config) = agent(set);
        let states = states(&config, 7);
        let wanted = agent.world().reward(&states);
        for weights in [agent.publish(), agent.save_model()] {
            let model = RewardModel::new(&config, &weights).expect("own weights");
            assert!(model.head().forward(&states).equal(&wanted), "{set:?}");
        }
        let acting = ActingModel::new(&config, ACTIONS, Device::Cpu);
        let published = agent.publish();
        let published = safetensors::SafeTensors::deserialize(&published).expect("safetensors");
        let beyond: Vec<&str> = published
            .names()
            .into_iter()
            .filter(|name| !acting.names().any(|acting| acting == *name))
            .collect();
        assert!(!beyond.is_empty());
        let reward = |name: &&str| name.starts_with("world_model.reward.");
        assert!(beyond.iter().all(reward), "{beyond:?}");
    }
}

#[test]
fn imagined_returns_are_sums_over_imagined_steps() {
    let _alone = alone();
    const SAMPLES: i64 = 3;
    let (agent, config) = agent(&[]);
    let reward = RewardModel::new(&config, &agent.publish()).expect("own weights");
    let rssm = &agent.world().rssm;
    let plans = Plans {
        starts: states(&config, 2),
        actions: Tensor::rand([2, 4, ACTIONS as i64], FLOAT),
        // The second plan ended after two steps.
        counted: Tensor::from_slice(&[1.0_f32, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0]).view([2, 4]),
    };
    tch::manual_seed(3);
    let found = imagined_returns(rssm, reward.head(), &plans, SAMPLES);

    // By hand: rows 0 to 2 are futures of the first start, 3 to 5 of the second.
    let rows = Tensor::from_slice(&[0_i64, 0, 0, 1, 1, 1]);
    let mut state = plans.starts.map(|x| x.index_select(0, &rows));
    let mut sums = [0.0_f32; 6];
    tch::manual_seed(3);
    for step in 0..4 {
        let action = plans.actions.select(1, step).index_select(0, &rows);
        state = tch::no_grad(|| rssm.imagine_step(&state, &action));
        let rewards = values(&agent.world().reward(&state));
        for row in 0..6 {
            if row < 3 || step < 2 {
                sums[row] += rewards[row];
            }
        }
    }
    for (plan, found) in values(&found).into_iter().enumerate() {
        let wanted = sums[3 * plan..3 * plan + 3].iter().sum::<f32>() / 3.0;
        assert!((found - wanted).abs() < 1e-5, "{found} {wanted}");
    }
}

#[test]
fn many_plans_are_imagined_in_parts() {
    let _alone = alone();
    let (agent, config) = agent(&[]);
    let reward = RewardModel::new(&config, &agent.publish()).expect("own weights");
    let count = 150;
    let plans = Plans {
        starts: states(&config, count),
        actions: Tensor::rand([count, 2, ACTIONS as i64], FLOAT),
        counted: Tensor::ones([count, 2], FLOAT),
    };
    let returns = imagined_returns(&agent.world().rssm, reward.head(), &plans, 16);
    assert_eq!(returns.size(), [count]);
    let nothing = Plans {
        counted: Tensor::zeros([count, 2], FLOAT),
        ..plans
    };
    let returns = imagined_returns(&agent.world().rssm, reward.head(), &nothing, 16);
    assert_eq!(values(&returns), vec![0.0; count as usize]);
}
