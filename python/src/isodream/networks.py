"""The networks that acting needs (`crates/model`): encoder, latent dynamics, gate, attention and actor.

Equation numbers are those of the Iso-Dream++ paper. Everything is `float32`; N counts environments.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float32]
KERNEL = 4


class Weights:
    """Parameters below one place in the model."""

    def __init__(self, tensors: Mapping[str, Array], place: str = "") -> None:
        self._tensors, self._place = tensors, place

    def at(self, place: str) -> "Weights":
        """Those below `place`."""
        return Weights(self._tensors, f"{self._place}{place}.")

    def __getitem__(self, name: str) -> Array:
        return self._tensors[self._place + name]

    def linear(self, layer: str, x: Array) -> Array:
        """`x W^T + b`: [.., in] -> [.., out]."""
        y: Array = x @ self[f"{layer}.weight"].T + self[f"{layer}.bias"]
        return y

    def conv(self, layer: str, x: Array, planes: Array | None = None) -> Array:
        """ELU of a 4x4 convolution of stride 2: [N, H, W, in] -> [N, (H - 4) / 2 + 1, (W - 4) / 2 + 1, out].

        `planes` [N, A] are constant channels after those of `x`: one of value a adds a times the sum of its kernel.
        """
        weight, channels = self[f"{layer}.weight"], x.shape[-1]
        windows = sliding_window_view(x, (KERNEL, KERNEL), axis=(1, 2))[:, ::2, ::2]
        kernel = weight[:, :channels].reshape(len(weight), -1)
        y = windows.reshape(*windows.shape[:3], -1) @ kernel.T + self[f"{layer}.bias"]
        if planes is not None:
            y += (planes @ weight[:, channels:].sum((2, 3)).T)[:, None, None]
        return elu(y)


def elu(x: Array) -> Array:
    """`x` where it is positive, else `exp(x) - 1`."""
    return np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))


def sigmoid(x: Array) -> Array:
    """In the form that cannot overflow."""
    y: Array = 0.5 * np.tanh(0.5 * x) + 0.5
    return y


def width(raw: Array, least: float) -> Array:
    """The standard deviation that a network's output stands for."""
    return 2.0 * sigmoid(raw / 2.0) + np.float32(least)


def join(*parts: Array) -> Array:
    """Side by side: [N, a], [N, b] -> [N, a + b]."""
    return np.concatenate(parts, -1)


class Latent(NamedTuple):
    """One branch's memory."""

    stoch: Array
    """A sample of `s_t` or `z_t`: [N, stoch]."""
    deter: Array
    """`h_t` or `h'_t`: [N, deter]."""


