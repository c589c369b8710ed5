//! Image decoders of the three branches and their composition (Iso-Dream++ Eq. 5).

use isodream_core::config::{Branches, ModelConfig};
use tch::{Kind, Tensor};

use crate::encoder::{Tail, embed_dim};
use crate::nn::{ConvTranspose, Linear, elu, from_phases};
use crate::params::Scope;

/// A linear layer and transposed convolutions, four for a picture of 64x64 and three for one of 32x32: features to a
/// picture in four phases, the form in which the last layer is fastest; everything after it works pixel by pixel and
/// does not care. Numbers and memory layout of the result are the last layer's own.
#[derive(Debug)]
pub struct ImageDecoder {
    input: Linear,
    t0: ConvTranspose,
    /// Absent for pictures of 32x32.
    t1: Option<ConvTranspose>,
    t2: ConvTranspose,
    t3: ConvTranspose,
}

impl ImageDecoder {
    /// From `inputs` features to `channels` of `side` rows and columns, 32 or 64.
    pub fn new(
        mut scope: Scope<'_>,
        config: &ModelConfig,
        side: i64,
        inputs: i64,
        channels: i64,
    ) -> Self {
        let depth = config.cnn_depth;
        let width = 32 * depth;
        let wide = side != 32;
        let t2_inputs = if wide { 2 * depth } else { 4 * depth };
        Self {
            input: Linear::new(scope.sub("input"), inputs, width),
            t0: ConvTranspose::new(scope.sub("t0"), width, 4 * depth, 5),
            t1: wide.then(|| ConvTranspose::new(scope.sub("t1"), 4 * depth, 2 * depth, 5)),
            t2: ConvTranspose::new(scope.sub("t2"), t2_inputs, depth, 6),
            t3: ConvTranspose::new(scope.sub("t3"), depth, channels, 6),
        }
    }

    /// # Shapes
    /// `[N, inputs] -> [N, side / 2, side / 2, 4 channels]`
    pub fn forward(&self, feat: &Tensor) -> Tensor {
        self.upsample(&self.project(feat))
    }

    /// The layers with most of the parameters and little else.
    ///
    /// # Shapes
    /// `[N, inputs] -> [N, 4 depth, 5, 5]`
    fn project(&self, feat: &Tensor) -> Tensor {
        // Not in place: a permuted view, whose in-place form autograd copies.
        self.t0.forward_vector(&self.input.forward(feat)).elu()
    }

    fn upsampling_parameters(&self) -> impl Iterator<Item = &Tensor> {
        self.t1
            .iter()
            .chain([&self.t2, &self.t3])
            .flat_map(|layer| [&layer.weight, &layer.bias])
    }

    /// The layers with most of the feature maps and few parameters.
    ///
    /// # Shapes
    /// `[N, 4 depth, 5, 5] -> [N, side / 2, side / 2, 4 channels]`
    fn upsample(&self, projected: &Tensor) -> Tensor {
        let x = match &self.t1 {
            Some(t1) => elu(t1.forward(projected)),
            None => projected.shallow_clone(),
        };
        let x = elu(self.t2.forward(&x));
        self.t3.forward_phases(&x)
    }
}

/// One dynamic branch's picture.
#[derive(Debug)]
pub struct Component {
    /// In `[-0.5, 0.5]`: 3 channels.
    pub rgb: Tensor,
    /// `M^s` or `M^z`, in `(0, 1)`: 1 channel.
    pub mask: Tensor,
}

impl Component {
    /// Splits a decoder's four channels into picture and mask.
    ///
    /// # Shapes
    /// `[N, 4, ..]`
    pub fn from_channels(channels: &Tensor) -> Self {
        Self {
            rgb: channels.narrow(1, 0, 3).clamp(-0.5, 0.5),
            mask: channels.narrow(1, 3, 1).sigmoid(),
        }
    }

    fn map(&self, f: impl Fn(&Tensor) -> Tensor) -> Self {
        Self {
            rgb: f(&self.rgb),
            mask: f(&self.mask),
        }
    }
}

/// A decoder's output in `f32`, channel by channel.
///
/// # Shapes
/// `[N, H, W, 4 channels] -> [N, channels, 4, H, W]`
fn to_channels(phases: &Tensor) -> Tensor {
    let phases = phases
        .permute([0, 3, 1, 2])
        .to_kind(Kind::Float)
        .contiguous();
    phases.unflatten(1, [phases.size()[1] / 4, 4])
}

