"""A trained policy, evaluated as `isodream eval` does."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from isodream.checkpoint import Checkpoint
from isodream.networks import Latent, Networks, join


class Policy:
    """A policy with its memory over a number of environments.

    Latent states are samples also where actions are modes, as in the paper's experiments; `seed` makes them repeatable.

    ```python
    policy = isodream.Policy.load("runs/demo")
    policy.reset(1)
    action = policy.act(image[None])[0]
    ```
    """

    def __init__(self, checkpoint: Checkpoint, seed: int = 0) -> None:
        """A policy over the weights of `checkpoint`."""
        self.checkpoint = checkpoint
        """Counters and configuration."""
        self.networks = Networks(checkpoint.weights, checkpoint.config)
        self.rng = np.random.default_rng(seed)
        self.reset(0)

    @classmethod
    def load(cls, path: str | Path, *, seed: int = 0) -> "Policy":
        """The newest policy of a run directory, or that of a checkpoint folder.

        Raises:
            CheckpointError: if there is no sound checkpoint.
        """
        return cls(Checkpoint.load(path), seed)

    @property
    def action_dim(self) -> int:
        """Dimensions of an action."""
        return self.networks.action_dim

    def reset(self, count: int) -> None:
        """Begins episodes of `count` environments."""
        self._s = self.networks.controllable.initial(count)
        self._z = self.networks.noncontrollable.initial(count)
        self._executed = np.zeros((count, self.action_dim), np.float32)
        side = self.networks.side
        self._seen = np.zeros((count, side, side, 3 * self.networks.frames), np.float32)

    def act(
        self,
        images: NDArray[np.uint8],
        is_first: NDArray[np.bool_] | None = None,
        *,
        deterministic: bool = True,
    ) -> NDArray[np.float32]:
        """One action for each environment, which must then be executed (Alg. 1, lines 21-24).

        Args:
            images: Bytes [N, side, side, 3] as the environments were trained on.
            is_first: Which of the environments were just reset, [N]; none by default.
            deterministic: Whether to take the most likely action, as in evaluation, or to draw one, as in collecting.

        Returns:
            Actions [N, A], each component in [-1, 1].

        Raises:
            ValueError: if the pictures are not what the policy was trained on.
        """
        count = len(self._executed)
        shape = (count, self.networks.side, self.networks.side, 3)
        if images.shape != shape or images.dtype != np.uint8:
            raise ValueError(
                f"images are {images.dtype} {list(images.shape)}, must be uint8 {list(shape)}; "
                "call reset(N) for another number of environments"
            )
        if is_first is not None:
            keep = 1.0 - np.asarray(is_first, np.float32).reshape(count, 1)
            self._s, self._z = (Latent(*(part * keep for part in latent)) for latent in (self._s, self._z))
            self._executed = self._executed * keep
            self._seen = self._seen * keep[:, :, None, None]
        networks = self.networks
        pictures = images.astype(np.float32) / 255.0 - 0.5
        self._seen = join(pictures, self._seen[..., :-3])
        self._s, self._z = networks.observe(self._s, self._z, self._executed, self._seen, self.rng)
        feat = join(*self._s)
        if networks.looks_ahead:
            feat = networks.foreseeing(feat, networks.look_ahead(self._s, self._z, self.rng))
        mode, std = networks.act(feat)
        self._executed = mode if deterministic else self._draw(mode, std)
        return self._executed.copy()

    def _draw(self, mean: NDArray[np.float32], std: NDArray[np.float32]) -> NDArray[np.float32]:
        """A sample of the Gaussian truncated to [-1, 1]."""
        action = np.full_like(mean, np.inf)
        while (outside := np.abs(action) > 1.0).any():
            drawn = mean + std * self.rng.standard_normal(mean.shape, np.float32)
            action = np.where(outside, drawn, action)
        return action
