//! The few messages of TensorFlow's `event.proto` and `summary.proto` that TensorBoard needs, derived by
//! hand so that no build script has to fetch the originals.

use prost::{Message, Oneof};

/// `Image.colorspace` of three channels.
pub(super) const COLORSPACE_RGB: i32 = 3;

/// `tensorflow.Event`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Event {
    #[prost(double, tag = "1")]
    pub(super) wall_time: f64,
    #[prost(int64, tag = "2")]
    pub(super) step: i64,
    #[prost(oneof = "What", tags = "3, 5, 7")]
    pub(super) what: Option<What>,
}

/// `tensorflow.Event.what`.
#[derive(Clone, PartialEq, Oneof)]
pub(super) enum What {
    #[prost(string, tag = "3")]
    FileVersion(String),
    #[prost(message, tag = "5")]
    Summary(Summary),
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Summary {
    #[prost(message, repeated, tag = "1")]
    pub(super) value: Vec<Value>,
}

/// `tensorflow.Summary.Value`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Value {
    #[prost(string, tag = "1")]
    pub(super) tag: String,
    #[prost(oneof = "value::Kind", tags = "2, 4")]
    pub(super) value: Option<value::Kind>,
}

pub(super) mod value {
    //! What a [`super::Value`] holds.

    /// `tensorflow.Summary.Value.value`.
    #[derive(Clone, PartialEq, prost::Oneof)]
    pub(in crate::tensorboard) enum Kind {
        #[prost(float, tag = "2")]
        SimpleValue(f32),
        #[prost(message, tag = "4")]
        Image(super::Image),
    }
}

/// `tensorflow.Summary.Image`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Image {
    #[prost(int32, tag = "1")]
    pub(super) height: i32,
    #[prost(int32, tag = "2")]
    pub(super) width: i32,
    #[prost(int32, tag = "3")]
    pub(super) colorspace: i32,
    #[prost(bytes = "vec", tag = "4")]
    pub(super) encoded_image_string: Vec<u8>,
}

/// `tensorflow.SessionLog`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

impl SessionLog {
    /// `SessionLog.START`: events of earlier files from this step on are void.
    pub(super) fn start() -> Self {
        Self { status: 1 }
    }
}

/// An event at `step`.
pub(super) fn event(wall_time: f64, step: u64, what: What) -> Event {
    Event {
        wall_time,
        step: i64::try_from(step).unwrap_or(i64::MAX),
        what: Some(what),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // The expected bytes come from the protobuf classes of TensorBoard 2.21 itself.
    #[test]
    fn messages_encode_as_tensorboard_encodes_them() {
        let version = event(1.5, 0, What::FileVersion("brain.Event:2".to_owned()));
        assert_eq!(
            hex(&version),
            "09000000000000f83f1a0d627261696e2e4576656e743a32"
        );
        let value = Value {
            tag: "train/loss".to_owned(),
            value: Some(value::Kind::SimpleValue(0.25)),
        };
        let scalar = event(2.5, 300, What::Summary(Summary { value: vec![value] }));
        assert_eq!(
            hex(&scalar),
            "09000000000000044010ac022a130a110a0a747261696e2f6c6f7373150000803e"
        );
    }

    fn hex(event: &Event) -> String {
        event
            .encode_to_vec()
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect()
    }
}