/// A reconstruction and what it is made of, in phases (`[B, T, C, 4, side / 2, side / 2]`) or as pictures.
#[derive(Debug)]
pub struct Composition {
    /// `o_hat`: 3 channels.
    pub image: Tensor,
    /// The controllable branch's part.
    pub controllable: Component,
    /// The noncontrollable branch's part.
    pub noncontrollable: Component,
    /// The static branch's picture: 3 channels, one for all of time (`[B, 1, ..]`).
    pub background: Tensor,
}

impl Composition {
    /// Phases put together: `[B T, C, side, side]`.
    pub fn pictures(&self) -> Self {
        let picture = |phases: &Tensor| from_phases(phases).flatten(0, 1);
        Self {
            image: picture(&self.image),
            controllable: self.controllable.map(picture),
            noncontrollable: self.noncontrollable.map(picture),
            background: picture(&self.background.expand_as(&self.image)),
        }
    }
}

/// `o_hat = M^s o^s + M^z o^z + (1 - M^s - M^z) o^b` (Eq. 5). The masks are independent sigmoids, so that
/// the weight of the background may be negative, as in the authors' code.
pub fn compose(
    controllable: Component,
    noncontrollable: Component,
    background: Tensor,
) -> Composition {
    let rest: Tensor = 1.0 - &controllable.mask - &noncontrollable.mask;
    let image = &controllable.mask * &controllable.rgb
        + &noncontrollable.mask * &noncontrollable.rgb
        + rest * &background;
    Composition {
        image,
        controllable,
        noncontrollable,
        background,
    }
}

/// The static branch: the first K frames of a sequence to one picture (`Dec_phi3(Enc_theta,phi3(o_1:K))`).
#[derive(Debug)]
pub struct Background {
    tail: Tail,
    decoder: ImageDecoder,
    frames: i64,
}

impl Background {
    /// The static branch of `config`.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig, side: i64) -> Self {
        Self {
            tail: Tail::new(scope.sub("encoder"), config, 0),
            decoder: ImageDecoder::new(
                scope.sub("decoder"),
                config,
                side,
                config.background_frames * embed_dim(config),
                3,
            ),
            frames: config.background_frames,
        }
    }

    /// # Shapes
    /// `stem: [B, T, 2 depth, ..]` with `T >= K` `-> [B, 3, 4, side / 2, side / 2]`
    pub fn forward(&self, stem: &Tensor) -> Tensor {
        let first = stem.narrow(1, 0, self.frames);
        let embed = self.tail.forward(&first.flatten(0, 1), None);
        let joined = embed.view([stem.size()[0], -1]);
        to_channels(&self.decoder.forward(&joined)).clamp(-0.5, 0.5)
    }
}

/// The decoders of all branches.
#[derive(Debug)]
pub struct Decoder {
    controllable: ImageDecoder,
    noncontrollable: ImageDecoder,
    background: Option<Background>,
    branches: Branches,
    side: i64,
}

impl Decoder {
    /// The decoders of `config` for pictures of `side` rows and columns.
    pub fn new(mut scope: Scope<'_>, config: &ModelConfig, side: i64) -> Self {
        let feat = config.stoch + config.deter;
        let decoder = Self {
            controllable: ImageDecoder::new(scope.sub("controllable"), config, side, feat, 4),
            noncontrollable: ImageDecoder::new(scope.sub("noncontrollable"), config, side, feat, 4),
            background: (config.branches == Branches::All)
                .then(|| Background::new(scope.sub("background"), config, side)),
            branches: config.branches,
            side,
        };
        if config.mask_bias != 0.0 {
            for branch in [&decoder.controllable, &decoder.noncontrollable] {
                let _ = tch::no_grad(|| branch.t3.bias.narrow(0, 3, 1).fill_(config.mask_bias));
            }
        }
        decoder
    }

    /// The static branch's picture, black where there is none.
    ///
    /// # Shapes
    /// `stem: [B, T, 2 depth, ..]` `-> [B, 3, 4, side / 2, side / 2]`
    pub fn background(&self, stem: &Tensor) -> Tensor {
        match &self.background {
            Some(background) => background.forward(stem),
            None => {
                let half = self.side / 2;
                Tensor::zeros(
                    [stem.size()[0], 3, 4, half, half],
                    (Kind::Float, stem.device()),
                )
            }
        }
    }