class Branch:
    """The recurrent state-space model of one branch (Eq. 3)."""

    def __init__(self, weights: Weights, min_std: float) -> None:
        self._weights, self._min_std = weights, min_std

    def initial(self, count: int) -> Latent:
        """Zeros, before the first step of `count` episodes."""
        stoch, deter = (len(self._weights[name]) for name in ("posterior_stats.bias", "gru.norm.bias"))
        return Latent(np.zeros((count, stoch // 2), np.float32), np.zeros((count, deter // 3), np.float32))

    def transition(self, stoch: Array, action: Array, deter: Array) -> Array:
        """`h_t = GRU(h_{t-1}, [s_{t-1}, a_{t-1}])`, a GRU whose joint pre-activations pass a LayerNorm."""
        x = elu(self._weights.linear("input", join(stoch, action)))
        joint = self._weights.linear("gru.joint", join(x, deter))
        joint -= joint.mean(-1, keepdims=True)
        joint /= np.sqrt((joint * joint).mean(-1, keepdims=True) + np.float32(1e-5))
        joint = joint * self._weights["gru.norm.weight"] + self._weights["gru.norm.bias"]
        reset, candidate, update = np.split(joint, 3, -1)
        change: Array = sigmoid(update - 1.0) * (np.tanh(sigmoid(reset) * candidate) - deter)
        return deter + change

    def prior(self, deter: Array, rng: np.random.Generator) -> Array:
        """A sample of `p(s_t | h_t)`."""
        return self._sample("prior", deter, rng)

    def posterior(self, deter: Array, embed: Array, rng: np.random.Generator) -> Array:
        """A sample of `q(s_t | h_t, o_t)`."""
        return self._sample("posterior", join(deter, embed), rng)

    def _sample(self, head: str, x: Array, rng: np.random.Generator) -> Array:
        stats = self._weights.linear(f"{head}_stats", elu(self._weights.linear(head, x)))
        mean, raw = np.split(stats, 2, -1)
        return mean + width(raw, self._min_std) * rng.standard_normal(mean.shape, np.float32)


class Networks:
    """Everything between a picture and an action."""

    def __init__(self, tensors: Mapping[str, Array], config: Mapping[str, Any]) -> None:
        model, self.window = config["model"], config["behavior"]["rollout_window"]
        self.side = 64 if "world_model.encoder.stem.conv1.weight" in tensors else 32
        """Rows and columns of a picture: the smaller ones need a layer less."""
        weights = Weights(tensors)
        self._encoder, self._encoder_actions = weights.at("world_model.encoder"), model["encoder_actions"]
        # Checkpoints from before there was a choice see the newest picture alone.
        self.frames = model.get("encoder_frames", 1)
        """Pictures that the encoder sees at once: the newest, and those right before it."""
        rssm = weights.at("world_model.rssm")
        self.controllable = Branch(rssm.at("controllable"), model["min_std"])
        self.noncontrollable = Branch(rssm.at("noncontrollable"), model["min_std"])
        self._gate = rssm.at("dependency") if model["dependency_gate"] else None
        self.looks_ahead = model["indicator"] and self.window > 0
        # Checkpoints from before there was a choice do not name it.
        attends = model.get("future", "attention") == "attention"
        self._attention = weights.at("attention") if attends else None
        self._actor, self._actor_layers = weights.at("actor"), model["actor_layers"]
        self._policy_min_std = model["policy_min_std"]
        self.action_dim = len(self._actor["out.bias"]) // 2

    def observe(
        self, s: Latent, z: Latent, executed: Array, images: Array, rng: np.random.Generator
    ) -> tuple[Latent, Latent]:
        """Posterior samples of both branches after `executed` [N, A] led to `images` [N, side, side, 3 frames]."""
        stem = self._encoder.conv("stem.conv0", images)
        if self.side == 64:
            stem = self._encoder.conv("stem.conv1", stem)
        s_deter = self.controllable.transition(s.stoch, executed, s.deter)
        z_deter = self._free_transition(self._gated(s, z), z.deter)
        s_stoch = self.controllable.posterior(s_deter, self._embed("controllable", stem, executed), rng)
        z_stoch = self.noncontrollable.posterior(z_deter, self._embed("noncontrollable", stem, executed), rng)
        return Latent(s_stoch, s_deter), Latent(z_stoch, z_deter)

    def look_ahead(self, s: Latent, z: Latent, rng: np.random.Generator) -> Array:
        """`[z_t, .., z_{t+tau-1}]` with their recurrent states: [N, tau, feat].

        The first transition passes the gate, the others are the noncontrollable branch's own.
        """
        latent = Latent(self._gated(s, z), z.deter)
        memory, stoch = [join(*latent)], latent.stoch
        while len(memory) < self.window:
            deter = self._free_transition(stoch, latent.deter)
            latent = Latent(self.noncontrollable.prior(deter, rng), deter)
            memory.append(join(*latent))
            stoch = self._merged(latent.stoch, np.zeros_like(latent.stoch))
        return np.stack(memory, 1)

    def foreseeing(self, feat: Array, memory: Array) -> Array:
        """`e_t`: what `memory` [N, tau, feat] holds for `feat` [N, feat] (Eq. 13), or both side by side."""
        if self._attention is None:
            return join(feat, memory.reshape(len(memory), -1))
        query = self._attention.linear("query", feat)
        key, value = self._attention.linear("key", memory), self._attention.linear("value", memory)
        scores: Array = (key @ query[:, :, None])[:, :, 0] / np.float32(np.sqrt(query.shape[-1]))
        weights = np.exp(scores - scores.max(-1, keepdims=True))
        weights /= weights.sum(-1, keepdims=True)
        return self._attention.linear("out", (weights[:, None] @ value)[:, 0]) + feat

    def act(self, feat: Array) -> tuple[Array, Array]:
        """Mean, which is the mode, and width of the action's truncated Gaussian, [N, A] each (Eq. 14)."""
        for index in range(self._actor_layers):
            feat = elu(self._actor.linear(f"layer{index}", feat))
        mean, raw = np.split(self._actor.linear("out", feat), 2, -1)
        return np.tanh(mean), width(raw, self._policy_min_std)

    def _embed(self, branch: str, stem: Array, executed: Array) -> Array:
        planes = executed if self._encoder_actions else None
        x = self._encoder.conv(f"{branch}.conv3", self._encoder.conv(f"{branch}.conv2", stem, planes))
        return x.transpose(0, 3, 1, 2).reshape(len(x), -1)

    def _gated(self, s: Latent, z: Latent) -> Array:
        """What enters the noncontrollable transition: `z`, merged with `w s` if there is a gate (Eq. 11, 12)."""
        if self._gate is None:
            return z.stoch
        return self._merged(z.stoch, s.stoch * (sigmoid(self._gate.linear("gate", join(z.deter, s.deter))) >= 0.5))

    def _merged(self, z: Array, s: Array) -> Array:
        return z if self._gate is None else self._gate.linear("merge", join(z, s))

    def _free_transition(self, gated: Array, deter: Array) -> Array:
        """`h'_{t+1}`: one noncontrollable transition with zero action."""
        return self.noncontrollable.transition(gated, np.zeros((len(gated), self.action_dim), np.float32), deter)
