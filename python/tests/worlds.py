"""Environments of the tests, small enough to know every row of."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from isodream import Row, Spec


class World:
    """Shows noise that depends on everything so far, and remembers pictures and actions."""

    def __init__(self, *, action_dim: int = 2, time_limit: int = 12) -> None:
        self.spec = Spec("test/world", action_dim, time_limit)
        self.images: list[NDArray[np.uint8]] = []
        self.actions: list[NDArray[np.float32]] = []

    def reset(self, seed: int) -> Row:
        self.rng = np.random.default_rng(seed)
        self.steps = 0
        return Row(self._picture())

    def step(self, action: NDArray[np.float32]) -> Row:
        self.steps += 1
        self.actions.append(action)
        is_last = self.steps == self.spec.time_limit
        return Row(self._picture(), float(action.sum()), is_last, end_reason="time_limit" if is_last else "")

    def close(self) -> None:
        pass

    def _picture(self) -> NDArray[np.uint8]:
        self.images.append(self.rng.integers(0, 256, (64, 64, 3), np.uint8))
        return self.images[-1]


class Hanging(World):
    """Never comes back from a step."""

    def step(self, action: NDArray[np.float32]) -> Row:
        print("hangs", flush=True)
        threading.Event().wait()
        return super().step(action)
