//! TensorBoard event files, written by hand: no kept crate does it.

mod events;
mod record;

use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::{env, process};

use prost::Message;

use self::events::{Event, Image, SessionLog, Summary, Value, What, event, value};
use crate::metrics::unix_time_secs;
use crate::{Error, Gif, Result, Rgb};

/// What TensorBoard expects in the first event of every file.
const FILE_VERSION: &str = "brain.Event:2";

/// Writes one event file. Every event goes to the operating system at once, so TensorBoard can follow.
#[derive(Debug)]
pub struct EventWriter {
    file: File,
    path: PathBuf,
}

impl EventWriter {
    /// Creates `events.out.tfevents.<unix>.<host>.<pid>` in `dir`. TensorBoard is told to forget what earlier files of
    /// the folder say about frames after `resume_frames`.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn create(dir: &Path, resume_frames: u64) -> Result<Self> {
        let time_secs = unix_time_secs();
        let (file, path) = create_new(dir, time_secs as u64)?;
        let mut writer = Self { file, path };
        writer.write(&event(
            time_secs,
            0,
            What::FileVersion(FILE_VERSION.to_owned()),
        ))?;
        // TensorBoard drops this step too, and the resumed run does not write it again.
        writer.write(&event(
            time_secs,
            resume_frames + 1,
            What::SessionLog(SessionLog::start()),
        ))?;
        Ok(writer)
    }

    /// Writes the scalars of one point in time as one event; they are `f32` in this format.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn scalars<N: AsRef<str>>(
        &mut self,
        frames: u64,
        time_secs: f64,
        values: &[(N, f64)],
    ) -> Result<()> {
        let values = values.iter().map(|(name, scalar)| Value {
            tag: name.as_ref().to_owned(),
            value: Some(value::Kind::SimpleValue(*scalar as f32)),
        });
        self.summary(frames, time_secs, values.collect())
    }

    /// Writes one picture.
    ///
    /// # Errors
    /// [`Error::Png`], [`Error::Io`].
    pub fn image(&mut self, frames: u64, time_secs: f64, name: &str, image: &Rgb) -> Result<()> {
        let size = (image.width, image.height);
        self.encoded(frames, time_secs, name, size, image.encode_png()?)
    }

    /// Writes an animation, which TensorBoard shows moving among the pictures.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn animation(&mut self, frames: u64, time_secs: f64, name: &str, gif: &Gif) -> Result<()> {
        let size = (gif.width, gif.height);
        self.encoded(frames, time_secs, name, size, gif.bytes.clone())
    }

    fn encoded(
        &mut self,
        frames: u64,
        time_secs: f64,
        name: &str,
        (width, height): (usize, usize),
        bytes: Vec<u8>,
    ) -> Result<()> {
        let image = Image {
            height: height as i32,
            width: width as i32,
            colorspace: events::COLORSPACE_RGB,
            encoded_image_string: bytes,
        };
        let value = Value {
            tag: name.to_owned(),
            value: Some(value::Kind::Image(image)),
        };
        self.summary(frames, time_secs, vec![value])
    }

    /// Waits until every event is on disk.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn sync(&self) -> Result<()> {
        self.file.sync_data().map_err(Error::io("sync", &self.path))
    }

    fn summary(&mut self, frames: u64, time_secs: f64, value: Vec<Value>) -> Result<()> {
        self.write(&event(time_secs, frames, What::Summary(Summary { value })))
    }

    fn write(&mut self, event: &Event) -> Result<()> {
        let record = record::frame(&event.encode_to_vec());
        self.file
            .write_all(&record)
            .map_err(Error::io("append to", &self.path))
    }
}

/// A run that resumes within the same second gets a suffix that sorts behind its former life.
fn create_new(dir: &Path, unix_secs: u64) -> Result<(File, PathBuf)> {
    let base = format!(
        "events.out.tfevents.{unix_secs:010}.{}.{}",
        host_name(),
        process::id()
    );
    let mut life = 0;
    loop {
        let suffix = if life == 0 {
            String::new()
        } else {
            format!(".{life}")
        };
        let path = dir.join(format!("{base}{suffix}"));
        match OpenOptions::new().append(true).create_new(true).open(&path) {
            Ok(file) => return Ok((file, path)),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => life += 1,
            Err(error) => return Err(Error::io("create", &path)(error)),
        }
    }
}

fn host_name() -> String {
    let name = fs::read_to_string("/proc/sys/kernel/hostname")
        .ok()
        .or_else(|| env::var("HOSTNAME").ok());
    let name: String = name
        .unwrap_or_default()
        .trim()
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '-' })
        .collect();
    if name.is_empty() {
        "localhost".to_owned()
    } else {
        name
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_events(path: &Path) -> Vec<Event> {
        let bytes = fs::read(path).unwrap();
        record::tests::unframe(&bytes)
            .into_iter()
            .map(|data| Event::decode(data).unwrap())
            .collect()
    }

    #[test]
    fn events_read_back_as_written() {
        let dir = tempfile::tempdir().unwrap();
        let mut writer = EventWriter::create(dir.path(), 20).unwrap();
        writer
            .scalars(21, 5.0, &[("a", 1.5), ("b", f64::INFINITY)])
            .unwrap();
        writer
            .image(22, 6.0, "picture", &Rgb::filled(3, 2, [1, 2, 3]))
            .unwrap();

        let events = read_events(&writer.path);
        assert_eq!(
            events[0].what,
            Some(What::FileVersion(FILE_VERSION.to_owned()))
        );
        assert_eq!(
            (events[1].step, &events[1].what),
            (21, &Some(What::SessionLog(SessionLog::start())))
        );
        let scalar = |tag: &str, value| Value {
            tag: tag.to_owned(),
            value: Some(value::Kind::SimpleValue(value)),
        };
        let value = vec![scalar("a", 1.5), scalar("b", f32::INFINITY)];
        assert_eq!(events[2], event(5.0, 21, What::Summary(Summary { value })));
        let Some(What::Summary(summary)) = &events[3].what else {
            panic!("{:?}", events[3]);
        };
        let Some(value::Kind::Image(image)) = &summary.value[0].value else {
            panic!("{summary:?}");
        };
        assert_eq!((image.width, image.height), (3, 2));
        let decoded = image::load_from_memory(&image.encoded_image_string)
            .unwrap()
            .into_rgb8();
        assert_eq!(decoded.into_raw(), [1, 2, 3].repeat(6));
    }

    #[test]
    fn a_second_life_in_the_same_second_gets_its_own_file() {
        let dir = tempfile::tempdir().unwrap();
        let (_, first) = create_new(dir.path(), 7).unwrap();
        let (_, second) = create_new(dir.path(), 7).unwrap();
        assert!(first < second, "{first:?} {second:?}");
    }
}
