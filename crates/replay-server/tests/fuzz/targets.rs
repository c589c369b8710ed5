//! The decoders, and valid inputs of each.

use std::path::{Path, PathBuf};

use isodream_core::{Chunk, EnvSpec, ImageShape, Step, Steps, codec};
use isodream_proto::{Identity, v1};
use isodream_replay::{Selector, Store, StoreOptions, Table};
use prost::Message;

fn identity() -> Identity {
    let image = ImageShape {
        height: 2,
        width: 2,
        channels: 3,
    };
    let spec = EnvSpec {
        id: "fuzz".into(),
        image,
        action_dim: 2,
        action_repeat: 1,
        time_limit: 100,
    };
    Identity::new(&spec, "")
}

fn chunk(seq: u64, steps: u32) -> Chunk {
    let mut encoded = Steps::new(12, 2);
    for index in 0..steps {
        encoded.push(&Step {
            image: vec![index as u8; 12],
            action: vec![0.5, -0.5],
            reward: index as f32,
            discount: 1.0,
            is_first: index == 0,
            is_last: false,
            is_terminal: false,
        });
    }
    Chunk {
        actor_id: "actor".into(),
        epoch: 1,
        seq,
        episode_id: 7,
        first_step: 0,
        steps,
        ends_episode: false,
        payload: codec::encode(&encoded),
    }
}

pub(crate) fn payloads() -> Vec<Vec<u8>> {
    [1, 3, 16]
        .map(|steps| chunk(0, steps).payload.to_vec())
        .to_vec()
}

pub(crate) fn decode_payload(bytes: &[u8]) {
    if let Ok(steps) = codec::decode(bytes) {
        assert!(steps.len * steps.image_bytes <= codec::MAX_DECODED_BYTES);
        assert_eq!(steps.images.len(), steps.len * steps.image_bytes);
    }
}

pub(crate) fn messages() -> Vec<Vec<u8>> {
    use v1::{append_request, sample_request};
    let handshake = || Some(identity().handshake());
    let append = |kind| v1::AppendRequest { kind: Some(kind) }.encode_to_vec();
    let sample = |kind| v1::SampleRequest { kind: Some(kind) }.encode_to_vec();
    let hello = v1::Hello {
        handshake: handshake(),
        actor_id: "actor".into(),
        epoch: 1,
        ..v1::Hello::default()
    };
    let sample_hello = v1::SampleHello {
        handshake: handshake(),
        sequence_length: 5,
        ..v1::SampleHello::default()
    };
    let reply = v1::SampleReply {
        chunks: vec![chunk(0, 3).into()],
        offset: 1,
        ..v1::SampleReply::default()
    };
    vec![
        append(append_request::Kind::Hello(hello)),
        append(append_request::Kind::Chunk(chunk(0, 3).into())),
        sample(sample_request::Kind::Hello(sample_hello)),
        reply.encode_to_vec(),
    ]
}

pub(crate) fn decode_message(bytes: &[u8]) {
    use v1::append_request::Kind;
    match v1::AppendRequest::decode(bytes).map(|request| request.kind) {
        Ok(Some(Kind::Chunk(chunk))) => {
            assert!(Chunk::try_from(chunk).map_or(true, |chunk| chunk.steps > 0));
        }
        Ok(Some(Kind::Hello(hello))) => {
            let _ = identity().check(hello.handshake.as_ref());
        }
        Ok(None) | Err(_) => {}
    }
    let _ = v1::SampleRequest::decode(bytes);
    if let Ok(reply) = v1::SampleReply::decode(bytes) {
        for chunk in reply.chunks {
            let _ = Chunk::try_from(chunk);
        }
    }
}

/// The first segment of a store with a few chunks.
pub(crate) fn segments() -> Vec<Vec<u8>> {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = Store::open(folder.path(), &StoreOptions::default()).unwrap();
    writer.begin("actor", 1, 0).unwrap();
    for seq in 0..3 {
        writer.commit(vec![chunk(seq, 4)]).unwrap();
    }
    drop((writer, store));
    vec![std::fs::read(segment(folder.path())).unwrap()]
}

fn segment(folder: &Path) -> PathBuf {
    let files = std::fs::read_dir(folder).unwrap();
    let sizes = files.map(|file| {
        let file = file.unwrap();
        (file.metadata().unwrap().len(), file.path())
    });
    // All others are a line or two.
    sizes.max().unwrap().1
}

/// Opens a store whose only segment has these bytes, and reads what it says that it holds.
pub(crate) fn open_segment(bytes: &[u8]) {
    thread_local! {
        static STORE: (tempfile::TempDir, PathBuf) = {
            let folder = tempfile::tempdir().unwrap();
            let (mut writer, _, _) = Store::open(folder.path(), &StoreOptions::default()).unwrap();
            writer.begin("actor", 1, 0).unwrap();
            writer.commit(vec![chunk(0, 16)]).unwrap();
            let segment = segment(folder.path());
            (folder, segment)
        };
    }
    STORE.with(|(folder, segment)| {
        std::fs::write(segment, bytes).unwrap();
        if let Ok((_, store, recovery)) = Store::open(folder.path(), &StoreOptions::default()) {
            assert!(recovery.torn_bytes <= bytes.len() as u64);
            let table = Table::new("any", Selector::Episodes);
            let mut sampler = store.sampler(&table, 1, 1).unwrap();
            if let Some(sequence) = sampler.draw() {
                for place in sequence.chunks {
                    if let Ok(chunk) = place.read() {
                        decode_payload(&chunk.payload);
                    }
                }
            }
        }
    });
}
