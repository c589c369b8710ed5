"""dm_env environments, dm_control among them."""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from isodream.adapters.adapter import Actions, Adapter, Frame, agent_steps, is_picture
from isodream.environment import EnvError, Environment, Spec

if TYPE_CHECKING:
    import dm_env

CONTROL_STEPS = 1000

_log = logging.getLogger("isodream")


def from_dm_env(
    env: "dm_env.Environment",
    *,
    env_id: str | None = None,
    size: tuple[int, int] = (64, 64),
    action_repeat: int = 1,
    time_limit: int | None = None,
    pixels: str | None = None,
    camera: int | str = 0,
) -> Environment:
    """A dm_env environment as one of ours.

    Actions: a `BoundedArray` is scaled from [-1, 1] to its bounds; a `DiscreteArray` of n values has n components, of
    which the greatest chooses. An episode that ends with discount 0 is terminal. Seeds go to the `RandomState` of
    dm_control's tasks; environments that have none begin as they like.

    Args:
        env: The environment.
        env_id: Name of the environment; by default `dm_env/` and the class of its task.
        size: Height and width of the picture.
        action_repeat: Control steps per agent step; their rewards are summed, and only the last one is rendered.
        time_limit: Agent steps after which an episode is cut; by default 1000 control steps, as in most of dm_control's
            suite.
        pixels: Key of the picture in the observations; by default that of the first picture there is, and else
            `env.physics.render`.
        camera: Which camera `env.physics.render` looks through.

    Raises:
        EnvError: if its actions, or pictures cannot be used.
    """
    task = getattr(env, "task", None)
    name = env_id or f"dm_env/{type(env if task is None else task).__name__}"
    if pixels is None:
        pixels = _find(env.observation_spec())
    if pixels is None and not hasattr(env, "physics"):
        raise EnvError(f"{name} has neither pictures among its observations nor physics that can be rendered")
    actions = _actions(name, env.action_spec())
    limit = agent_steps(CONTROL_STEPS, action_repeat) if time_limit is None else time_limit
    spec = Spec(name, actions.dim, limit, *size, action_repeat=action_repeat)
    return _DmEnv(spec, actions, env, pixels, camera)


class _DmEnv(Adapter):
    def __init__(
        self, spec: Spec, actions: Actions, env: "dm_env.Environment", pixels: str | None, camera: int | str
    ) -> None:
        super().__init__(spec, actions)
        self._env, self._pixels, self._camera = env, pixels, camera
        self._random = _random(env)
        if self._random is None:
            _log.warning("%s takes no seed: the same seed will not begin the same episode", spec.id)

    def _begin(self, seed: int) -> Any:
        if self._random is not None:
            self._random.seed(seed % 2**32)
        return self._env.reset().observation

    def _advance(self, action: Any) -> Frame:
        step = self._env.step(action)
        is_terminal = bool(step.last() and step.discount == 0.0)
        return Frame(step.observation, float(step.reward or 0.0), is_terminal, step.last() and not is_terminal)

    def _picture(self, observation: Any) -> Any:
        if self._pixels is None:
            spec = self.spec
            return self._env.physics.render(spec.height, spec.width, camera_id=self._camera)
        return observation[self._pixels] if self._pixels else observation

    def close(self) -> None:
        self._env.close()


def _find(spec: Any) -> str | None:
    """The key of a picture in observations, "" for the observation itself, None where there is no picture."""
    parts = spec if isinstance(spec, Mapping) else {"": spec}
    return next((key for key, part in parts.items() if is_picture(part.dtype, part.shape)), None)


def _actions(name: str, spec: Any) -> Actions:
    from dm_env import specs

    match spec:
        case specs.DiscreteArray():
            return Actions.choice(spec.num_values)
        case specs.BoundedArray() if np.issubdtype(spec.dtype, np.floating):
            low, high = (np.broadcast_to(bound, spec.shape) for bound in (spec.minimum, spec.maximum))
            return Actions.scaled(low, high, spec.dtype)
    raise EnvError(f"{name} takes actions of {spec}; there are BoundedArray of floats and DiscreteArray")


def _random(env: Any) -> np.random.RandomState | None:
    """What dm_control's suite and composer draw from."""
    sources = (getattr(getattr(env, "task", None), "random", None), getattr(env, "random_state", None))
    return next((source for source in sources if isinstance(source, np.random.RandomState)), None)
