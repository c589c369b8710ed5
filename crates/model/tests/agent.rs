//! The agent as a whole: sizes of the paper, one policy for imagination and deployment, resuming, learning.

use std::sync::{Mutex, MutexGuard, PoisonError};

use isodream_core::config::{Config, InverseInput, Source};
use isodream_core::{EnvSpec, ImageShape};
use isodream_model::behavior::imagine;
use isodream_model::encoder::stack_frames;
use isodream_model::{ActingModel, Actions, Agent, Batch};
use tch::{Device, Kind, Tensor};

const ACTIONS: usize = 2;

/// libtorch has one generator per process: tests that share a process take turns.
static NOISE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    // Threads that wait for each other spin, and these products are too small to share.
    tch::set_num_threads(1);
    NOISE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn spec() -> EnvSpec {
    EnvSpec {
        id: "test".into(),
        image: ImageShape {
            height: 64,
            width: 64,
            channels: 3,
        },
        action_dim: ACTIONS,
        action_repeat: 1,
        time_limit: 50,
    }
}

fn small(set: &[&str]) -> Config {
    Config::load(&Source {
        preset: Some("debug".into()),
        file: None,
        set: set.iter().map(|s| (*s).to_owned()).collect(),
    })
    .expect("a valid configuration")
}

fn batch(config: &Config) -> Batch {
    tch::manual_seed(11);
    let (b, t) = (
        config.learner.batch_size as i64,
        config.learner.batch_length as i64,
    );
    let float = (Kind::Float, Device::Cpu);
    let actions = Tensor::rand([b, t, ACTIONS as i64], float) * 2.0 - 1.0;
    let side = config.env.image_size as i64;
    Batch {
        images: Tensor::rand([b, t, side, side, 3], float).permute([0, 1, 4, 2, 3]) - 0.5,
        rewards: -actions.select(2, 0).abs(),
        discounts: Tensor::ones([b, t], float),
        actions,
    }
}

