//! The open-loop panel of the paper: truth, prediction, error, and the picture and mask of each branch.

use isodream_model::Batch;
use isodream_model::open_loop::OpenLoop;
use isodream_telemetry::Rgb;
use tch::{Device, Kind, Tensor};

/// Columns of the still picture, as far as the sequence reaches.
const SHOWN: [usize; 9] = [0, 4, 5, 9, 14, 19, 29, 39, 49];

/// The first sequence of a prediction as rows of pictures.
#[derive(Debug)]
pub struct Panel {
    context: i64,
    length: usize,
    rows: Vec<(&'static str, Vec<Rgb>)>,
}

impl Panel {
    /// Frames per second of the video.
    pub const FPS: f64 = 5.0;

    /// The first sequence of `batch`, whose frames from `context` on are predicted.
    pub fn new(batch: &Batch, prediction: &OpenLoop, context: i64) -> Self {
        let composition = &prediction.composition;
        let truth = batch.images.select(0, 0);
        let length = truth.size()[0];
        let first = |x: &Tensor| x.narrow(0, 0, length);
        let (s, z) = (&composition.controllable, &composition.noncontrollable);
        let error = (first(&composition.image) - &truth).abs() - 0.5;
        let background: Tensor = 1.0 - first(&s.mask) - first(&z.mask);
        Self {
            context,
            length: length as usize,
            rows: vec![
                ("truth", pictures(&truth)),
                ("prediction", pictures(&first(&composition.image))),
                ("error", pictures(&error)),
                ("controllable", pictures(&first(&s.rgb))),
                ("mask s", masks(&first(&s.mask))),
                ("noncontrollable", pictures(&first(&z.rgb))),
                ("mask z", masks(&first(&z.mask))),
                ("static", pictures(&first(&composition.background))),
                ("mask b", masks(&background)),
            ],
        }
    }

    /// Chosen frames side by side.
    pub fn still(&self) -> Rgb {
        let rows: Vec<Vec<Rgb>> = self
            .rows
            .iter()
            .map(|(name, frames)| {
                SHOWN
                    .iter()
                    .filter(|&&t| t < self.length)
                    .map(|&t| frames[t].upscale(2).labelled(&self.label(name, t)))
                    .collect()
            })
            .collect();
        Rgb::tile(&rows, 4)
    }

    /// Every frame, all rows at one time.
    pub fn video(&self) -> Vec<Rgb> {
        (0..self.length).map(|t| self.moment(t)).collect()
    }

    /// Every frame small and without words, for pages that cannot play videos.
    pub fn thumbnails(&self) -> Vec<Rgb> {
        let moment = |t: usize| {
            let cells: Vec<Rgb> = self
                .rows
                .iter()
                .map(|(_, frames)| frames[t].clone())
                .collect();
            Rgb::tile(&cells.chunks(3).map(<[Rgb]>::to_vec).collect::<Vec<_>>(), 2)
        };
        (0..self.length).map(moment).collect()
    }

    /// All rows at one time, three by three.
    fn moment(&self, t: usize) -> Rgb {
        let cells: Vec<Rgb> = self
            .rows
            .iter()
            .map(|(name, frames)| frames[t].upscale(3).labelled(&self.label(name, t)))
            .collect();
        let rows: Vec<Vec<Rgb>> = cells.chunks(3).map(<[Rgb]>::to_vec).collect();
        Rgb::tile(&rows, 4)
    }

    fn label(&self, name: &str, t: usize) -> String {
        match name {
            "prediction" if (t as i64) < self.context => format!("seen {t}"),
            "prediction" => format!("predicted {t}"),
            "truth" => format!("{name} {t}"),
            _ => name.to_owned(),
        }
    }
}

/// `[T, 3, H, W]` in `[-0.5, 0.5]`.
fn pictures(x: &Tensor) -> Vec<Rgb> {
    let (height, width) = (x.size()[2] as usize, x.size()[3] as usize);
    let bytes = ((x + 0.5) * 255.0)
        .clamp(0.0, 255.0)
        .to_kind(Kind::Uint8)
        .permute([0, 2, 3, 1])
        .contiguous()
        .to_device(Device::Cpu);
    bytes
        .unbind(0)
        .iter()
        .map(|picture| {
            let mut data = vec![0; height * width * 3];
            let count = data.len();
            picture.copy_data_u8(&mut data, count);
            Rgb::new(width, height, data)
        })
        .collect()
}

/// `[T, 1, H, W]`, drawn from 0 (dark) to 1 (bright).
fn masks(x: &Tensor) -> Vec<Rgb> {
    let (height, width) = (x.size()[2] as usize, x.size()[3] as usize);
    x.contiguous()
        .to_device(Device::Cpu)
        .unbind(0)
        .iter()
        .map(|mask| {
            let mut values = vec![0.0; height * width];
            let count = values.len();
            mask.contiguous().copy_data(&mut values, count);
            Rgb::heat(width, height, &values)
        })
        .collect()
}
