//! Layers, with PyTorch's default initialisation as in the authors' code:
//! weight and bias from U(-1/sqrt(fan_in), 1/sqrt(fan_in)).
//!
//! Parameters are `f32`. Where a group of parameters multiplies in bf16 ([`Params::multiplied_in`]),
//! convolutions work on and return bf16, and linear layers over at least 128 rows multiply in bf16 and
//! return `f32`; the last layer of an MLP, the gate and the posterior's projections stay `f32`.
//!
//! [`Params::multiplied_in`]: crate::Params::multiplied_in

use tch::{Kind, Tensor};

use crate::params::Scope;

/// With fewer rows, converting a weight costs more than multiplying by it.
const MANY_ROWS: i64 = 128;

/// `y = x W^T + b`.
#[derive(Debug)]
pub struct Linear {
    /// `[out, in]`.
    pub weight: Tensor,
    /// `[out]`.
    pub bias: Tensor,
    products: Kind,
}

impl Linear {
    /// A layer from `inputs` to `outputs` features.
    pub fn new(mut scope: Scope<'_>, inputs: i64, outputs: i64) -> Self {
        let bound = 1.0 / (inputs as f64).sqrt();
        Self {
            weight: scope.uniform("weight", &[outputs, inputs], bound),
            bias: scope.uniform("bias", &[outputs], bound),
            products: scope.products(),
        }
    }

    /// # Shapes
    /// `[.., in] -> [.., out]`
    pub fn forward(&self, x: &Tensor) -> Tensor {
        self.forward_in(self.kind_for(x), x).to_kind(Kind::Float)
    }

    /// `y W`, the layer's weight from the other side.
    ///
    /// # Shapes
    /// `[.., out] -> [.., in]`
    pub fn transposed(&self, y: &Tensor) -> Tensor {
        let kind = self.kind_for(y);
        y.to_kind(kind)
            .matmul(&self.weight.to_kind(kind))
            .to_kind(Kind::Float)
    }

    /// In which numbers to multiply the rows of `x`.
    fn kind_for(&self, x: &Tensor) -> Kind {
        let rows = x.size()[..x.dim() - 1].iter().product::<i64>();
        if rows < MANY_ROWS {
            Kind::Float
        } else {
            self.products
        }
    }

    /// [`Self::forward`] in the numbers `kind`, which the result has too.
    pub fn forward_in(&self, kind: Kind, x: &Tensor) -> Tensor {
        x.to_kind(kind)
            .linear(&self.weight.to_kind(kind), Some(&self.bias.to_kind(kind)))
    }
}

/// Fully connected layers with ELU between them and none after the last.
#[derive(Debug)]
pub struct Mlp {
    layers: Vec<Linear>,
}

impl Mlp {
    /// `hidden_layers` of `units`, then a linear layer to `outputs`.
    pub fn new(
        mut scope: Scope<'_>,
        inputs: i64,
        hidden_layers: i64,
        units: i64,
        outputs: i64,
    ) -> Self {
        let mut layers = Vec::new();
        let mut width = inputs;
        for index in 0..hidden_layers {
            layers.push(Linear::new(
                scope.sub(format!("layer{index}")),
                width,
                units,
            ));
            width = units;
        }
        layers.push(Linear::new(scope.sub("out"), width, outputs));
        Self { layers }
    }

    /// # Shapes
    /// `[.., in] -> [.., out]`
    pub fn forward(&self, x: &Tensor) -> Tensor {
        let (last, hidden) = self
            .layers
            .split_last()
            .expect("an MLP has an output layer");
        let kind = last.kind_for(x);
        let x = hidden.iter().fold(
            x.shallow_clone(),
            |x, layer| elu(layer.forward_in(kind, &x)),
        );
        // Few columns, and values that bf16 would round to quarters.
        last.forward_in(Kind::Float, &x)
    }
}

/// ELU of a layer's output, in its place: the gradient needs the result alone, and the feature maps of a batch are
/// tens of megabytes that need not exist twice.
pub fn elu(mut x: Tensor) -> Tensor {
    let _ = x.elu_();
    x
}

