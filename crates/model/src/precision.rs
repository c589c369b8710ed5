//! The numbers in which matrices are multiplied.

use isodream_core::config::Precision;
use tch::{Device, Kind};

/// The element type of products for `precision` on `device`.
pub fn product_kind(precision: Precision, device: Device) -> Kind {
    match precision {
        Precision::Fp32 => Kind::Float,
        Precision::Bf16 => Kind::BFloat16,
        Precision::Auto if multiplies_bf16(device) => Kind::BFloat16,
        Precision::Auto => Kind::Float,
    }
}

/// Whether `device` has instructions for products of bf16; without them they are slower than those of f32.
fn multiplies_bf16(device: Device) -> bool {
    if device.is_cuda() {
        return true;
    }
    #[cfg(target_arch = "x86_64")]
    {
        // Processors with AMX have this as well.
        std::arch::is_x86_feature_detected!("avx512bf16")
    }
    #[cfg(target_arch = "aarch64")]
    {
        std::arch::is_aarch64_feature_detected!("bf16")
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_for_is_what_is_used() {
        assert_eq!(product_kind(Precision::Fp32, Device::Cpu), Kind::Float);
        assert_eq!(product_kind(Precision::Bf16, Device::Cpu), Kind::BFloat16);
        let auto = product_kind(Precision::Auto, Device::Cpu);
        assert_eq!(auto == Kind::BFloat16, multiplies_bf16(Device::Cpu));
    }
}
