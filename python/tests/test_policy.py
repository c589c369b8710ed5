"""The same actions as the binary's, on the same pictures and with the same noise."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from conftest import Isodream
from libtorch import LibtorchRandom, derive_seed, parameters_drawn
from numpy.typing import NDArray
from worlds import World

from isodream import Policy, Server
from isodream.checkpoint import Checkpoint, CheckpointError

SEED = 7
DEBUG: dict[str, Any] = {
    "cnn_depth": 4,
    "deter": 16,
    "stoch": 8,
    "hidden": 16,
    "units": 16,
    "actor_layers": 2,
    "attention_dim": 16,
}
DEBUG |= {"indicator": True, "dependency_gate": True, "encoder_actions": True, "future": "attention", "min_std": 0.1}
DEBUG |= {"policy_min_std": 0.1, "encoder_frames": 1}


def shapes(model: dict[str, Any], window: int, action_dim: int) -> dict[str, tuple[int, ...]]:
    """Parameters that acting needs, in the order in which the binary makes them."""
    depth, deter, stoch, hidden = (model[key] for key in ("cnn_depth", "deter", "stoch", "hidden"))
    planes = action_dim if model["encoder_actions"] else 0
    found: dict[str, tuple[int, ...]] = {}

    def linear(name: str, inputs: int, outputs: int) -> None:
        found[f"{name}.weight"], found[f"{name}.bias"] = (outputs, inputs), (outputs,)

    def conv(name: str, inputs: int, outputs: int) -> None:
        found[f"{name}.weight"], found[f"{name}.bias"] = (outputs, inputs, 4, 4), (outputs,)

    encoder = "world_model.encoder"
    conv(f"{encoder}.stem.conv0", 3 * model["encoder_frames"], depth)
    conv(f"{encoder}.stem.conv1", depth, 2 * depth)
    for branch in ("controllable", "noncontrollable"):
        conv(f"{encoder}.{branch}.conv2", 2 * depth + planes, 4 * depth)
        conv(f"{encoder}.{branch}.conv3", 4 * depth, 8 * depth)
    for branch in ("controllable", "noncontrollable"):
        place = f"world_model.rssm.{branch}"
        linear(f"{place}.input", stoch + action_dim, hidden)
        linear(f"{place}.gru.joint", hidden + deter, 3 * deter)
        found[f"{place}.gru.norm.weight"] = found[f"{place}.gru.norm.bias"] = (3 * deter,)
        linear(f"{place}.prior", deter, hidden)
        linear(f"{place}.prior_stats", hidden, 2 * stoch)
        linear(f"{place}.posterior", deter + 32 * depth, hidden)
        linear(f"{place}.posterior_stats", hidden, 2 * stoch)
    if model["dependency_gate"]:
        linear("world_model.rssm.dependency.gate", 2 * deter, 1)
        linear("world_model.rssm.dependency.merge", 2 * stoch, stoch)
    looks_ahead, width = model["indicator"] and window > 0, stoch + deter
    if looks_ahead and model["future"] == "attention":
        for name in ("query", "key", "value"):
            linear(f"attention.{name}", stoch + deter, model["attention_dim"])
        linear("attention.out", model["attention_dim"], stoch + deter)
    elif looks_ahead:
        width *= 1 + window
    for layer in range(model["actor_layers"]):
        linear(f"actor.layer{layer}", width, model["units"])
        width = model["units"]
    linear("actor.out", width, 2 * action_dim)
    return found


def weights(model: dict[str, Any], window: int, action_dim: int) -> dict[str, NDArray[np.float32]]:
    rng = np.random.default_rng(SEED)
    return {
        name: (rng.uniform(-1.5, 1.5, shape) / np.sqrt(np.prod(shape[1:]))).astype(np.float32)
        for name, shape in shapes(model, window, action_dim).items()
    }


def write(folder: Path, address: str, model: dict[str, Any], window: int, action_dim: int) -> None:
    """A checkpoint with random weights."""
    lines = [
        f"seed = {SEED}",
        f'[env]\nid = "grpc://{address}"\naction_repeat = 1\ntime_limit = 100',
        "[model]",
        *(f"{key} = {json.dumps(value)}" for key, value in model.items()),
        f"[behavior]\nrollout_window = {window}",
    ]
    folder.mkdir(parents=True)
    files = {
        "model.safetensors": safetensors.numpy.save(weights(model, window, action_dim)),
        "optimizer.safetensors": b"",
        "config.toml": "\n".join(lines).encode(),
    }
    entries = {}
    for name, content in files.items():
        (folder / name).write_bytes(content)
        entries[name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    counters = {"updates": 3, "sampled_steps": {}, "env_frames": 5}
    manifest = {"format": 1, "counters": counters, "env_spec": "", "model_hash": "", "files": entries}
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("changes", "window", "action_dim"),
    [
        ({}, 3, 2),
        ({"dependency_gate": False}, 2, 3),
        ({"encoder_actions": False, "min_std": 0.5}, 1, 1),
        ({"indicator": False}, 3, 2),
        ({}, 0, 2),
        ({"future": "concatenation"}, 3, 2),
        ({"encoder_frames": 3}, 3, 2),
        ({"cnn_depth": 32, "deter": 200, "stoch": 50, "hidden": 200, "units": 400, "actor_layers": 4}, 5, 2),
    ],
)
def test_actions_are_those_of_the_binary(
    isodream: Isodream, tmp_path: Path, changes: dict[str, Any], window: int, action_dim: int
) -> None:
    model = {**DEBUG, **changes}
    world = World(action_dim=action_dim)
    with Server(lambda: world) as server:
        folder = tmp_path / "checkpoint"
        write(folder, server.address, model, window, action_dim)
        isodream("eval", "--checkpoint", folder, "--episodes", 1)
    steps = world.spec.time_limit
    policy = Policy.load(folder)
    noise = LibtorchRandom(derive_seed(SEED, "eval", "noise"))
    noise.skip(parameters_drawn(policy.checkpoint.weights))
    policy.rng = noise  # type: ignore[assignment]
    policy.reset(1)
    ours = np.concatenate([policy.act(image[None]) for image in world.images[:steps]])
    theirs = np.stack(world.actions[:steps])
    assert np.abs(theirs).max() > 0.05
    assert np.ptp(theirs, axis=0).max() > 0.01
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


class NoNoise:
    """Samples are means."""

    def standard_normal(self, shape: tuple[int, ...], dtype: type[np.float32]) -> NDArray[np.float32]:
        return np.zeros(shape, dtype)


def policy_of(count: int, *, seed: int = 0, **changes: Any) -> Policy:
    model = {**DEBUG, **changes}
    checkpoint = Checkpoint(0, 0, {"model": model, "behavior": {"rollout_window": 3}}, weights(model, 3, 2))
    policy = Policy(checkpoint, seed)
    policy.reset(count)
    return policy


def test_environments_of_a_batch_are_apart_and_begin_anew_alone() -> None:
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (4, 3, 64, 64, 3), np.uint8)
    batch = policy_of(3, encoder_frames=2)
    batch.rng = NoNoise()  # type: ignore[assignment]
    is_first = np.array([[True] * 3, [False] * 3, [False, True, False], [False] * 3])
    actions = np.stack([batch.act(seen, first) for seen, first in zip(images, is_first, strict=True)])
    for index in range(3):
        alone = policy_of(1, encoder_frames=2)
        alone.rng = NoNoise()  # type: ignore[assignment]
        for step in range(4):
            if is_first[step, index]:
                alone.reset(1)
            action = alone.act(images[step, index][None])[0]
            np.testing.assert_allclose(action, actions[step, index], atol=1e-5)
    assert np.abs(actions[3, 0] - actions[3, 1]).max() > 1e-3


def test_a_seed_repeats_what_is_drawn() -> None:
    image = np.full((64, 64, 64, 3), 90, np.uint8)
    first, again, other = (policy_of(64, seed=seed).act(image, deterministic=False) for seed in (1, 1, 2))
    assert first.dtype == np.float32
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert np.abs(first).max() <= 1.0
    mode = policy_of(64, seed=1).act(image)
    assert first.std(0).min() > 2.0 * mode.std(0).max(), "actions vary more than the latents make them"


def test_other_pictures_are_refused() -> None:
    images: Any
    for images in (np.zeros((1, 64, 64, 3), np.float32), np.zeros((1, 32, 32, 3), np.uint8)):
        with pytest.raises(ValueError, match=r"must be uint8 \[1, 64, 64, 3\]"):
            policy_of(1).act(images)
    with pytest.raises(ValueError, match=r"call reset\(N\)"):
        policy_of(2).act(np.zeros((1, 64, 64, 3), np.uint8))


def test_the_newest_checkpoint_is_found_and_damage_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint in .*give a run directory"):
        Policy.load(tmp_path)
    for updates in (9, 10):
        write(tmp_path / f"checkpoints/{updates:08}", "x:1", {**DEBUG, "units": updates}, 3, 2)
    newest = tmp_path / "checkpoints/00000010"
    for path in (tmp_path, tmp_path / "checkpoints", newest):
        assert Policy.load(path).checkpoint.config["model"]["units"] == 10
    assert Policy.load(tmp_path / "checkpoints/00000009").checkpoint.config["model"]["units"] == 9
    manifest = json.loads((newest / "manifest.json").read_text())
    (newest / "manifest.json").write_text(json.dumps({**manifest, "format": 2}))
    with pytest.raises(CheckpointError, match="has format 2, this package reads format 1"):
        Policy.load(tmp_path)
    (newest / "manifest.json").write_text(json.dumps(manifest))
    (newest / "model.safetensors").write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match=r"model\.safetensors is damaged"):
        Policy.load(tmp_path)