/// A 4x4 convolution of stride 2 without padding.
#[derive(Debug)]
pub struct Conv {
    /// `[out, in, 4, 4]`.
    pub weight: Tensor,
    /// `[out]`.
    pub bias: Tensor,
    products: Kind,
}

impl Conv {
    const KERNEL: i64 = 4;

    /// A layer from `inputs` to `outputs` channels.
    pub fn new(mut scope: Scope<'_>, inputs: i64, outputs: i64) -> Self {
        let bound = 1.0 / ((inputs * Self::KERNEL * Self::KERNEL) as f64).sqrt();
        Self {
            weight: scope.uniform(
                "weight",
                &[outputs, inputs, Self::KERNEL, Self::KERNEL],
                bound,
            ),
            bias: scope.uniform("bias", &[outputs], bound),
            products: scope.products(),
        }
    }

    /// # Shapes
    /// `[N, in, H, W] -> [N, out, (H - 4) / 2 + 1, (W - 4) / 2 + 1]`
    pub fn forward(&self, x: &Tensor) -> Tensor {
        self.convolve(x, &self.weight)
    }

    fn convolve(&self, x: &Tensor, weight: &Tensor) -> Tensor {
        let kind = self.products;
        x.to_kind(kind).conv2d(
            &weight.to_kind(kind),
            Some(&self.bias.to_kind(kind)),
            [2, 2],
            [0, 0],
            [1, 1],
            1,
        )
    }

    /// The convolution of `x` with `planes` constant channels appended, without building them: without
    /// padding, a constant channel of value `a` adds `a` times the sum of its kernel everywhere.
    ///
    /// # Shapes
    /// `x: [N, in - A, H, W]`, `planes: [N, A]` `-> [N, out, H', W']`
    pub fn forward_with_planes(&self, x: &Tensor, planes: &Tensor) -> Tensor {
        let channels = x.size()[1];
        let extra = self.weight.size()[1] - channels;
        let mut y = self.convolve(x, &self.weight.narrow(1, 0, channels));
        let kernel_sums = self.weight.narrow(1, channels, extra).sum_dim_intlist(
            [2_i64, 3].as_slice(),
            false,
            None,
        );
        let from_planes = planes.linear::<&Tensor>(&kernel_sums, None);
        let _ = y.g_add_(
            &from_planes
                .unsqueeze(-1)
                .unsqueeze(-1)
                .to_kind(self.products),
        );
        y
    }
}

/// A transposed convolution of stride 2 without padding.
#[derive(Debug)]
pub struct ConvTranspose {
    /// `[in, out, k, k]`.
    pub weight: Tensor,
    /// `[out]`.
    pub bias: Tensor,
    kernel: i64,
    products: Kind,
}

impl ConvTranspose {
    /// A layer from `inputs` to `outputs` channels. As in PyTorch, fan-in is `outputs * kernel^2`.
    pub fn new(mut scope: Scope<'_>, inputs: i64, outputs: i64, kernel: i64) -> Self {
        let bound = 1.0 / ((outputs * kernel * kernel) as f64).sqrt();
        Self {
            weight: scope.uniform("weight", &[inputs, outputs, kernel, kernel], bound),
            bias: scope.uniform("bias", &[outputs], bound),
            kernel,
            products: scope.products(),
        }
    }

    /// # Shapes
    /// `[N, in, H, W] -> [N, out, 2 (H - 1) + k, 2 (W - 1) + k]`
    pub fn forward(&self, x: &Tensor) -> Tensor {
        let kind = self.products;
        let mut y = self.spread(x, &self.weight.to_kind(kind), 2);
        let _ = y.g_add_(&self.bias.to_kind(kind).view([1, -1, 1, 1]));
        y
    }

