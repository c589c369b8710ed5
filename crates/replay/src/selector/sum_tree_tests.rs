use proptest::prelude::*;

use super::*;

#[derive(Debug, Clone)]
enum Change {
    Push(u32),
    Set(prop::sample::Index, u32),
    Clear(prop::sample::Index, prop::sample::Index),
    Forget(prop::sample::Index),
}

fn change() -> impl Strategy<Value = Change> {
    let weight = prop_oneof![Just(0), 1..10_u32, Just(u32::MAX)];
    prop_oneof![
        6 => weight.clone().prop_map(Change::Push),
        2 => (any::<prop::sample::Index>(), weight).prop_map(|(at, weight)| Change::Set(at, weight)),
        1 => any::<(prop::sample::Index, prop::sample::Index)>().prop_map(|(a, b)| Change::Clear(a, b)),
        1 => any::<prop::sample::Index>().prop_map(Change::Forget),
    ]
}

proptest! {
    #[test]
    fn sums_and_draws_are_those_of_a_plain_list(
        first in prop_oneof![0..40_u64, (1_u64 << 24) - 40..(1 << 24)],
        changes in prop::collection::vec(change(), 1..400),
    ) {
        let mut tree = SumTree::new(first);
        let mut plain: Vec<u32> = Vec::new();
        for change in changes {
            match change {
                Change::Push(weight) => {
                    tree.push(weight);
                    plain.push(weight);
                }
                Change::Set(at, weight) if !plain.is_empty() => {
                    let at = at.index(plain.len());
                    if tree.set(first + at as u64, weight) {
                        plain[at] = weight;
                    } else {
                        prop_assert_eq!(plain[at], 0, "only forgotten weights cannot be set");
                    }
                }
                Change::Clear(a, b) if !plain.is_empty() => {
                    let (a, b) = (a.index(plain.len()), b.index(plain.len()));
                    let held = a.min(b).max(tree.first.saturating_sub(first) as usize);
                    let end = (a.max(b) + 1).max(held);
                    plain[held..end].fill(0);
                    tree.clear(first + held as u64..first + end as u64);
                }
                Change::Forget(at) => {
                    let zeros = plain.iter().take_while(|weight| **weight == 0).count();
                    tree.forget_before(first + at.index(zeros + 1) as u64);
                }
                Change::Set(..) | Change::Clear(..) => {}
            }
        }
        let mut before = 0;
        for (at, &weight) in plain.iter().enumerate() {
            let number = first + at as u64;
            prop_assert_eq!(tree.get(number), weight);
            prop_assert_eq!(tree.sum_before(number), before);
            if weight > 0 {
                let last = u64::from(weight) - 1;
                prop_assert_eq!(tree.find(before), (number, 0));
                prop_assert_eq!(tree.find(before + last), (number, last as u32));
            }
            before += u64::from(weight);
        }
        prop_assert_eq!(tree.total(), before);
        prop_assert_eq!(tree.sum_before(u64::MAX), before);
    }
}
