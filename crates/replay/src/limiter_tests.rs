use proptest::prelude::*;

use super::*;

fn limiter(min_steps: u64, samples_per_insert: f64, tolerance_steps: f64) -> RateLimiter {
    let options = LimiterOptions {
        min_steps,
        samples_per_insert,
        tolerance_steps,
    };
    RateLimiter::new(options, 0)
}

#[test]
fn reasons_name_the_numbers() {
    let mut limiter = limiter(100, 2.0, 50.0);
    limiter.insert(40);
    assert_eq!(
        limiter.why_sample_waits(Draw::Limited, true).as_deref(),
        Some("too little experience: 40 of 100 steps inserted")
    );
    limiter.insert(100);
    assert!(
        limiter
            .why_sample_waits(Draw::Limited, false)
            .is_some_and(|why| why.contains("long enough"))
    );
    assert_eq!(
        limiter.why_insert_waits(true).as_deref(),
        Some(
            "the learner is behind: 140 steps inserted, 0 sampled, 80 more due at 2 per insert beyond the first 100 (tolerance 50)"
        )
    );
    limiter.sample(Draw::Limited, 200);
    assert_eq!(limiter.why_insert_waits(true), None);
    assert_eq!(
        limiter.why_sample_waits(Draw::Limited, true).as_deref(),
        Some(
            "the actors are behind: 200 steps sampled, 140 inserted, 120 sampled too many at 2 per insert beyond the first 100 (tolerance 50)"
        )
    );
    assert_eq!(limiter.why_sample_waits(Draw::Unlimited, true), None);
}

#[test]
fn unlimited_draws_do_not_count_but_wait_for_the_minimum() {
    let mut limiter = limiter(10, 1.0, 5.0);
    assert!(limiter.why_sample_waits(Draw::Unlimited, true).is_some());
    limiter.insert(10);
    assert_eq!(limiter.why_sample_waits(Draw::Unlimited, true), None);
    limiter.sample(Draw::Unlimited, 1000);
    assert_eq!(limiter.sampled_steps(), 0);
}

#[test]
fn no_ratio_means_no_limit() {
    let mut limiter = limiter(10, 0.0, 0.0);
    limiter.insert(1_000_000);
    assert_eq!(limiter.why_insert_waits(true), None);
    limiter.sample(Draw::Limited, 9_000_000);
    assert_eq!(limiter.why_sample_waits(Draw::Limited, true), None);
}

#[test]
fn inserts_go_on_while_no_sequence_can_be_drawn() {
    let mut limiter = limiter(10, 8.0, 0.0);
    limiter.insert(1000);
    assert!(limiter.why_insert_waits(true).is_some());
    assert_eq!(limiter.why_insert_waits(false), None);
}

#[test]
fn the_learners_count_replaces_ours() {
    let mut limiter = limiter(0, 1.0, 10.0);
    limiter.insert(100);
    assert!(limiter.why_insert_waits(true).is_some());
    limiter.set_sampled(95);
    assert_eq!(limiter.why_insert_waits(true), None);
}

proptest! {
    #[test]
    fn the_ratio_holds_in_any_interleaving_and_somebody_can_always_go_on(
        min_steps in 0..200_u64,
        samples_per_insert in 0.1..16.0_f64,
        chunk in 1..40_u64,
        batch in 1..400_u64,
        slack in 1.0..3.0_f64,
        turns in prop::collection::vec(any::<bool>(), 1..400),
    ) {
        let inserted_at_once = chunk as f64 * samples_per_insert;
        let tolerance = inserted_at_once.max(batch as f64) * slack;
        let mut limiter = limiter(min_steps, samples_per_insert, tolerance);
        for insert_first in turns {
            let insert_waits = limiter.why_insert_waits(true).is_some();
            let sample_waits = limiter.why_sample_waits(Draw::Limited, true).is_some();
            prop_assert!(!(insert_waits && sample_waits), "both wait");
            if (insert_first && !insert_waits) || sample_waits {
                limiter.insert(chunk);
            } else {
                limiter.sample(Draw::Limited, batch);
            }
            if limiter.inserted_steps() < min_steps {
                prop_assert_eq!(limiter.sampled_steps(), 0);
            } else {
                // One operation beyond the tolerance; the insert that crosses the minimum may overshoot it.
                prop_assert!(limiter.surplus() <= tolerance + inserted_at_once, "surplus {}", limiter.surplus());
                prop_assert!(limiter.surplus() >= -tolerance - batch as f64, "surplus {}", limiter.surplus());
            }
        }
    }
}