    /// The layer with stride 1: pixel `2 q + r` of the result is a sum over `k / 2` inputs with the kernel's taps of
    /// parity `r`, so that the four parities are four output channels. With few channels this is several times
    /// faster, because it fills the machine's vectors. The kernel must be even.
    ///
    /// # Shapes
    /// `[N, in, H, W] -> [N, H + k / 2 - 1, W + k / 2 - 1, 4 out]`: the result's [`to_phases`], channels last
    pub fn forward_phases(&self, x: &Tensor) -> Tensor {
        let (inputs, outputs) = (self.weight.size()[0], self.weight.size()[1]);
        let (taps, kind) = (self.kernel / 2, self.products);
        let weight = self
            .weight
            .to_kind(kind)
            .view([inputs, outputs, taps, 2, taps, 2])
            .permute([0, 1, 3, 5, 2, 4])
            .reshape([inputs, 4 * outputs, taps, taps]);
        let y = self.spread(x, &weight, 1).permute([0, 2, 3, 1]);
        let size = y.size();
        // A row of pixels at a time: adding vectors as short as these channels one by one takes ten times as long.
        let bias = self
            .bias
            .to_kind(kind)
            .repeat_interleave_self_int(4, 0, None);
        (y.reshape([-1, size[2] * size[3]]) + bias.repeat([size[2]])).view(size.as_slice())
    }

    /// The transposed convolution without its bias, which oneDNN adds, and whose gradient it sums, without vectors.
    fn spread(&self, x: &Tensor, weight: &Tensor, stride: i64) -> Tensor {
        let (stride, none) = ([stride; 2], [0, 0]);
        x.to_kind(self.products).conv_transpose2d::<&Tensor>(
            weight,
            None,
            stride,
            none,
            none,
            1,
            [1, 1],
        )
    }

    /// The layer on a 1x1 picture, which is a plain matrix product: several times faster than the same
    /// thing as a transposed convolution.
    ///
    /// # Shapes
    /// `[N, in] -> [N, out, k, k]`
    pub fn forward_vector(&self, x: &Tensor) -> Tensor {
        let (outputs, kind) = (self.weight.size()[1], self.products);
        let y = x
            .to_kind(kind)
            .matmul(&self.weight.to_kind(kind).flatten(1, -1))
            .view([-1, outputs, self.kernel, self.kernel])
            + self.bias.to_kind(kind).view([1, outputs, 1, 1]);
        channels_last(&y)
    }
}

/// Pictures as four interleaved ones: phase `2 r + c` holds the pixels of row parity `r` and column parity `c`.
///
/// # Shapes
/// `[.., C, 2 H, 2 W] -> [.., C, 4, H, W]`
pub fn to_phases(pictures: &Tensor) -> Tensor {
    let channels = pictures.size()[pictures.dim() - 3];
    pictures.pixel_unshuffle(2).unflatten(-3, [channels, 4])
}

/// The inverse of [`to_phases`].
///
/// # Shapes
/// `[.., C, 4, H, W] -> [.., C, 2 H, 2 W]`
pub fn from_phases(phases: &Tensor) -> Tensor {
    phases.flatten(-4, -3).pixel_shuffle(2)
}

/// `x` with its channels adjacent in memory, the layout in which convolutions run fastest on a CPU: the
/// transposed ones need 0.6 of the time.
///
/// # Shapes
/// `[N, C, H, W]`, unchanged
pub fn channels_last(x: &Tensor) -> Tensor {
    x.permute([0, 2, 3, 1]).contiguous().permute([0, 3, 1, 2])
}

/// A GRU whose joint pre-activations pass a LayerNorm, as in DreamerV2.
///
/// `p = LN(W [x, h] + b)` splits into reset, candidate and update; `r = sigmoid(reset)`,
/// `c = tanh(r * cand)`, `u = sigmoid(update - 1)`, `h' = u c + (1 - u) h`.
#[derive(Debug)]
pub struct GruCell {
    /// Joint layer `[3 deter, inputs + deter]`.
    pub joint: Linear,
    /// LayerNorm scale `[3 deter]`.
    pub gamma: Tensor,
    /// LayerNorm offset `[3 deter]`.
    pub beta: Tensor,
    deter: i64,
}

impl GruCell {
    /// A cell from `inputs` features to a state of `deter`.
    pub fn new(mut scope: Scope<'_>, inputs: i64, deter: i64) -> Self {
        Self {
            joint: Linear::new(scope.sub("joint"), inputs + deter, 3 * deter),
            gamma: scope.sub("norm").constant("weight", &[3 * deter], 1.0),
            beta: scope.sub("norm").constant("bias", &[3 * deter], 0.0),
            deter,
        }
    }

