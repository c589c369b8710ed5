//! Where the masks begin.

use isodream_core::config::{Config, Source};
use isodream_model::Params;
use isodream_model::decoder::Decoder;
use tch::{Device, Kind, Tensor};

fn mean_masks(bias: f64) -> [f64; 2] {
    let config = Config::load(&Source {
        preset: Some("debug".into()),
        file: None,
        set: vec![format!("model.mask_bias={bias:?}")],
    })
    .expect("a valid configuration");
    let mut params = Params::new(Device::Cpu);
    let decoder = Decoder::new(params.root("decoder"), &config.model, 64);
    let feat = Tensor::zeros(
        [1, 2, config.model.stoch + config.model.deter],
        (Kind::Float, Device::Cpu),
    );
    let background = Tensor::zeros([1, 3, 4, 32, 32], (Kind::Float, Device::Cpu));
    let composition = decoder.forward(&feat, &feat, &background);
    [composition.controllable, composition.noncontrollable]
        .map(|part| part.mask.mean(Kind::Float).double_value(&[]))
}

#[test]
fn the_mask_bias_says_where_the_masks_begin() {
    for mask in mean_masks(-1.5) {
        assert!(
            (mask - 0.18).abs() < 0.05,
            "sigmoid(-1.5) is 0.18, the mask begins at {mask}"
        );
    }
    for mask in mean_masks(0.0) {
        assert!(
            (mask - 0.5).abs() < 0.1,
            "sigmoid(0) is 0.5, the mask begins at {mask}"
        );
    }
}
