"""Gymnasium's own environments, as they are and as we serve them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from isodream import EnvError, Row, from_gymnasium


def native(env_id: str, **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(env_id, render_mode="rgb_array", **options)


def floats(*values: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.array(values, np.float32)


def test_a_rendered_environment_with_a_range_of_actions() -> None:
    env = from_gymnasium(native("Pendulum-v1"), action_repeat=3, size=(50, 100))
    spec = env.spec
    assert (spec.id, spec.action_dim, spec.action_repeat) == ("gymnasium/Pendulum-v1", 1, 3)
    assert (spec.height, spec.width, spec.time_limit) == (50, 100, 67), "200 frames are 67 steps of three"
    first = env.reset(2**63 + 5)

    plain = native("Pendulum-v1")
    plain.reset(seed=5)
    # 500 x 500 pixels: each of ours is the mean of ten rows and five columns.
    means = np.asarray(plain.render()).reshape(50, 10, 100, 5, 3).mean((1, 3))
    assert first.image.shape == (50, 100, 3)
    assert np.abs(first.image - means).max() <= 1.0
    assert first == Row(first.image)

    rewards = [float(plain.step(np.array([-1.0], np.float32))[1]) for _ in range(3)]
    row = env.step(floats(-0.5))
    assert row.reward == pytest.approx(sum(rewards)), "-0.5 of [-1, 1] is a torque of -1 in [-2, 2]"
    assert not np.array_equal(row.image, first.image)
    for step in range(2, 68):
        row = env.step(floats(0.0))
        assert row.is_last == (step == 67)
    assert (row.is_terminal, row.end_reason) == (False, "time_limit"), "a truncation is no end of the world"
    assert np.array_equal(env.reset(5).image, first.image), "the same seed"
    assert not np.array_equal(env.reset(6).image, first.image)
    env.close()


def test_choices_and_ends() -> None:
    env = from_gymnasium(native("CartPole-v1"), env_id="mine", time_limit=20)
    assert (env.spec.id, env.spec.action_dim, env.spec.time_limit) == ("mine", 2, 20)
    env.reset(3)
    plain = native("CartPole-v1")
    plain.reset(seed=3)
    for _ in range(20):
        row = env.step(floats(-0.3, 0.2))
        _, reward, terminated, _, _ = plain.step(1)
        assert (row.reward, row.is_terminal) == (reward, terminated)
        if terminated:
            break
    assert (row.is_last, row.is_terminal, row.end_reason) == (True, True, "ended")
    env.reset(3)
    for step in range(1, 21):
        row = env.step(floats(1.0, 0.0) if step % 2 else floats(0.0, 1.0))
    assert (row.is_last, row.is_terminal, row.end_reason) == (True, False, "time_limit")


def test_pictures_that_are_observations() -> None:
    plain = gymnasium.make("CarRacing-v3")
    env = from_gymnasium(gymnasium.make("CarRacing-v3"), size=(48, 48), action_repeat=4)
    assert (env.spec.action_dim, env.spec.time_limit) == (3, 250)
    observation, _ = plain.reset(seed=1)
    means = observation.reshape(48, 2, 48, 2, 3).mean((1, 3))
    assert np.abs(env.reset(1).image - means).max() <= 1.0
    rewards = [plain.step(np.array([0.5, 0.5, 0.0], np.float32))[1] for _ in range(4)]
    assert env.step(floats(0.5, 0.0, -1.0)).reward == pytest.approx(sum(map(float, rewards)))


class Parts(gymnasium.Env[Any, Any]):
    """Grey pictures in a dictionary, and actions of any kind."""

    def __init__(self, action_space: spaces.Space[Any]) -> None:
        self.action_space = action_space
        picture = spaces.Box(0, 255, (64, 64, 1), np.uint8)
        self.observation_space = spaces.Dict({"speed": spaces.Box(-1.0, 1.0), "camera": picture, "rear": picture})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        return self.seen(0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken = action
        return self.seen(9), 1.0, False, False, {"speed_m_s": np.float32(2.5), "name": "road", "gear": 3}

    @staticmethod
    def seen(level: int) -> dict[str, Any]:
        grey = np.full((64, 64, 1), level, np.uint8)
        return {"speed": np.zeros(1), "camera": grey, "rear": grey + 100}


@pytest.mark.parametrize(
    ("space", "action", "taken"),
    [
        (spaces.Box(np.array([[-1.0, 0.0]]), np.array([[1.0, 10.0]]), dtype=np.float64), (0.5, 0.5), [[0.5, 7.5]]),
        (spaces.Discrete(3, start=-1), (0.1, 0.4, 0.4), 0),
        (spaces.MultiDiscrete([2, 3], start=np.array([0, 5])), (-1.0, 0.0, 0.1, 0.3, 0.2), [1, 6]),
        (spaces.MultiBinary(3), (-0.1, 0.0, 0.1), [0, 0, 1]),
    ],
)
def test_every_kind_of_action(space: spaces.Space[Any], action: tuple[float, ...], taken: Any) -> None:
    plain = Parts(space)
    env = from_gymnasium(plain, time_limit=5)
    assert (env.spec.id, env.spec.action_dim) == ("gymnasium/Parts", len(action))
    env.reset(1)
    row = env.step(floats(*action))
    assert np.array_equal(plain.taken, taken)
    assert space.contains(plain.taken)
    assert row.metrics == {"speed_m_s": 2.5, "gear": 3.0}
    assert (row.image == 9).all(), "the first picture of a dictionary"


def test_a_picture_can_be_named() -> None:
    env = from_gymnasium(Parts(spaces.Discrete(2)), time_limit=5, pixels="rear")
    assert (env.reset(1).image == 100).all()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: from_gymnasium(gymnasium.make("Pendulum-v1")), 'make it with render_mode="rgb_array"'),
        (lambda: from_gymnasium(Parts(spaces.Discrete(2))), "give time_limit=N"),
        (lambda: from_gymnasium(Parts(spaces.Box(-np.inf, np.inf, (2,))), time_limit=5), "RescaleAction"),
        (lambda: from_gymnasium(Parts(spaces.Text(3)), time_limit=5), "takes actions of Text"),
        (lambda: from_gymnasium(native("Pendulum-v1"), action_repeat=0), "action_repeat is 0, must be at least 1"),
        (lambda: from_gymnasium(Parts(spaces.Discrete(2)), time_limit=5, pixels="speed").reset(1), "name another one"),
    ],
)
def test_what_cannot_be_used_is_said(make: Any, words: str) -> None:
    with pytest.raises((EnvError, ValueError), match=words):
        make()
