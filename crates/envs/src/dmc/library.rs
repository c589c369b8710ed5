//! MuJoCo's shared library, found when the first task is loaded.
//!
//! Linked the usual way, a binary would not even start where the library is missing, highway and all. So the functions
//! of MuJoCo that are called here are defined here, as calls into the library that [`load`] has found: the linker then
//! has no use for the library itself. A function that is missing below is resolved by the linker in the usual way, and a
//! process test, which takes the library away, fails.

use std::ffi::{c_char, c_int, c_void};
use std::sync::OnceLock;

use libloading::Library;
use mujoco_rs::mujoco_c::{
    mjData, mjLogConfig, mjModel, mjVFS, mjfLogHandler, mjtByte, mjvCamera, mjvOption, mjvPerturb,
    mjvScene,
};

use super::ControlError;

const FILE: &str = "libmujoco.so.3.17.0";

static FOUND: OnceLock<Result<Functions, String>> = OnceLock::new();

/// Finds the library, once per process.
///
/// # Errors
/// [`ControlError::LibraryMissing`] where it is not there, or is another one.
pub(super) fn load() -> Result<(), ControlError> {
    let missing = |reason: &String| ControlError::LibraryMissing {
        file: FILE,
        reason: reason.clone(),
    };
    found().as_ref().map(drop).map_err(missing)
}

fn found() -> &'static Result<Functions, String> {
    FOUND.get_or_init(|| {
        // SAFETY: the file with this name and version is MuJoCo, whose initialisation asks nothing of its caller, and
        // the types below are those that `mujoco-rs` declares for this very version.
        let functions = unsafe { Library::new(FILE).and_then(|library| Functions::find(library)) };
        functions.map_err(|error| error.to_string())
    })
}

macro_rules! functions {
    ($(fn $name:ident($($argument:ident: $kind:ty),*) $(-> $result:ty)?;)+) => {
        #[allow(non_snake_case)] // MuJoCo's names
        struct Functions {
            $($name: unsafe extern "C" fn($($kind),*) $(-> $result)?,)+
            /// Stays loaded for as long as the functions are there.
            _library: Library,
        }

        impl Functions {
            /// # Safety
            /// The library must be the MuJoCo that the types are of.
            unsafe fn find(library: Library) -> Result<Self, libloading::Error> {
                Ok(Self {
                    // SAFETY: as the caller promised.
                    $($name: *unsafe { library.get(stringify!($name))? },)+
                    _library: library,
                })
            }
        }

        $(
            #[unsafe(no_mangle)]
            #[allow(non_snake_case)] // MuJoCo's names
            unsafe extern "C" fn $name($($argument: $kind),*) $(-> $result)? {
                match found() {
                    // SAFETY: the caller keeps to MuJoCo's own rules.
                    Ok(functions) => unsafe { (functions.$name)($($argument),*) },
                    // Every use of MuJoCo begins with a load that succeeded.
                    Err(_) => std::process::abort(),
                }
            }
        )+
    };
}

functions! {
    fn mj_version() -> c_int;
    fn mj_loadXML(file: *const c_char, vfs: *const mjVFS, error: *mut c_char, size: c_int) -> *mut mjModel;
    fn mj_deleteModel(model: *mut mjModel);
    fn mj_makeData(model: *const mjModel) -> *mut mjData;
    fn mj_deleteData(data: *mut mjData);
    fn mj_resetData(model: *const mjModel, data: *mut mjData);
    fn mj_forward(model: *const mjModel, data: *mut mjData);
    fn mj_step(model: *const mjModel, data: *mut mjData);
    fn mj_step1(model: *const mjModel, data: *mut mjData);
    fn mj_step2(model: *const mjModel, data: *mut mjData);
    fn mj_name2id(model: *const mjModel, kind: c_int, name: *const c_char) -> c_int;
    fn mj_loadTexture(
        model: *const mjModel, id: c_int, data: *mut *mut mjtByte, width: *mut c_int, height: *mut c_int,
        colours: *mut c_int, error: *mut c_char, size: c_int
    ) -> c_int;
    fn mju_free(memory: *mut c_void);
    fn mju_getLogConfig() -> mjLogConfig;
    fn mju_setLogConfig(config: mjLogConfig);
    fn mju_setLogHandler(handler: mjfLogHandler) -> mjfLogHandler;
    fn mjv_defaultCamera(camera: *mut mjvCamera);
    fn mjv_defaultOption(option: *mut mjvOption);
    fn mjv_defaultPerturb(perturb: *mut mjvPerturb);
    fn mjv_defaultScene(scene: *mut mjvScene);
    fn mjv_makeScene(model: *const mjModel, scene: *mut mjvScene, geoms: c_int);
    fn mjv_freeScene(scene: *mut mjvScene);
    fn mjv_updateScene(
        model: *const mjModel, data: *mut mjData, option: *const mjvOption, perturb: *const mjvPerturb,
        camera: *mut mjvCamera, categories: c_int, scene: *mut mjvScene
    );
}
