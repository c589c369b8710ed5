//! A simulated model with dm_control's order of computations.

use std::path::{Path, PathBuf};
use std::sync::Once;

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::prelude::*;

use super::{ControlError, library};

/// The model of a task and its state.
#[derive(Debug)]
pub(super) struct Physics {
    data: MjData<Box<MjModel>>,
    /// Where the model came from, for what is wrong with it.
    path: PathBuf,
}

impl Physics {
    /// Compiles the model in `path`.
    pub(super) fn load(path: &Path) -> Result<Self, ControlError> {
        library::load()?;
        silence();
        if !path.is_file() {
            return Err(ControlError::ModelMissing { path: path.into() });
        }
        let error = |reason: String| ControlError::Model {
            path: path.into(),
            reason,
        };
        let model = MjModel::from_xml(path).map_err(|e| error(e.to_string()))?;
        let data = MjData::try_new(Box::new(model)).map_err(|e| error(e.to_string()))?;
        Ok(Self {
            data,
            path: path.into(),
        })
    }

    pub(super) fn model(&self) -> &MjModel {
        self.data.model()
    }

    pub(super) fn data(&self) -> &MjData<Box<MjModel>> {
        &self.data
    }

    pub(super) fn data_mut(&mut self) -> &mut MjData<Box<MjModel>> {
        &mut self.data
    }

    /// What tasks may change in the model.
    pub(super) fn edit(&mut self) -> ModelEdit<'_> {
        // SAFETY: `ModelEdit` hands out colours, places and sizes alone: the model is neither replaced nor are
        // sizes of arrays, addresses or ids touched.
        ModelEdit(unsafe { self.data.model_mut() })
    }

    pub(super) fn body(&self, name: &str) -> Result<usize, ControlError> {
        self.id(MjtObjBase::mjOBJ_BODY, "body", name)
    }

    pub(super) fn geom(&self, name: &str) -> Result<usize, ControlError> {
        self.id(MjtObjBase::mjOBJ_GEOM, "geom", name)
    }

    pub(super) fn site(&self, name: &str) -> Result<usize, ControlError> {
        self.id(MjtObjBase::mjOBJ_SITE, "site", name)
    }

    pub(super) fn joint(&self, name: &str) -> Result<Joint, ControlError> {
        let id = self.id(MjtObjBase::mjOBJ_JOINT, "joint", name)?;
        Ok(Joint {
            id,
            qpos: self.model().jnt_qposadr()[id] as usize,
            dof: self.model().jnt_dofadr()[id] as usize,
        })
    }

    /// Where the values of a sensor begin in `sensordata`.
    pub(super) fn sensor(&self, name: &str) -> Result<usize, ControlError> {
        let id = self.id(MjtObjBase::mjOBJ_SENSOR, "sensor", name)?;
        Ok(self.model().sensor_adr()[id] as usize)
    }

    fn id(&self, of: MjtObjBase, kind: &str, name: &str) -> Result<usize, ControlError> {
        self.model()
            .name_to_id(of, name)
            .ok_or_else(|| self.unusable(format!("it has no {kind} \"{name}\"")))
    }

    /// The error that the model is not what is needed.
    pub(super) fn unusable(&self, reason: String) -> ControlError {
        ControlError::Model {
            path: self.path.clone(),
            reason,
        }
    }

    /// The z component of the body's own z axis: 1 upright, -1 upside down.
    pub(super) fn upright(&self, body: usize) -> f64 {
        self.data.xmat()[body][8]
    }

    /// Number of contacts in the present pose.
    pub(super) fn contacts(&self) -> i32 {
        self.data.ncon()
    }

    /// Back to the model's own pose.
    pub(super) fn reset(&mut self) {
        self.data.reset();
        self.forward();
    }

    /// Computes everything that depends on the state, without actuation: controls mean nothing yet.
    pub(super) fn forward(&mut self) {
        let flag = MjtDisableBit::mjDSBL_ACTUATION as i32;
        let flags = self.data.model_opt().disableflags;
        self.data.model_opt_mut().disableflags = flags | flag;
        self.data.forward();
        self.data.model_opt_mut().disableflags = flags;
    }

    /// Simulates `steps` time steps, and leaves everything that depends on position and velocity current.
    ///
    /// Each control step begins in the middle of MuJoCo's own step, because its first half was done at the
    /// end of the one before.
    pub(super) fn step(&mut self, steps: usize) {
        let mut whole = steps;
        if self.data.model_opt().integrator != MjtIntegrator::mjINT_RK4 as i32 {
            self.data.step2();
            whole -= 1;
        }
        for _ in 0..whole {
            self.data.step();
        }
        self.data.step1();
    }

    /// Fails where MuJoCo has warned since the last reset.
    pub(super) fn check(&self) -> Result<(), ControlError> {
        let raised = self.data.warning();
        if raised.iter().all(|warning| warning.number == 0) {
            return Ok(());
        }
        let names: Vec<&str> = WARNINGS
            .iter()
            .zip(raised)
            .filter(|(_, warning)| warning.number > 0)
            .map(|(name, _)| *name)
            .collect();
        Err(ControlError::Unstable {
            warnings: names.join(", "),
        })
    }
}

/// Names of MuJoCo's warnings, in its order.
const WARNINGS: [&str; MjtWarning::mjNWARNING as usize] = [
    "near-singular inertia",
    "contact buffer full",
    "constraint buffer full",
    "bad qpos",
    "bad qvel",
    "bad qacc",
    "bad ctrl",
];

/// Where a joint of one degree of freedom is in the model's arrays.
#[derive(Debug, Clone, Copy)]
pub(super) struct Joint {
    pub(super) id: usize,
    pub(super) qpos: usize,
    pub(super) dof: usize,
}

/// The part of a model that does not decide over memory.
pub(super) struct ModelEdit<'a>(&'a mut MjModel);

impl ModelEdit<'_> {
    pub(super) fn geom_pos(&mut self, id: usize) -> &mut [f64; 3] {
        &mut self.0.geom_pos_mut()[id]
    }

    pub(super) fn geom_size(&mut self, id: usize) -> &mut [f64; 3] {
        &mut self.0.geom_size_mut()[id]
    }

    pub(super) fn geom_rgba(&mut self, id: usize) -> &mut [f32; 4] {
        &mut self.0.geom_rgba_mut()[id]
    }

    pub(super) fn site_pos(&mut self, id: usize) -> &mut [f64; 3] {
        &mut self.0.site_pos_mut()[id]
    }

    pub(super) fn site_size(&mut self, id: usize) -> &mut [f64; 3] {
        &mut self.0.site_size_mut()[id]
    }

    pub(super) fn site_rgba(&mut self, id: usize) -> &mut [f32; 4] {
        &mut self.0.site_rgba_mut()[id]
    }

    pub(super) fn dof_damping(&mut self, dof: usize) -> &mut f64 {
        &mut self.0.dof_damping_mut()[dof]
    }
}

/// Keeps MuJoCo from writing to the terminal and to `MUJOCO_LOG.TXT`: what matters of it comes back as errors.
fn silence() {
    static ONCE: Once = Once::new();
    // SAFETY: every use of MuJoCo in this process begins with `Physics::load`, which waits here.
    ONCE.call_once(|| unsafe { set_log_handler(hear) });
}

fn hear(message: &MjLogMessage) {
    // MuJoCo ends the process after an error, so that this is the last chance to say why.
    if message.level() == MjtLogLevel::mjLOG_ERROR {
        eprintln!("mujoco: {}", message.subject());
    }
}
