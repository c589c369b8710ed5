//! Ctrl-C: every wait of this program ends with an error, so that everything is cleaned up on the way out.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};

static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// How often waits look around.
const TICK: Duration = Duration::from_millis(20);

/// Ends every wait from now on.
pub(crate) fn interrupt() {
    INTERRUPTED.store(true, Ordering::Relaxed);
}

/// Sleeps, unless somebody interrupts.
pub(crate) fn sleep(duration: Duration) -> Result<()> {
    let end = Instant::now() + duration;
    loop {
        if INTERRUPTED.load(Ordering::Relaxed) {
            bail!("interrupted");
        }
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(());
        }
        std::thread::sleep(left.min(TICK));
    }
}

/// Asks again and again until there is an answer.
pub(crate) fn until<T>(
    what: &str,
    deadline: Duration,
    mut ask: impl FnMut() -> Result<Option<T>>,
) -> Result<T> {
    let begun = Instant::now();
    while begun.elapsed() < deadline {
        if let Some(answer) = ask()? {
            return Ok(answer);
        }
        sleep(TICK)?;
    }
    bail!("gave up after {deadline:?} waiting until {what}");
}
