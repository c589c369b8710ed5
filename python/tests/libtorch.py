"""The random numbers of libtorch on a CPU, so that a policy in Python can meet the fate of the binary's.

From aten/src/ATen/core/MT19937RNGEngine.h, DistributionsHelper.h and native/cpu/DistributionTemplates.h of PyTorch.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

PARTS, BRANCHES = ("encoder", "rssm"), ("controllable", "noncontrollable")


class LibtorchRandom:
    """A generator as after `torch.manual_seed(seed)`."""

    def __init__(self, seed: int) -> None:
        self._words = np.random.RandomState(seed % 2**32)
        self._spare: float | None = None

    def skip(self, count: int) -> None:
        """`torch.rand(count)`."""
        self._draw(count)

    def standard_normal(self, shape: tuple[int, ...], dtype: type[np.float32]) -> NDArray[np.float32]:
        """`torch.randn(shape)`."""
        size = int(np.prod(shape))
        if size < 16:
            return np.array([self._one() for _ in range(size)], dtype).reshape(shape)
        numbers = self._uniform(size)
        for start in range(0, size - 15, 16):
            numbers[start : start + 16] = self._sixteen(numbers[start : start + 16])
        if size % 16:
            numbers[-16:] = self._sixteen(self._uniform(16))
        return numbers.reshape(shape)

    def _draw(self, count: int) -> NDArray[np.uint64]:
        return self._words.randint(0, 2**32, count, np.uint32).astype(np.uint64)

    def _uniform(self, count: int) -> NDArray[np.float32]:
        return ((self._draw(count) & (2**24 - 1)) / 2.0**24).astype(np.float32)

    @staticmethod
    def _sixteen(uniform: NDArray[np.float32]) -> NDArray[np.float32]:
        radius = np.sqrt(-2.0 * np.log(1.0 - uniform[:8]))
        angle = np.float32(2.0 * np.pi) * uniform[8:]
        return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])

    def _one(self) -> float:
        if self._spare is not None:
            number, self._spare = self._spare, None
            return number
        high1, low1, high2, low2 = (int(word) for word in self._draw(4))
        u1, u2 = (((high << 32 | low) & (2**53 - 1)) / 2.0**53 for high, low in ((high1, low1), (high2, low2)))
        radius, angle = np.sqrt(-2.0 * np.log1p(-u2)), 2.0 * np.pi * u1
        self._spare = float(radius * np.sin(angle))
        return float(radius * np.cos(angle))


def derive_seed(root: int, *path: str) -> int:
    """`derive_seed` of `crates/core`."""
    text = root.to_bytes(8, "little")
    for name in path:
        text += len(name).to_bytes(8, "little") + name.encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:8], "little")


def parameters_drawn(weights: Mapping[str, NDArray[np.float32]]) -> int:
    """How many random numbers the binary draws for an acting model before it loads these weights into it."""
    acting = ("world_model.encoder.stem", *(f"world_model.{part}.{branch}" for part in PARTS for branch in BRANCHES))
    acting += ("world_model.rssm.dependency", "attention", "actor")
    names = [name for name in weights if name.startswith(acting) and ".norm." not in name]
    return sum(weights[name].size for name in names)
