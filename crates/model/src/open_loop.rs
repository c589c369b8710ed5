//! Open-loop prediction: a few frames of context, then latents from actions alone.

use tch::Tensor;

use crate::batch::Batch;
use crate::decoder::Composition;
use crate::rssm::{State, stack};
use crate::world_model::WorldModel;

/// A predicted sequence; the composition's pictures are `[B T, C, 64, 64]` in the order of the batch.
#[derive(Debug)]
pub struct OpenLoop {
    /// Reconstructions of the context, then predictions, with the parts of each branch.
    pub composition: Composition,
    /// Predicted rewards `[B, T]`.
    pub rewards: Tensor,
}

/// Infers latents from the first `context` frames, predicts the rest from the given actions, and decodes all.
///
/// The background is made from the sequence's first K frames, so that it may see frames beyond the context,
/// as in the authors' code.
pub fn open_loop(world: &WorldModel, batch: &Batch, context: i64) -> OpenLoop {
    let _guard = tch::no_grad_guard();
    let length = batch.images.size()[1];
    let encoded = world.encode(&batch.images, &batch.actions);
    let observed = &encoded.observed.states;
    let at = |t: i64| observed.map(|x| x.select(1, t));
    let mut states: Vec<State> = (0..context).map(at).collect();
    for t in context..length {
        let next = {
            let last = states
                .last()
                .expect("there is at least one frame of context");
            world.rssm.imagine_step(last, &batch.actions.select(1, t))
        };
        states.push(next);
    }
    let states = stack(&states, 1);
    let composition = world.decoder.forward(
        &states.controllable.feat(),
        &states.noncontrollable.feat(),
        &world.decoder.background(&encoded.stem),
    );
    OpenLoop {
        composition: composition.pictures(),
        rewards: world.reward(&states),
    }
}
