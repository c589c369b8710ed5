"""The contract between Isodream's agents and worlds in Python."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Spec:
    """What an environment shows and takes."""

    id: str
    """Stable name; experience of environments with different specs is never mixed."""
    action_dim: int
    """Dimensions of the action, each in [-1, 1]."""
    time_limit: int
    """Agent steps after which an episode is cut."""
    height: int = 64
    width: int = 64
    channels: int = 3
    action_repeat: int = 1
    """Simulator frames per agent step."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "id" and value < 1:
                raise ValueError(f"{self.id}: {name} is {value}, must be at least 1")


@dataclass(frozen=True)
class Row:
    """What a reset or a step returns."""

    image: NDArray[np.uint8]
    """[height, width, channels]."""
    reward: float = 0.0
    """Received on arriving here; 0 for a reset."""
    is_last: bool = False
    """Whether the episode ends here."""
    is_terminal: bool = False
    """Whether it ended for a reason inside the world, not for a time limit: what follows is worth nothing."""
    end_reason: str = ""
    """Empty while the episode runs."""
    metrics: Mapping[str, float] = field(default_factory=dict)
    """Named measurements of the episode so far."""
    interaction: bool = False
    """Ground truth of the dependency gate, where the world knows it: the agent made somebody else react."""
    segmentation: NDArray[np.uint8] | None = None
    """[height, width]: 0 background, 1 road, 2 vehicle, where the world knows it."""


class Environment(Protocol):
    """A world that takes actions and shows images.

    The same seed followed by the same actions gives the same rows. All calls come from the thread, or the
    process, that made the environment. An exception is reported to the client, which then resets.
    """

    @property
    def spec(self) -> Spec:
        """The same for as long as the environment lives."""
        ...

    def reset(self, seed: int) -> Row:
        """Starts a new episode; `seed` is in [0, 2**64)."""
        ...

    def step(self, action: NDArray[np.float32]) -> Row:
        """Repeats `action` [action_dim], each component in [-1, 1], for `action_repeat` simulator frames."""
        ...

    def close(self) -> None:
        """Gives back what the environment holds."""
        ...


class EnvError(Exception):
    """An environment that cannot be used, or a command that it cannot carry out."""


class Guarded:
    """An environment whose commands and pictures are checked; after an error it has to be reset.

    Rewards and flags are checked by the client.
    """

    def __init__(self, env: Environment) -> None:
        self.env = env
        self.spec = env.spec
        self._refusal = "environment was stepped before its first reset"

    def reset(self, seed: int) -> Row:
        """Starts a new episode."""
        self._refusal = "the last reset failed, reset the environment before the next step"
        return self._checked(self.env.reset(seed))

    def step(self, action: NDArray[np.float32]) -> Row:
        """Takes one agent step."""
        if self._refusal:
            raise EnvError(self._refusal)
        if action.shape != (self.spec.action_dim,):
            raise EnvError(f"action has {action.size} dimensions, expected {self.spec.action_dim}")
        if not np.isfinite(action).all():
            raise EnvError(f"action is {action}, must be finite")
        self._refusal = "the last step failed, reset the environment before the next step"
        return self._checked(self.env.step(action.clip(-1.0, 1.0)))

    def _checked(self, row: Row) -> Row:
        spec = self.spec
        self._require("the image", row.image, (spec.height, spec.width, spec.channels))
        if row.segmentation is not None:
            self._require("the segmentation", row.segmentation, (spec.height, spec.width))
        self._refusal = "episode is over, reset the environment before the next step" if row.is_last else ""
        return row

    def _require(self, name: str, value: Any, shape: tuple[int, ...]) -> None:
        found = np.asarray(value)
        if found.dtype != np.uint8 or found.shape != shape:
            raise EnvError(f"{self.spec.id}: {name} is {found.dtype} {list(found.shape)}, must be uint8 {list(shape)}")
