"""Gymnasium environments."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from isodream.adapters.adapter import Actions, Adapter, Frame, agent_steps, is_picture
from isodream.environment import EnvError, Environment, Spec

if TYPE_CHECKING:
    import gymnasium

RENDER = "render"


def from_gymnasium(
    env: "gymnasium.Env[Any, Any]",
    *,
    env_id: str | None = None,
    size: tuple[int, int] = (64, 64),
    action_repeat: int = 1,
    time_limit: int | None = None,
    pixels: str | None = None,
) -> Environment:
    """A Gymnasium environment as one of ours.

    Actions: a `Box` is scaled from [-1, 1] to its bounds; `Discrete(n)` has n components, of which the greatest
    chooses; `MultiDiscrete` has such a group of components for each of its numbers; in `MultiBinary`, components
    above 0 are 1. Seeds are taken modulo 2**31, the most that all environments take. Numbers in `info` become metrics.

    Args:
        env: The environment. If its observations are no pictures, it must have `render_mode="rgb_array"`.
        env_id: Name of the environment; by default `gymnasium/` and its own.
        size: Height and width of the picture.
        action_repeat: Frames per agent step; their rewards are summed, and only the last one is rendered.
        time_limit: Agent steps after which an episode is cut; by default the environment's own limit.
        pixels: `"render"`, or the key of the picture in a dictionary of observations; by default the observation
            if it is a picture or holds one, else `render()`.

    Raises:
        EnvError: if its actions, pictures or time limit cannot be used.
    """
    name = env_id or f"gymnasium/{env.spec.id if env.spec else type(env.unwrapped).__name__}"
    pixels = pixels or _find(env.observation_space)
    if pixels == RENDER and env.render_mode != "rgb_array":
        raise EnvError(
            f'{name} has render_mode={env.render_mode!r} and no pictures; make it with render_mode="rgb_array"'
        )
    actions = _actions(name, env.action_space)
    if time_limit is None:
        if env.spec is None or env.spec.max_episode_steps is None:
            raise EnvError(f"{name} does not say when its episodes end; give time_limit=N, in agent steps")
        time_limit = agent_steps(env.spec.max_episode_steps, action_repeat)
    spec = Spec(name, actions.dim, time_limit, *size, action_repeat=action_repeat)
    return _Gymnasium(spec, actions, env, pixels)


class _Gymnasium(Adapter):
    def __init__(self, spec: Spec, actions: Actions, env: "gymnasium.Env[Any, Any]", pixels: str) -> None:
        super().__init__(spec, actions)
        self._env, self._pixels = env, pixels

    def _begin(self, seed: int) -> Any:
        observation, _ = self._env.reset(seed=seed % 2**31)
        return observation

    def _advance(self, action: Any) -> Frame:
        observation, reward, terminated, truncated, info = self._env.step(action)
        return Frame(observation, float(reward), bool(terminated), bool(truncated), _metrics(info))

    def _picture(self, observation: Any) -> Any:
        if self._pixels == RENDER:
            return self._env.render()
        return observation[self._pixels] if self._pixels else observation

    def close(self) -> None:
        self._env.close()


def _find(space: "gymnasium.Space[Any]") -> str:
    """Where pictures are: the key of one in observations, "" for the observation itself, or `RENDER`."""
    from gymnasium import spaces

    def shows(space: "gymnasium.Space[Any]") -> bool:
        return isinstance(space, spaces.Box) and is_picture(space.dtype, space.shape)

    if shows(space):
        return ""
    keys = [key for key, part in space.items() if shows(part)] if isinstance(space, spaces.Dict) else []
    return keys[0] if keys else RENDER


def _actions(name: str, space: "gymnasium.Space[Any]") -> Actions:
    from gymnasium import spaces

    match space:
        case spaces.Box() if np.issubdtype(space.dtype, np.floating):
            return Actions.scaled(space.low, space.high, space.dtype)
        case spaces.Discrete():
            return Actions.choice(int(space.n), int(space.start))
        case spaces.MultiDiscrete() if space.nvec.ndim == 1:
            bounds, start = np.cumsum(space.nvec)[:-1], space.start
            return Actions(
                int(space.nvec.sum()),
                lambda action: start + [part.argmax() for part in np.split(action, bounds)],
            )
        case spaces.MultiBinary():
            shape = space.shape
            return Actions(math.prod(shape), lambda action: (action > 0.0).astype(np.int8).reshape(shape))
    raise EnvError(
        f"{name} takes actions of {space}; there are Box of floats, Discrete, MultiDiscrete of one axis and "
        "MultiBinary: wrap it in gymnasium.wrappers.TransformAction"
    )


def _metrics(info: Mapping[str, Any]) -> dict[str, float]:
    numbers = (int, float, np.integer, np.floating)
    return {name: float(value) for name, value in info.items() if isinstance(value, numbers)}
