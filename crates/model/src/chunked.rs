//! A loss over a batch, part after part: the memory of one part instead of the whole.

use tch::{Kind, Tensor};

/// The sum of `loss` over parts of `rows` rows, differentiable like `loss` over all rows at once, of which it must be
/// the sum. Each part's graph is spent on its gradients at once; what stays are gradients of the size of `inputs` and
/// `parameters`.
///
/// `loss` receives the same rows of every input. Gradients go to the inputs that require them, and to `parameters`,
/// which is everything else that `loss` learns. Only first derivatives are right, and gradients must be on.
///
/// # Shapes
/// every input `[N, ..]` `-> []`
pub fn sum_of_parts(
    inputs: &[&Tensor],
    parameters: &[&Tensor],
    rows: i64,
    mut loss: impl FnMut(&[Tensor]) -> Tensor,
) -> Tensor {
    let total_rows = inputs[0].size()[0];
    let mut value = Tensor::zeros([], (Kind::Float, inputs[0].device()));
    let mut input_gradients: Vec<Vec<Tensor>> = inputs.iter().map(|_| Vec::new()).collect();
    let mut parameter_gradients: Vec<Tensor> = Vec::new();
    let learned: Vec<usize> = (0..inputs.len())
        .filter(|&index| inputs[index].requires_grad())
        .collect();
    let mut first = 0;
    while first < total_rows {
        let count = rows.min(total_rows - first);
        let part: Vec<Tensor> = inputs
            .iter()
            .map(|input| {
                let part = input.narrow(0, first, count).detach();
                part.set_requires_grad(input.requires_grad())
            })
            .collect();
        let part_loss = loss(&part);
        let wanted: Vec<&Tensor> = learned
            .iter()
            .map(|&index| &part[index])
            .chain(parameters.iter().copied())
            .collect();
        let mut gradients = Tensor::run_backward(&[&part_loss], &wanted, false, false).into_iter();
        for (&index, gradient) in learned.iter().zip(gradients.by_ref()) {
            input_gradients[index].push(gradient);
        }
        add_gradients(&mut parameter_gradients, gradients.collect());
        value += part_loss.detach();
        first += count;
    }
    // A linear function with these gradients, moved to the loss's value.
    let mut linear = Tensor::zeros_like(&value);
    for index in learned {
        linear += inputs[index].dot_with(&Tensor::cat(&input_gradients[index], 0));
    }
    for (parameter, gradient) in parameters.iter().zip(&parameter_gradients) {
        linear += parameter.dot_with(gradient);
    }
    let shift = (value - &linear).detach();
    linear + shift
}

/// Adds the gradients of a part to those of the parts before it, which are none at first. A gradient that is undefined
/// in one part must be so in all.
pub fn add_gradients(sums: &mut Vec<Tensor>, part: Vec<Tensor>) {
    let _guard = tch::no_grad_guard();
    if sums.is_empty() {
        *sums = part;
        return;
    }
    for (sum, gradient) in sums.iter_mut().zip(part).filter(|(sum, _)| sum.defined()) {
        // Not in place: autograd may hand out one tensor twice, or a view without memory of its own.
        *sum = &*sum + gradient;
    }
}

trait DotWith {
    /// The sum of products with a tensor of the same shape.
    fn dot_with(&self, other: &Tensor) -> Tensor;
}

impl DotWith for Tensor {
    fn dot_with(&self, other: &Tensor) -> Tensor {
        (self * other).sum(Kind::Float)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn parts_have_the_value_and_the_gradients_of_the_whole() {
        tch::manual_seed(7);
        let options = (Kind::Float, Device::Cpu);
        let x = Tensor::randn([7, 3], options).set_requires_grad(true);
        let constant = Tensor::randn([7, 2], options);
        let weight = Tensor::randn([3, 2], options).set_requires_grad(true);
        let loss = |part: &[Tensor]| {
            (part[0].matmul(&weight).tanh() - &part[1])
                .square()
                .sum(Kind::Float)
        };
        // Both go on to a further loss, and come from an earlier layer.
        let further = |loss: Tensor| loss.square() * 0.5;
        let earlier = &x * 2.0;
        let gradients = |loss: Tensor| Tensor::run_backward(&[loss], &[&x, &weight], true, false);

        let whole = loss(&[earlier.shallow_clone(), constant.shallow_clone()]);
        for rows in [1, 3, 7, 20] {
            let parts = sum_of_parts(&[&earlier, &constant], &[&weight], rows, loss);
            assert!(parts.allclose(&whole, 1e-5, 1e-6, false), "{parts} {whole}");
            let wanted = gradients(further(whole.shallow_clone()));
            for (a, b) in gradients(further(parts)).iter().zip(wanted) {
                assert!(a.allclose(&b, 1e-4, 1e-5, false), "{rows} rows: {a} {b}");
            }
        }
    }
}