    /// # Shapes
    /// `x: [N, inputs]`, `h: [N, deter]` `-> [N, deter]`
    pub fn forward(&self, x: &Tensor, h: &Tensor) -> Tensor {
        let joint = self.joint.forward(&Tensor::cat(&[x, h], -1)).layer_norm(
            [3 * self.deter],
            Some(&self.gamma),
            Some(&self.beta),
            1e-5,
            false,
        );
        let part = |index: i64| joint.narrow(-1, index * self.deter, self.deter);
        let reset = part(0).sigmoid();
        let candidate = (reset * part(1)).tanh();
        let update = (part(2) - 1.0).sigmoid();
        h + update * (candidate - h)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::Params;

    /// Equal values, and equal gradients in a random direction.
    fn assert_alike(y: &Tensor, expected: &Tensor, learned: &[&Tensor]) {
        assert!(y.allclose(expected, 1e-4, 1e-5, false), "{y} {expected}");
        let direction = expected.randn_like();
        let gradients = |y: &Tensor| {
            Tensor::run_backward(&[(y * &direction).sum(Kind::Float)], learned, true, false)
        };
        for (index, (a, b)) in gradients(y).iter().zip(gradients(expected)).enumerate() {
            assert!(
                a.allclose(&b, 1e-4, 1e-4, false),
                "gradient {index}: {a} {b}"
            );
        }
    }

    #[test]
    fn planes_equal_appended_channels() {
        tch::manual_seed(3);
        let mut params = Params::new(Device::Cpu);
        let conv = Conv::new(params.root("conv"), 7, 5);
        let leaf =
            |size: &[i64]| Tensor::randn(size, (Kind::Float, Device::Cpu)).set_requires_grad(true);
        let (x, planes) = (leaf(&[3, 5, 14, 14]), leaf(&[3, 2]));
        let appended = Tensor::cat(
            &[&x, &planes.view([3, 2, 1, 1]).expand([3, 2, 14, 14], false)],
            1,
        );
        let expected = conv.forward(&appended);
        let y = conv.forward_with_planes(&x, &planes);
        assert_alike(&y, &expected, &[&x, &planes, &conv.weight, &conv.bias]);
    }

    #[test]
    fn phases_equal_the_transposed_convolution_and_its_gradients() {
        tch::manual_seed(5);
        let mut params = Params::new(Device::Cpu);
        let layer = ConvTranspose::new(params.root("t3"), 5, 3, 6);
        let options = (Kind::Float, Device::Cpu);
        let x = Tensor::randn([2, 5, 7, 9], options).set_requires_grad(true);
        let plain = layer.forward(&x);
        let phases = layer.forward_phases(&x).permute([0, 3, 1, 2]);
        let phases = from_phases(&phases.unflatten(1, [3, 4]));
        assert_eq!(plain.size(), [2, 3, 18, 22]);
        assert!(from_phases(&to_phases(&plain)).equal(&plain));
        assert_alike(&phases, &plain, &[&x, &layer.weight, &layer.bias]);
    }

    #[test]
    fn vector_form_equals_the_transposed_convolution() {
        tch::manual_seed(4);
        let mut params = Params::new(Device::Cpu);
        let layer = ConvTranspose::new(params.root("t0"), 6, 3, 5);
        let x = Tensor::randn([4, 6], (Kind::Float, Device::Cpu)).set_requires_grad(true);
        let picture = x.view([4, 6, 1, 1]);
        let expected = layer.forward(&picture);
        let learned = [&x, &layer.weight, &layer.bias];
        assert_alike(&layer.forward_vector(&x), &expected, &learned);
        // The bias that is added by hand is the library's.
        let (stride, none) = ([2, 2], [0, 0]);
        let biased = picture.conv_transpose2d(
            &layer.weight,
            Some(&layer.bias),
            stride,
            none,
            none,
            1,
            [1, 1],
        );
        assert_alike(&expected, &biased, &learned);
    }
}
