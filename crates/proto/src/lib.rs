//! The gRPC protocol of `/proto/isodream/v1` and its conversions to and from core types.
//!
//! Generated code lives in [`v1`]; its messages are documented in the `.proto` files.

mod convert;

pub use convert::{Identity, InvalidMessage, Mismatch, PROTOCOL_VERSION};

/// Messages, clients and servers generated from `/proto/isodream/v1`.
#[allow(missing_docs, clippy::all, unused_qualifications, unreachable_pub)]
pub mod v1 {
    tonic::include_proto!("isodream.v1");
}
