"""What the tests share: the binary, and running it."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

# The binary works at the same time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).parents[2]


class Isodream:
    """The binary that `cargo xtask test` built, or the one that `ISODREAM` names."""

    def __init__(self) -> None:
        self.path = Path(os.environ.get("ISODREAM", ROOT / "target/debug/isodream"))
        if not self.path.exists():
            pytest.exit(f"{self.path} is not built; run cargo xtask test, or set ISODREAM", returncode=1)

    def __call__(self, *args: object) -> str:
        """What it prints."""
        done = self._run(*args)
        assert done.returncode == 0, f"{args}: {done.stderr}"
        return done.stdout

    def json(self, *args: object) -> Any:
        """What it prints with --json."""
        return json.loads(self(*args, "--json"))

    def refused(self, *args: object) -> str:
        """Why it fails."""
        done = self._run(*args)
        assert done.returncode != 0, f"{args} was taken"
        return done.stderr

    def _run(self, *args: object) -> subprocess.CompletedProcess[str]:
        line = [str(self.path), *map(str, args)]
        return subprocess.run(line, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=240)


@pytest.fixture(scope="session")
def isodream() -> Isodream:
    return Isodream()
