//! A learner's receiving side: draws batches and decodes them into their memory.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossbeam_channel::{Receiver, Sender, bounded};
use isodream_core::codec::{Decoder, Rows};
use isodream_rpc::{Dialer, SampleClient, SampleOptions, SampledSequence};

use super::part::{Done, Work, answer};
use super::probes;
use super::server::TABLE;

/// Memory of a batch.
struct Batch {
    images: Vec<u8>,
    actions: Vec<f32>,
    rewards: Vec<f32>,
    discounts: Vec<f32>,
}

type Job = Vec<SampledSequence>;

pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let (ask, asked) = bounded::<()>(0);
    let (jobs, queue) = bounded::<Job>(work.decoders);
    let (done, decoded) = bounded::<anyhow::Result<()>>(work.decoders);
    for _ in 0..work.decoders {
        let (queue, done, work) = (queue.clone(), done.clone(), work.clone());
        std::thread::spawn(move || decode(&queue, &done, &work));
    }
    let drawer = work.clone();
    std::thread::spawn(move || draw(&drawer, &asked, &jobs, &done));
    answer(&"ready", |seconds| {
        let until = Duration::from_secs_f64(seconds.parse()?);
        // The client connects when it is asked for the first time, because there must be something to draw.
        let _ = ask.try_send(());
        next(&decoded)?;
        let cpu_before = probes::cpu_seconds();
        let begun = Instant::now();
        let mut batches = 0;
        while begun.elapsed() < until {
            next(&decoded)?;
            batches += 1;
        }
        let seconds = begun.elapsed().as_secs_f64();
        Ok(Done {
            steps: batches * (work.batch_size * work.batch_length) as u64,
            seconds,
            cpu_seconds: probes::cpu_seconds() - cpu_before,
        })
    })
}

fn next(decoded: &Receiver<anyhow::Result<()>>) -> anyhow::Result<()> {
    decoded.recv().context("the sampling threads ended")?
}

fn draw(
    work: &Work,
    asked: &Receiver<()>,
    jobs: &Sender<Job>,
    failed: &Sender<anyhow::Result<()>>,
) {
    let drawing = || -> anyhow::Result<()> {
        let runtime = tokio::runtime::Runtime::new()?;
        asked.recv()?;
        let mut client = {
            let _inside = runtime.enter();
            SampleClient::start(
                &Dialer::default(),
                SampleOptions {
                    addresses: vec![work.address.clone()],
                    table: TABLE.to_owned(),
                    identity: work.identity(&work.spec()?),
                    sequence_length: work.batch_length as u32,
                    learner_epoch: 0,
                    seed: 1,
                    prefetch: work.prefetch_batches * work.batch_size,
                    sampled_steps: BTreeMap::new(),
                    unlimited_sequences: 0,
                },
            )?
        };
        loop {
            let sequences: Result<Vec<_>, _> = (0..work.batch_size)
                .map(|_| client.next_blocking())
                .collect();
            jobs.send(sequences?)?;
        }
    };
    if let Err(error) = drawing() {
        let _ = failed.send(Err(error));
    }
}

fn decode(queue: &Receiver<Job>, done: &Sender<anyhow::Result<()>>, work: &Work) {
    let image_bytes = 3 * work.image_size * work.image_size;
    let steps = work.batch_size * work.batch_length;
    let mut decoder = Decoder::default();
    let mut batch = Batch {
        images: vec![0; steps * image_bytes],
        actions: vec![0.0; steps * work.action_dim],
        rewards: vec![0.0; steps],
        discounts: vec![0.0; steps],
    };
    for sequences in queue {
        let result = fill(&mut batch, &sequences, &mut decoder, work.batch_length);
        if done.send(result).is_err() {
            return;
        }
    }
}

fn fill(
    batch: &mut Batch,
    sequences: &[SampledSequence],
    decoder: &mut Decoder,
    length: usize,
) -> anyhow::Result<()> {
    let mut rest = Rows {
        images: &mut batch.images,
        actions: &mut batch.actions,
        rewards: &mut batch.rewards,
        discounts: &mut batch.discounts,
    };
    for sequence in sequences {
        let rows;
        (rows, rest) = rest.split_at(length);
        sequence.decode_into(decoder, rows)?;
    }
    Ok(())
}
