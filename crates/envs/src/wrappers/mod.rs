//! Environments around environments.

mod action_repeat;
mod guard;
mod noise;
mod resize;
mod statistics;
mod time_limit;

pub use self::action_repeat::ActionRepeat;
pub use self::guard::{Guard, check_transition};
pub use self::noise::Noisy;
pub use self::resize::Resize;
pub use self::statistics::Statistics;
pub use self::time_limit::TimeLimit;

/// Methods of `Environment` that a wrapper hands through to its `env`.
macro_rules! forward {
    (@spec) => {
        fn spec(&self) -> &isodream_core::EnvSpec {
            self.env.spec()
        }
    };
    (@segmentation) => {
        fn segmentation(&self) -> Option<Vec<u8>> {
            self.env.segmentation()
        }
    };
    (@metrics) => {
        fn metrics(&self) -> Vec<(&'static str, f64)> {
            self.env.metrics()
        }
    };
    (@privileged) => {
        fn privileged(&self) -> Option<crate::PrivilegedView> {
            self.env.privileged()
        }
    };
    (@simulator) => {
        fn simulator(&self) -> Option<Box<dyn crate::Simulator>> {
            self.env.simulator()
        }
    };
    ($($method:ident),+) => {
        $($crate::wrappers::forward!(@$method);)+
    };
}
use forward;
