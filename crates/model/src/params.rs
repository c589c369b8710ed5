//! Named parameters, kept in one flat vector per group.
//!
//! A group (world model, actor, critic) is one contiguous vector; every parameter is a view into it. The
//! moments are as long and in the same order, a copy of a group is one operation, and a checkpoint is the list of
//! views with their names.

use std::collections::HashMap;

use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use tch::{Device, Kind, Tensor};

/// Parameters that cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// Not a safetensors file.
    #[error("not a safetensors file: {0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// The file lacks a tensor.
    #[error("tensor `{0}` is missing; the weights belong to another [model] configuration")]
    Missing(String),
    /// A tensor of another shape or type.
    #[error(
        "tensor `{name}` is {found}, expected {expected}; the weights belong to another [model] configuration"
    )]
    Shape {
        /// Its name.
        name: String,
        /// Type and shape in the file.
        found: String,
        /// Type and shape of the model.
        expected: String,
    },
}

/// A group of named parameters.
#[derive(Debug)]
pub struct Params {
    entries: Vec<(String, Tensor)>,
    flat: Tensor,
    device: Device,
    products: Kind,
}

impl Params {
    /// An empty group on `device`; networks add to it through [`Self::root`], then [`Self::flatten`] closes it.
    pub fn new(device: Device) -> Self {
        Self::multiplied_in(Kind::Float, device)
    }

    /// [`Self::new`] for networks that multiply in `products`. The parameters are `f32` all the same.
    pub fn multiplied_in(products: Kind, device: Device) -> Self {
        Self {
            entries: Vec::new(),
            flat: Tensor::zeros([0], (Kind::Float, device)),
            device,
            products,
        }
    }

    /// The scope under which all names of this group begin with `name`.
    pub fn root<'a>(&'a mut self, name: &str) -> Scope<'a> {
        Scope {
            prefix: name.to_owned(),
            params: self,
        }
    }

    /// Moves all parameters into one vector. Networks built before keep seeing them.
    pub fn flatten(&mut self) {
        let _guard = tch::no_grad_guard();
        let parts: Vec<Tensor> = self
            .entries
            .iter()
            .map(|(_, t)| t.detach().flatten(0, -1))
            .collect();
        self.adopt(Tensor::cat(&parts, 0));
    }

    /// Makes all parameters views of `flat`, which has their values in order of creation.
    pub fn adopt(&mut self, flat: Tensor) {
        let _guard = tch::no_grad_guard();
        self.flat = flat;
        let mut offset = 0;
        for (_, tensor) in &mut self.entries {
            let size = tensor.size();
            let count = tensor.numel() as i64;
            let view = self.flat.narrow(0, offset, count).view(size.as_slice());
            tensor.set_data(&view);
            offset += count;
        }
    }

    /// The vector that all parameters are views of, `[numel]`.
    pub fn flat(&self) -> &Tensor {
        &self.flat
    }

    /// The device that holds the parameters.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Names and tensors in order of creation.
    pub fn entries(&self) -> &[(String, Tensor)] {
        &self.entries
    }

    /// The tensors in order of creation.
    pub fn tensors(&self) -> Vec<&Tensor> {
        self.entries.iter().map(|(_, tensor)| tensor).collect()
    }

    /// Number of scalars.
    pub fn numel(&self) -> usize {
        self.entries.iter().map(|(_, tensor)| tensor.numel()).sum()
    }

    /// Sets every parameter named in this group from a parsed file; tensors of other groups are ignored.
    ///
    /// # Errors
    /// [`LoadError`] names the tensor that is missing or of another shape; nothing is changed then.
    pub fn load(&mut self, file: &SafeTensors<'_>) -> Result<(), LoadError> {
        self.load_where(file, |_| true).map(drop)
    }

    /// [`Self::load`] for the parameters whose names are `wanted`. Returns how many there are.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_where(
        &mut self,
        file: &SafeTensors<'_>,
        wanted: impl Fn(&str) -> bool,
    ) -> Result<usize, LoadError> {
        let mut loaded = Vec::new();
        for (name, tensor) in self.entries.iter_mut().filter(|(name, _)| wanted(name)) {
            let view = file
                .tensor(name)
                .map_err(|_| LoadError::Missing(name.clone()))?;
            let value = tensor_of(name, &view, &tensor.size())?;
            loaded.push((tensor, value));
        }
        let _guard = tch::no_grad_guard();
        for (tensor, value) in &mut loaded {
            tensor.copy_(value);
        }
        Ok(loaded.len())
    }
}

