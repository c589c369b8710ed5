//! Our pictures against those of dm_control's own renderer, where there is a software OpenGL for it.

use std::io::Write;
use std::process::{Command, Stdio};
use std::thread;

use super::venv::said;
use super::{Peer, RandomState, peer_error};
use crate::EnvError;
use crate::dmc::{ControlTask, Recolour, SceneRenderer};
use crate::is_background;

const PICTURES: &str = include_str!("pictures.py");
const SPEED: &str = include_str!("speed.py");

/// Height and width of a picture.
const SIDE: usize = 64;
/// Control steps between two states that are compared.
const STEPS_BETWEEN: usize = 25;
/// How long one action is held.
const HELD_STEPS: usize = 5;

/// How far apart pictures of the same states are.
#[derive(Debug, Clone, PartialEq)]
pub struct PictureParity {
    /// Mean absolute difference of bytes, of 255.
    pub mean_abs_diff: f64,
    /// Share of pixels of `video_easy` models on which the chroma keys agree.
    pub mask_agreement: f64,
    /// Our pictures one after the other, `[count, 64, 64, 3]`.
    pub ours: Vec<u8>,
    /// Those of dm_control.
    pub theirs: Vec<u8>,
}

impl Peer {
    /// Renders `count` states of an episode of `task` here and there. `None` where dm_control cannot render: there is
    /// no OSMesa, or the task places a target that is no joint.
    ///
    /// # Errors
    /// If the task is unknown or fails on either side.
    pub fn compare_pictures(
        &self,
        task: &str,
        count: usize,
    ) -> Result<Option<PictureParity>, EnvError> {
        let mut task = ControlTask::load(task)?;
        let (domain, name) = task.domain_and_task();
        let has_placed_target =
            domain == "reacher" || matches!(name, "turn_easy" | "turn_hard" | "swim");
        if has_placed_target || !self.renders() {
            return Ok(None);
        }
        let size = (SIDE, SIDE);
        let mut plain = SceneRenderer::new(&task, size, Recolour::None)?;
        let mut green = SceneRenderer::new(&task, size, Recolour::Skybox)?;
        let mut random = RandomState::new(1);
        let mut action = vec![0.0; task.action_dim()];
        let mut states = (count as u32).to_le_bytes().to_vec();
        let (mut ours, mut ours_green) = (Vec::new(), Vec::new());
        task.reset(1)?;
        for step in 0..count * STEPS_BETWEEN {
            if step % STEPS_BETWEEN == 0 {
                let numbers = task.qpos().iter().chain(task.qvel());
                states.extend(numbers.flat_map(|number| number.to_le_bytes()));
                ours.extend(plain.render(&mut task));
                ours_green.extend(green.render(&mut task));
            }
            if step % HELD_STEPS == 0 {
                action.fill_with(|| random.uniform(-1.0, 1.0));
            }
            task.step(&action)?;
        }
        let theirs = self.pictures(domain, name, &states, &[])?;
        let theirs_green = self.pictures(domain, name, &states, &["--green", "easy"])?;
        if theirs.len() != ours.len() || theirs_green.len() != ours.len() {
            return Err(peer_error(&"it made another number of pictures").into());
        }
        let apart = ours
            .iter()
            .zip(&theirs)
            .map(|(a, b)| u64::from(a.abs_diff(*b)));
        let (a, _) = ours_green.as_chunks::<3>();
        let (b, _) = theirs_green.as_chunks::<3>();
        let agree = |(a, b): &(&[u8; 3], &[u8; 3])| is_background(**a) == is_background(**b);
        Ok(Some(PictureParity {
            mean_abs_diff: apart.sum::<u64>() as f64 / ours.len() as f64,
            mask_agreement: a.iter().zip(b).filter(agree).count() as f64 / a.len() as f64,
            ours,
            theirs,
        }))
    }

    /// Control steps with a 64 x 64 picture each that dm_control makes per second; `None` where it cannot render.
    ///
    /// # Errors
    /// If the task is unknown or Python fails.
    pub fn frames_per_s(&self, task: &str, seconds: f64) -> Result<Option<f64>, EnvError> {
        let (domain, name) = crate::dmc::entry(task)?.domain_and_task();
        if !self.renders() {
            return Ok(None);
        }
        let mut command = self.osmesa(SPEED);
        command.args([seconds.to_string(), format!("{domain}/{name}")]);
        let output = command.output().map_err(|error| peer_error(&error))?;
        let text = String::from_utf8_lossy(&output.stdout);
        match text.trim().parse() {
            Ok(rate) if output.status.success() => Ok(Some(rate)),
            _ => Err(peer_error(&said(output.status, &output.stderr)).into()),
        }
    }

    /// Whether dm_control finds OSMesa.
    fn renders(&self) -> bool {
        let import = "from dm_control import _render; assert _render.Renderer";
        self.osmesa(import)
            .output()
            .is_ok_and(|output| output.status.success())
    }

    fn osmesa(&self, script: &str) -> Command {
        let mut command = Command::new(&self.python);
        command.args(["-c", script]).env("MUJOCO_GL", "osmesa");
        // The software rasteriser in this thread: one core, as ours.
        command.env("LP_NUM_THREADS", "0");
        command
    }

    fn pictures(
        &self,
        domain: &str,
        name: &str,
        states: &[u8],
        options: &[&str],
    ) -> Result<Vec<u8>, EnvError> {
        let mut child = self
            .osmesa(PICTURES)
            .args([domain, name])
            .args(options)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| peer_error(&error))?;
        let input = child.stdin.take();
        let output = thread::scope(|scope| {
            // Beside reading, so that neither side waits for the other. A broken pipe shows in the status.
            scope.spawn(move || input.map(|mut input| input.write_all(states)));
            child.wait_with_output()
        })
        .map_err(|error| peer_error(&error))?;
        if !output.status.success() {
            return Err(peer_error(&said(output.status, &output.stderr)).into());
        }
        Ok(output.stdout)
    }
}
