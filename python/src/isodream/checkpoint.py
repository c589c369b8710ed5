"""Checkpoints as the learner writes them: a folder with weights, configuration and a manifest of hashes."""

import hashlib
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

MANIFEST = "manifest.json"
FORMAT = 1


class CheckpointError(Exception):
    """A checkpoint that is missing, damaged or of another format."""


@dataclass(frozen=True)
class Checkpoint:
    """The part of a checkpoint that acting needs."""

    updates: int
    """Training steps made."""
    env_frames: int
    """Environment frames seen."""
    config: dict[str, Any]
    """The resolved configuration."""
    weights: dict[str, NDArray[np.float32]]
    """Parameters by their place in the model, in PyTorch's layouts."""

    @classmethod
    def load(cls, path: str | Path) -> "Checkpoint":
        """The newest checkpoint of a run directory or of a folder of checkpoints, or that of a checkpoint folder.

        Raises:
            CheckpointError: if there is none, naming the file where it is damaged or of another format.
        """
        folder = _find(Path(path))
        try:
            manifest = json.loads((folder / MANIFEST).read_bytes())
            if manifest["format"] != FORMAT:
                raise CheckpointError(f"{folder} has format {manifest['format']}, this package reads format {FORMAT}")
            files = {}
            for name in ("model.safetensors", "config.toml"):
                files[name] = (folder / name).read_bytes()
                if hashlib.sha256(files[name]).hexdigest() != manifest["files"][name]["sha256"]:
                    raise CheckpointError(f"{folder / name} is damaged: its hash is not the manifest's; give another")
            counters = manifest["counters"]
            config = tomllib.loads(files["config.toml"].decode())
            weights = safetensors.numpy.load(files["model.safetensors"])
            return cls(counters["updates"], counters["env_frames"], config, weights)
        except (OSError, ValueError, KeyError) as error:
            raise CheckpointError(f"{folder} cannot be read: {error!r}; give another checkpoint") from error


def _find(path: Path) -> Path:
    found = [path, *sorted(path.glob("[0-9]*")), *sorted(path.glob("checkpoints/[0-9]*"))]
    sound = [folder for folder in found if (folder / MANIFEST).exists()]
    if not sound:
        raise CheckpointError(
            f"no checkpoint in {path} or {path / 'checkpoints'}; give a run directory or a checkpoint"
        )
    return sound[-1]