/// Serialises named tensors as safetensors bytes (`F32`, little-endian).
pub fn to_safetensors<'a>(tensors: impl IntoIterator<Item = (&'a str, &'a Tensor)>) -> Vec<u8> {
    let data: Vec<(&str, Vec<usize>, Vec<u8>)> = tensors
        .into_iter()
        .map(|(name, tensor)| {
            let tensor = tensor
                .detach()
                .to_device(Device::Cpu)
                .to_kind(Kind::Float)
                .contiguous();
            let mut bytes = vec![0; tensor.numel() * 4];
            tensor.copy_data_u8(&mut bytes, tensor.numel());
            let shape = tensor.size().iter().map(|&n| n as usize).collect();
            (name, shape, bytes)
        })
        .collect();
    let views: HashMap<&str, TensorView<'_>> = data
        .iter()
        .map(|(name, shape, bytes)| {
            let view =
                TensorView::new(Dtype::F32, shape.clone(), bytes).expect("bytes match the shape");
            (*name, view)
        })
        .collect();
    safetensors::serialize(views, None).expect("plain tensors serialise")
}

/// One tensor of a parsed file, checked against the expected shape.
///
/// # Errors
/// [`LoadError::Shape`] on another shape or element type.
pub fn tensor_of(name: &str, view: &TensorView<'_>, expected: &[i64]) -> Result<Tensor, LoadError> {
    let shape: Vec<i64> = view.shape().iter().map(|&n| n as i64).collect();
    if view.dtype() != Dtype::F32 || shape != expected {
        return Err(LoadError::Shape {
            name: name.to_owned(),
            found: format!("{:?} {shape:?}", view.dtype()),
            expected: format!("F32 {expected:?}"),
        });
    }
    let values: Vec<f32> = view
        .data()
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    Ok(Tensor::from_slice(&values).view(expected))
}

/// A prefix of names within a group.
#[derive(Debug)]
pub struct Scope<'a> {
    params: &'a mut Params,
    prefix: String,
}

impl Scope<'_> {
    /// The scope `name` below this one.
    pub fn sub(&mut self, name: impl AsRef<str>) -> Scope<'_> {
        Scope {
            prefix: format!("{}.{}", self.prefix, name.as_ref()),
            params: self.params,
        }
    }

    /// The element type of this group's large products.
    pub fn products(&self) -> Kind {
        self.params.products
    }

    /// Adds a parameter drawn from U(-bound, bound).
    pub fn uniform(&mut self, name: &str, shape: &[i64], bound: f64) -> Tensor {
        let options = (Kind::Float, self.params.device);
        self.add(
            name,
            &(Tensor::rand(shape, options) * (2.0 * bound) - bound),
        )
    }

    /// Adds a parameter with all values `value`.
    pub fn constant(&mut self, name: &str, shape: &[i64], value: f64) -> Tensor {
        let options = (Kind::Float, self.params.device);
        self.add(name, &Tensor::full(shape, value, options))
    }

    fn add(&mut self, name: &str, value: &Tensor) -> Tensor {
        let tensor = value.set_requires_grad(true);
        self.params
            .entries
            .push((format!("{}.{name}", self.prefix), tensor.shallow_clone()));
        tensor
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group() -> (Params, Tensor, Tensor) {
        tch::manual_seed(1);
        let mut params = Params::new(Device::Cpu);
        let (a, b) = {
            let mut root = params.root("net");
            let a = root.sub("layer").uniform("weight", &[2, 3], 0.5);
            (a, root.constant("scale", &[4], 1.0))
        };
        params.flatten();
        (params, a, b)
    }

    #[test]
    fn networks_see_changes_of_the_flat_vector() {
        let (params, a, b) = group();
        assert_eq!(params.numel(), 10);
        let _ = tch::no_grad(|| params.flat().shallow_clone().fill_(3.0));
        assert_eq!(f64::try_from(a.sum(Kind::Float)).expect("scalar"), 18.0);
        assert_eq!(f64::try_from(b.sum(Kind::Float)).expect("scalar"), 12.0);
        assert!(a.requires_grad() && a.is_leaf());
    }

    #[test]
    fn safetensors_round_trip_and_shape_errors() {
        let (params, a, _) = group();
        let bytes = to_safetensors(params.entries().iter().map(|(n, t)| (n.as_str(), t)));
        let (mut other, other_a, _) = group();
        let _ = tch::no_grad(|| other.flat().shallow_clone().fill_(0.0));
        other
            .load(&SafeTensors::deserialize(&bytes).expect("valid"))
            .expect("same layout");
        assert!(a.allclose(&other_a, 0.0, 0.0, false));

        let wrong = to_safetensors([(
            "net.layer.weight",
            &Tensor::zeros([3, 2], (Kind::Float, Device::Cpu)),
        )]);
        let error = other
            .load(&SafeTensors::deserialize(&wrong).expect("valid"))
            .expect_err("wrong shape");
        assert!(error.to_string().contains("net.layer.weight"), "{error}");
        assert!(
            a.allclose(&other_a, 0.0, 0.0, false),
            "a failed load changes nothing"
        );
    }
}