    /// Features of both dynamic branches as small pictures, for [`Self::upsample`].
    ///
    /// # Shapes
    /// `[N, stoch + deter]` twice `-> [N, 4 depth, 5, 5]` twice
    pub fn project(&self, controllable: &Tensor, noncontrollable: &Tensor) -> [Tensor; 2] {
        [
            self.controllable.project(controllable),
            self.noncontrollable.project(noncontrollable),
        ]
    }

    /// What [`Self::upsample`] learns.
    pub fn upsampling_parameters(&self) -> Vec<&Tensor> {
        [&self.controllable, &self.noncontrollable]
            .into_iter()
            .flat_map(ImageDecoder::upsampling_parameters)
            .collect()
    }

    /// The pictures of both dynamic branches.
    ///
    /// # Shapes
    /// `[N, 4 depth, 5, 5]` twice, to pictures in phases
    pub fn upsample(&self, controllable: &Tensor, noncontrollable: &Tensor) -> [Component; 2] {
        let [mut s, mut z] = [
            self.controllable.upsample(controllable),
            self.noncontrollable.upsample(noncontrollable),
        ]
        .map(|phases| Component::from_channels(&to_channels(&phases)));
        match self.branches {
            Branches::All => {}
            Branches::Dynamic => z.mask = 1.0 - &s.mask,
            Branches::Controllable => {
                s.mask = s.mask.ones_like();
                z.mask = z.mask.zeros_like();
            }
        }
        [s, z]
    }

    /// Pictures of both dynamic branches over one background per sequence.
    ///
    /// # Shapes
    /// features `[B, T, stoch + deter]`, `background: [B, 3, 4, side / 2, side / 2]`
    pub fn forward(
        &self,
        controllable: &Tensor,
        noncontrollable: &Tensor,
        background: &Tensor,
    ) -> Composition {
        let (batch, length) = (controllable.size()[0], controllable.size()[1]);
        let [s, z] = self.project(&controllable.flatten(0, 1), &noncontrollable.flatten(0, 1));
        let [s, z] = self
            .upsample(&s, &z)
            .map(|component| component.map(|x| x.unflatten(0, [batch, length])));
        compose(s, z, background.unsqueeze(1))
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::params::Params;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    fn composed(branches: Branches) -> (Composition, Tensor) {
        let config = ModelConfig {
            cnn_depth: 2,
            stoch: 3,
            deter: 5,
            background_frames: 2,
            branches,
            ..ModelConfig::default()
        };
        let mut params = Params::new(Device::Cpu);
        let decoder = Decoder::new(params.root("decoder"), &config, 64);
        let feat = || Tensor::randn([2, 4, 8], FLOAT);
        let stem = Tensor::randn([2, 4, 4, 14, 14], FLOAT);
        let background = decoder.background(&stem);
        let absent = background.abs().max().double_value(&[]) == 0.0;
        assert_eq!(absent, branches != Branches::All);
        let composition = decoder.forward(&feat(), &feat(), &background);
        let (s, z) = (&composition.controllable, &composition.noncontrollable);
        let dynamic = &s.mask * &s.rgb + &z.mask * &z.rgb;
        (composition, dynamic)
    }

    #[test]
    fn without_the_static_branch_the_dynamic_ones_share_every_pixel() {
        let (composition, dynamic) = composed(Branches::Dynamic);
        let masks = &composition.controllable.mask + &composition.noncontrollable.mask;
        assert!(masks.allclose(&masks.ones_like(), 1e-6, 1e-6, false));
        assert!(composition.image.allclose(&dynamic, 1e-5, 1e-6, false));
    }

    #[test]
    fn the_controllable_branch_alone_makes_the_whole_picture() {
        let (composition, _) = composed(Branches::Controllable);
        assert!(composition.image.equal(&composition.controllable.rgb));
    }

    #[test]
    fn with_all_branches_the_static_one_shows_where_masks_are_not_full() {
        let (composition, dynamic) = composed(Branches::All);
        let masks = &composition.controllable.mask + &composition.noncontrollable.mask;
        let rest = (1.0 - masks) * &composition.background;
        assert!(
            composition
                .image
                .allclose(&(dynamic + rest), 1e-5, 1e-6, false)
        );
    }
}
