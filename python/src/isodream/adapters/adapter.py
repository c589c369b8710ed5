"""What all adapters share: action repeat, time limit and pictures of the size that is asked for."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from isodream.environment import EnvError, Row, Spec


@dataclass(frozen=True)
class Actions:
    """How an action in [-1, 1] becomes one of the environment."""

    dim: int
    native: Callable[[NDArray[np.float32]], Any]
    """[dim] -> whatever the environment's step takes."""

    @classmethod
    def scaled(cls, low: NDArray[Any], high: NDArray[Any], dtype: Any) -> "Actions":
        """Each component from [-1, 1] to its range, in row-major order.

        Raises:
            EnvError: if a range is infinite.
        """
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise EnvError(
                "the actions have no finite range to scale [-1, 1] to; give them one, "
                "for example with gymnasium.wrappers.RescaleAction or dm_control's action_scale"
            )
        centre, half = (low + high) / 2.0, (high - low) / 2.0

        def native(action: NDArray[np.float32]) -> Any:
            return (centre + half * action.reshape(low.shape)).clip(low, high).astype(dtype)

        return cls(low.size, native)

    @classmethod
    def choice(cls, count: int, start: int = 0) -> "Actions":
        """One of `count` numbers from `start`: that of the greatest component, the first one of several."""
        return cls(count, lambda action: start + int(action.argmax()))


@dataclass(frozen=True)
class Frame:
    """What one simulator frame led to."""

    observation: Any
    reward: float
    is_terminal: bool
    is_truncated: bool
    metrics: Mapping[str, float] = field(default_factory=dict)


class Adapter(ABC):
    """An environment of another interface as an `isodream.Environment`."""

    def __init__(self, spec: Spec, actions: Actions) -> None:
        self.spec = spec
        self._actions = actions
        self._steps = 0

    def reset(self, seed: int) -> Row:
        """Starts a new episode."""
        self._steps = 0
        return Row(self._image(self._begin(seed)))

    def step(self, action: NDArray[np.float32]) -> Row:
        """Repeats `action`, sums the rewards, and ends the episode at the time limit."""
        native, reward = self._actions.native(action), 0.0
        for _ in range(self.spec.action_repeat):
            frame = self._advance(native)
            reward += frame.reward
            if frame.is_terminal or frame.is_truncated:
                break
        self._steps += 1
        is_last = frame.is_terminal or frame.is_truncated or self._steps >= self.spec.time_limit
        return Row(
            self._image(frame.observation),
            reward,
            is_last,
            frame.is_terminal,
            "ended" if frame.is_terminal else "time_limit" if is_last else "",
            frame.metrics,
        )

    def _image(self, observation: Any) -> NDArray[np.uint8]:
        """The picture of `observation` in RGB: every pixel is the mean of the area that it covers."""
        picture = np.asarray(self._picture(observation))
        if picture.ndim == 3 and picture.shape[2] == 1:
            picture = picture[:, :, 0]
        if not is_picture(picture.dtype, picture.shape):
            raise EnvError(
                f"{self.spec.id}: the picture is {picture.dtype} {list(picture.shape)}, must be uint8 "
                "[height, width], [height, width, 1] or [height, width, 3]; name another one with pixels="
            )
        image = Image.fromarray(picture).convert("RGB")
        size = (self.spec.width, self.spec.height)
        return np.asarray(image if image.size == size else image.resize(size, Image.Resampling.BOX))

    @abstractmethod
    def _begin(self, seed: int) -> Any:
        """Starts an episode and returns its first observation."""

    @abstractmethod
    def _advance(self, action: Any) -> Frame:
        """Simulates one frame."""

    @abstractmethod
    def _picture(self, observation: Any) -> Any:
        """The picture that belongs to the newest `observation`."""

    @abstractmethod
    def close(self) -> None:
        """Gives back what the environment holds."""


def agent_steps(frames: int, action_repeat: int) -> int:
    """Agent steps in `frames`, the last of them perhaps a part of one. `Spec` refuses an `action_repeat` of 0."""
    return math.ceil(frames / max(action_repeat, 1))


def is_picture(dtype: Any, shape: tuple[int, ...]) -> bool:
    """Whether an array of this type and shape is a grey or an RGB picture."""
    return dtype == np.uint8 and (len(shape) == 2 or (len(shape) == 3 and shape[2] in (1, 3)))
