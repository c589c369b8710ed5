//! How many failures of environments an actor puts up with.

/// Failures in a row, without an episode that ended in between, that end an actor.
const MAX_FAILURES: u32 = 10;

/// Failures of environments since the last episode that ended.
#[derive(Debug, Default)]
pub(crate) struct Failures {
    in_a_row: u32,
}

impl Failures {
    /// An episode came to its end.
    pub(crate) fn none(&mut self) {
        self.in_a_row = 0;
    }

    /// Logs a failure.
    ///
    /// # Errors
    /// The failure itself where it is one too many.
    pub(crate) fn another(&mut self, error: anyhow::Error) -> anyhow::Result<()> {
        self.in_a_row += 1;
        if self.in_a_row >= MAX_FAILURES {
            return Err(error.context(format!(
                "the environment failed {MAX_FAILURES} times and no episode ended"
            )));
        }
        tracing::warn!(
            error = format!("{error:#}"),
            in_a_row = self.in_a_row,
            "the environment failed, a new episode begins"
        );
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use isodream_envs::EnvError;

    use super::*;

    #[test]
    fn an_episode_that_ends_forgives_and_only_the_last_straw_is_an_error() {
        let mut failures = Failures::default();
        for _ in 0..3 {
            for _ in 1..MAX_FAILURES {
                failures.another(EnvError::NotReset.into()).expect("few");
            }
            failures.none();
        }
        for _ in 1..MAX_FAILURES {
            failures.another(EnvError::NotReset.into()).expect("few");
        }
        let error = failures
            .another(EnvError::NotReset.into())
            .expect_err("too many");
        assert!(format!("{error:#}").contains("before its first reset"));
    }
}