fn read(metrics: &[(&'static str, Tensor)], name: &str) -> f64 {
    let (_, value) = metrics
        .iter()
        .find(|(n, _)| *n == name)
        .unwrap_or_else(|| panic!("no metric {name}"));
    value.double_value(&[])
}

#[test]
fn the_paper_preset_has_the_sizes_of_the_authors_code() {
    let _alone = alone();
    let mut config = Config::default();
    config.model.inverse = InverseInput::EmbedDiff;
    let agent = Agent::new(&config, &spec(), Device::Cpu);
    // algorithm: world model; actor; critic and attention.
    assert_eq!(
        agent.parameter_counts(),
        (25_783_449, 583_204, 421_601 + 501_750)
    );
}

#[test]
fn deployed_and_imagined_policy_act_alike() {
    let _alone = alone();
    for set in [
        &[][..],
        &["model.dependency_gate=false"],
        &["behavior.rollout_window=0"],
        &["model.indicator=false"],
        &["model.future=concatenation"],
        &["model.branches=dynamic"],
        &["model.branches=controllable", "model.indicator=false"],
        &["env.image_size=32", "model.policy_min_std=0.3"],
        &["model.encoder_frames=3"],
    ] {
        let config = small(set);
        let agent = Agent::new(&config, &spec(), Device::Cpu);
        let mut acting = ActingModel::new(&config, ACTIONS, Device::Cpu);
        acting.load(&agent.publish()).expect("own weights");
        let images = batch(&config).images.select(1, 0);
        let count = images.size()[0];

        let next_images = batch(&config).images.select(1, 1);
        let nothing = Tensor::zeros([count, ACTIONS as i64], (Kind::Float, Device::Cpu));
        let (first, later) = (vec![true; count as usize], vec![false; count as usize]);

        tch::manual_seed(5);
        let mut memory = acting.begin(count);
        let decision = acting.step(&mut memory, &images, &nothing, &first);
        let deployed = decision.actions(Actions::Sample);
        let modes = decision.actions(Actions::Mode);

        tch::manual_seed(5);
        let encoder = &agent.world().encoder;
        let pair = Tensor::stack(&[&images, &next_images], 1);
        let seen = stack_frames(&pair, config.model.encoder_frames);
        let embed = encoder.embed(&encoder.stem.forward(&seen.select(1, 0)), &nothing);
        let initial = agent.world().rssm.initial(count, Device::Cpu);
        let state = agent.world().rssm.observe_step(&initial, &nothing, &embed);
        let start = state.map(Tensor::shallow_clone);
        let imagined = imagine(agent.world(), &agent.policy(), start, &config.behavior);
        assert!(
            imagined.actions.get(0).equal(&deployed),
            "{set:?}: {} {deployed}",
            imagined.actions.get(0)
        );

        // The second step goes on from the first one's latents and action.
        tch::manual_seed(6);
        let second = acting.step(&mut memory, &next_images, &deployed, &later);
        if let Some(weights) = &second.attention {
            let window = config.behavior.rollout_window;
            assert_eq!(weights.size(), [count, window]);
            let sums = weights.sum_dim_intlist(-1, false, Kind::Float);
            assert!(sums.allclose(&Tensor::ones_like(&sums), 1e-5, 1e-6, false));
        }
        assert_eq!(
            second.attention.is_some(),
            isodream_model::policy::attends(&config)
        );
        let second = second.actions(Actions::Sample);
        tch::manual_seed(6);
        let embed = encoder.embed(&encoder.stem.forward(&seen.select(1, 1)), &deployed);
        let state = agent.world().rssm.observe_step(&state, &deployed, &embed);
        let policy = agent.policy();
        let wanted = policy.act(&policy.feat(&state, &policy.look_ahead(&state)));
        let wanted = wanted.sample();
        assert!(second.equal(&wanted), "{set:?}: {second} {wanted}");

        // A sequence that is observed at once leaves the same pictures in memory.
        let executed = Tensor::stack(&[&nothing, &deployed], 1);
        let observed = acting.observe(&pair, &executed).seen.select(1, 1);
        assert!(observed.equal(&memory.seen), "{set:?}");

        // A reset forgets both.
        tch::manual_seed(5);
        let again = acting.step(&mut memory, &images, &nothing, &first);
        let sample = again.actions(Actions::Sample);
        assert!(sample.equal(&deployed), "{set:?}: {sample} {deployed}");
        assert!(again.actions(Actions::Mode).equal(&modes) && !modes.equal(&deployed));
    }
}

#[test]
fn a_resumed_agent_makes_the_updates_of_an_unbroken_one() {
    let _alone = alone();
    let config = small(&["behavior.warmup_updates=1"]);
    let batch = batch(&config);
    let mut unbroken = Agent::new(&config, &spec(), Device::Cpu);
    for _ in 0..2 {
        unbroken.update(&batch);
    }
    let (model, optimizer) = (unbroken.save_model(), unbroken.save_optimizer());
    unbroken.update(&batch);

    let mut other = config.clone();
    other.seed += 1;
    let mut resumed = Agent::new(&config, &spec(), Device::Cpu);
    resumed.load(&model, &optimizer, 2).expect("own weights");
    resumed.update(&batch);
    assert!(resumed.save_model() == unbroken.save_model());
    assert!(resumed.save_optimizer() == unbroken.save_optimizer());

    let mut different = Agent::new(&other, &spec(), Device::Cpu);
    different.load(&model, &optimizer, 2).expect("own weights");
    different.update(&batch);
    assert!(different.save_model() != unbroken.save_model());
}

#[test]
fn every_option_trains_and_the_losses_fall() {
    let _alone = alone();
    for set in [
        &[][..],
        &[
            "model.inverse=embed_diff",
            "loss.variance=paper",
            "model.discount_head=true",
        ],
        &[
            "model.indicator=false",
            "model.dependency_gate=false",
            "model.encoder_actions=false",
        ],
        &[
            "behavior.value_gradient=false",
            "behavior.start_share=0.5",
            "behavior.rollout_window=0",
            "model.encoder_frames=2",
        ],
        &["model.future=concatenation", "model.branches=dynamic"],
        &["model.branches=controllable", "model.indicator=false"],
        &[
            "model.inverse=embed",
            "model.encoder_actions=false",
            "model.gate_bias=2",
            "loss.decoded_share=0.4",
            "behavior.normalize_returns=true",
            "behavior.mean_penalty=0.01",
            "behavior.mean_limit=0",
            "loss.open_loop_scale=10",
            "model.discount_head=true",
            "behavior.slow_critic_interval=1",
            "behavior.slow_critic_fraction=0.02",
            "learner.workers=2",
            "env.image_size=32",
        ],
    ] {
        let mut config = small(set);
        config.optimizer.model_lr = 2e-3;
        let batch = batch(&config);
        let mut agent = Agent::new(&config, &spec(), Device::Cpu);
        let first = agent.update(&batch);
        for _ in 0..15 {
            agent.update(&batch);
        }
        let last = agent.update(&batch);
        for name in ["train/loss/image", "train/loss/reward"] {
            assert!(
                read(&last, name) < read(&first, name),
                "{set:?}: {name} does not fall"
            );
        }
        assert!(
            last.iter()
                .all(|(_, value)| value.double_value(&[]).is_finite()),
            "{set:?}"
        );
    }
}

#[test]
fn behaviour_learning_waits_for_its_warmup() {
    let _alone = alone();
    let config = small(&["behavior.warmup_updates=2"]);
    let batch = batch(&config);
    let mut agent = Agent::new(&config, &spec(), Device::Cpu);
    let has_actor_loss: Vec<bool> = (0..3)
        .map(|_| {
            agent
                .update(&batch)
                .iter()
                .any(|(name, _)| *name == "train/loss/actor")
        })
        .collect();
    assert_eq!(has_actor_loss, [false, false, true]);
}

#[test]
fn learning_rates_fall_to_their_final_share() {
    let _alone = alone();
    // What the second update adds to the weights of the world model.
    let second_step = |decay: &str| -> Vec<f32> {
        let set = ["learner.env_frames=0", "learner.pretrain_updates=1", decay];
        let config = small(&set);
        assert_eq!(config.total_updates(), 1);
        let batch = batch(&config);
        let mut agent = Agent::new(&config, &spec(), Device::Cpu);
        agent.update(&batch);
        let before = agent.save_model();
        agent.update(&batch);
        let after = agent.save_model();
        let numbers = |bytes: &[u8]| -> Vec<f32> {
            let file = safetensors::SafeTensors::deserialize(bytes).expect("own bytes");
            let mut tensors = file.tensors();
            tensors.retain(|(name, _)| name.starts_with("world_model"));
            tensors.sort_by(|(a, _), (b, _)| a.cmp(b));
            let bytes = tensors.iter().flat_map(|(_, view)| view.data().to_vec());
            bytes
                .collect::<Vec<u8>>()
                .chunks_exact(4)
                .map(|four| f32::from_le_bytes(four.try_into().expect("four bytes")))
                .collect()
        };
        let pairs = numbers(&after).into_iter().zip(numbers(&before));
        pairs.map(|(after, before)| after - before).collect()
    };
    let (whole, decayed) = (
        second_step("optimizer.final_share=1"),
        second_step("optimizer.final_share=0.1"),
    );
    let size = |step: &[f32]| step.iter().map(|x| f64::from(x.abs())).sum::<f64>();
    let ratio = size(&decayed) / size(&whole);
    assert!((ratio - 0.1).abs() < 1e-3, "{ratio}");
}

#[test]
fn bf16_products_move_losses_and_gradient_norms_little() {
    let _alone = alone();
    let sizes = ["learner.batch_size=8", "learner.batch_length=16"];
    let update = |precision: &str| {
        let mut set = sizes.to_vec();
        set.push(precision);
        let config = small(&set);
        let batch = batch(&config);
        let metrics = Agent::new(&config, &spec(), Device::Cpu).update(&batch);
        for (_, value) in &metrics {
            assert_eq!(value.kind(), Kind::Float);
        }
        metrics
    };
    let (exact, rounded) = (
        update("learner.precision=fp32"),
        update("learner.precision=bf16"),
    );
    for (name, tolerance) in [
        ("train/loss/model", 1e-3),
        ("train/loss/reward", 1e-2),
        ("train/loss/controllable_kl", 1e-2),
        ("train/grad_norm/model", 2e-2),
        ("train/grad_norm/actor", 1e-1),
        ("train/grad_norm/critic", 5e-2),
    ] {
        let (a, b) = (read(&exact, name), read(&rounded, name));
        assert!((a - b).abs() <= tolerance * a.abs(), "{name}: {a} {b}");
    }
    assert!(
        read(&exact, "train/loss/model") != read(&rounded, "train/loss/model"),
        "nothing was multiplied in bf16"
    );
}

#[test]
fn a_transfer_takes_the_parts_it_is_told_and_nothing_else() {
    let _alone = alone();
    let agent = |seed: u64| {
        let mut config = small(&[]);
        config.seed = seed;
        Agent::new(&config, &spec(), Device::Cpu)
    };
    let (from, mut to) = (agent(1), agent(2));
    let differing = |a: &Agent, b: &Agent| -> Vec<String> {
        let (a, b) = (a.save_model(), b.save_model());
        let a = safetensors::SafeTensors::deserialize(&a).expect("own bytes");
        let b = safetensors::SafeTensors::deserialize(&b).expect("own bytes");
        let names = a.names().into_iter().filter(|name| {
            let of = |file: &safetensors::SafeTensors<'_>| {
                file.tensor(name).expect("the same").data().to_vec()
            };
            of(&a) != of(&b)
        });
        names.map(str::to_owned).collect()
    };
    let all = differing(&from, &to);
    let taken = to
        .transfer(&from.save_model(), &["noncontrollable".into()])
        .expect("the same model");
    let left = differing(&from, &to);
    let of_branch = |name: &&String| name.contains(".noncontrollable.");
    assert!(all.iter().filter(of_branch).count() > 10);
    assert_eq!(left.iter().filter(of_branch).count(), 0);
    assert_eq!(
        left.len(),
        all.iter().filter(|name| !of_branch(name)).count()
    );
    assert!(taken >= all.iter().filter(of_branch).count());

    assert_eq!(
        to.transfer(&from.save_model(), &["nobody".into()])
            .expect("nothing"),
        0
    );
    to.transfer(&from.save_model(), &[]).expect("everything");
    assert_eq!(differing(&from, &to), Vec::<String>::new());
}

#[test]
fn several_workers_repeat_themselves_and_learn_as_one() {
    let _alone = alone();
    let train = |workers: &str| {
        let config = small(&[
            workers,
            "learner.batch_size=3",
            "behavior.normalize_returns=true",
        ]);
        let batch = batch(&config);
        let mut agent = Agent::new(&config, &spec(), Device::Cpu);
        let losses: Vec<f64> = (0..4)
            .map(|_| read(&agent.update(&batch), "train/loss/image"))
            .collect();
        (agent.save_model(), losses)
    };
    let (model, losses) = train("learner.workers=2");
    let (again, _) = train("learner.workers=2");
    assert!(model == again, "threads are left to chance");
    // Sequences of 2 and 1: the same losses but for the noise of latents.
    let (_, alone) = train("learner.workers=1");
    for (several, one) in losses.iter().zip(&alone) {
        assert!((several / one - 1.0).abs() < 1e-3, "{losses:?} {alone:?}");
    }
    // More workers than sequences: some have nothing to do.
    let (_, many) = train("learner.workers=5");
    assert!(many[3] < many[0]);
}

#[test]
fn an_inverse_dynamics_of_embeddings_gains_nothing_without_pictures() {
    let _alone = alone();
    let errors = |set: &[&str]| {
        let config = small(set);
        let batch = batch(&config);
        let mut agent = Agent::new(&config, &spec(), Device::Cpu);
        for _ in 0..40 {
            agent.update(&batch);
        }
        agent.world().inverse_errors(&batch)
    };
    let fast = ["optimizer.model_lr=5e-3", "loss.action_scale=100"];
    let leaking = errors(&fast);
    let looking = errors(
        &[
            &fast[..],
            &["model.inverse=embed", "model.encoder_actions=false"],
        ]
        .concat(),
    );
    // Black pictures all look alike: what is inferred from them is a constant.
    assert!(looking.blind > 0.999, "{looking:?}");
    assert!(leaking.blind < 0.9, "{leaking:?}");
    assert!(looking.seeing.is_finite() && leaking.seeing.is_finite());
}
