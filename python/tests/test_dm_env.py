"""dm_control's own tasks, as they are and as we serve them."""

from __future__ import annotations

import os
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")  # Not all machines have OpenGL.

import dm_env
import numpy as np
import pytest
from dm_control import suite
from dm_env import specs

from isodream import EnvError, from_dm_env


class Painted:
    """A task whose physics is rendered without OpenGL: the picture shows the joints' angles as grey bars."""

    def __init__(self, seed: int) -> None:
        self.env = suite.load("walker", "walk", task_kwargs={"random": seed})
        self.cameras: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    @property
    def physics(self) -> Painted:
        return self

    def render(self, height: int, width: int, camera_id: int | str) -> np.ndarray[Any, np.dtype[np.uint8]]:
        self.cameras.append(camera_id)
        angles = self.env.physics.data.qpos
        levels = (127.5 + 127.5 * np.tanh(angles)).astype(np.uint8)
        bars = levels[np.arange(width) * len(levels) // width]
        return np.broadcast_to(bars[None, :, None], (height, width, 3))


def test_a_task_of_dm_control() -> None:
    painted = Painted(0)
    env = from_dm_env(painted, action_repeat=2, camera="side")
    spec = env.spec
    assert (spec.id, spec.action_dim, spec.action_repeat, spec.time_limit) == ("dm_env/PlanarWalker", 6, 2, 500)
    first = env.reset(2**40 + 7)
    assert first.image.shape == (64, 64, 3)
    assert painted.cameras == ["side"]

    plain = suite.load("walker", "walk", task_kwargs={"random": 7})
    plain.reset()
    rng = np.random.default_rng(1)
    for step in range(1, 501):
        action = rng.uniform(-1, 1, 6).astype(np.float32)
        row = env.step(action)
        rewards = [plain.step(action).reward for _ in range(2)]
        assert row.reward == sum(rewards)
        assert row.is_last == (step == 500)
    assert (row.is_terminal, row.end_reason) == (False, "time_limit"), "its end has discount 1"
    assert np.array_equal(env.reset(7).image, first.image), "the same seed"
    assert not np.array_equal(env.reset(8).image, first.image)
    env.close()


class Catch(dm_env.Environment):  # type: ignore[misc]
    """Ends with `discount` after two steps; shows pictures, and takes no seed."""

    def __init__(self, discount: float = 0.0, action: specs.Array | None = None, *, picture: bool = True) -> None:
        self._discount, self._action = discount, action or specs.DiscreteArray(3)
        self._shape = (8, 8) if picture else (8,)
        self.taken: list[Any] = []

    def reset(self) -> dm_env.TimeStep:
        self.taken = []
        return dm_env.restart(self._seen())

    def step(self, action: Any) -> dm_env.TimeStep:
        self.taken.append(action)
        if len(self.taken) == 2:
            return dm_env.TimeStep(dm_env.StepType.LAST, 2.0, self._discount, self._seen())
        return dm_env.transition(1.0, self._seen())

    def observation_spec(self) -> specs.Array:
        return specs.Array(self._shape, np.uint8)

    def action_spec(self) -> specs.Array:
        return self._action

    def _seen(self) -> Any:
        return np.full(self._shape, 50 * len(self.taken), np.uint8)


@pytest.mark.parametrize(("discount", "reason"), [(0.0, "ended"), (1.0, "time_limit")])
def test_ends_choices_and_pictures(caplog: pytest.LogCaptureFixture, discount: float, reason: str) -> None:
    plain = Catch(discount)
    env = from_dm_env(plain, size=(16, 16))
    assert "dm_env/Catch takes no seed" in caplog.text
    assert (env.spec.action_dim, env.spec.time_limit) == (3, 1000)
    env.reset(1)
    row = env.step(np.array([0.1, 0.2, 0.2], np.float32))
    assert (row.reward, row.is_last, row.end_reason) == (1.0, False, "")
    assert row.image.shape == (16, 16, 3)
    assert (row.image == 50).all()
    row = env.step(np.array([0.1, 0.0, 0.2], np.float32))
    assert plain.taken == [1, 2]
    assert (row.reward, row.is_last, row.is_terminal, row.end_reason) == (2.0, True, reason == "ended", reason)


def test_bounded_actions_are_scaled() -> None:
    plain = Catch(action=specs.BoundedArray((2,), np.float64, [0.0, -3.0], [4.0, 3.0]))
    env = from_dm_env(plain, action_repeat=2)
    env.reset(1)
    assert env.step(np.array([0.5, -1.0], np.float32)).reward == 3.0
    assert np.array_equal(plain.taken, [[3.0, -3.0]] * 2)


def test_what_cannot_be_used_is_said() -> None:
    with pytest.raises(EnvError, match="dm_env/Catch has neither pictures"):
        from_dm_env(Catch(picture=False))
    with pytest.raises(EnvError, match="takes actions of"):
        from_dm_env(Catch(action=specs.Array((2,), np.float32)))
