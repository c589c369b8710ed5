//! Settings that libraries read once, when a process starts.

use std::ffi::OsString;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// What a training process of so many workers wants of OpenMP and of glibc's allocator; a variable that is set already
/// stays.
///
/// - Threads that wait spin for some microseconds, which is longer than the pause between two small operations, and
///   then sleep: several processes share the cores. Sleeping at once takes a third more time for a training step,
///   spinning on makes other processes wait.
/// - Freed memory is kept, in huge pages where the kernel has them, instead of being returned after every tensor:
///   the kernel's clearing of fresh pages was a fifth of a training step.
/// - One worker has one arena, because glibc keeps nothing large in the others, and training is not on the main
///   thread: an update of the paper's sizes takes 8 % longer with four. Two workers that share an arena take it from
///   each other at every tensor: an update of the quick preset takes 50 % longer.
fn settings(workers: usize) -> [(&'static str, String); 3] {
    // Other threads take arenas as well.
    let arenas = if workers == 1 { 1 } else { 4 * workers };
    let malloc = format!(
        "glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=1099511627776:glibc.malloc.hugetlb=1:glibc.malloc.arena_max={arenas}"
    );
    [
        ("OMP_WAIT_POLICY", "PASSIVE".to_owned()),
        ("GOMP_SPINCOUNT", "1000".to_owned()),
        ("GLIBC_TUNABLES", malloc),
    ]
}

/// Starts this very command anew with the [`settings`] of a training by so many workers, in the same process, unless
/// all of them are set. Returns only if they are, or if that fails.
pub(crate) fn ensure(workers: usize) -> io::Result<()> {
    let missing: Vec<_> = settings(workers)
        .into_iter()
        .filter(|(name, _)| std::env::var_os(name).is_none())
        .collect();
    if missing.is_empty() {
        return Ok(());
    }
    let args: Vec<OsString> = std::env::args_os().skip(1).collect();
    Err(Command::new(std::env::current_exe()?)
        .args(args)
        .envs(missing)
        .exec())
}
