"""Environments of other interfaces, as Isodream's."""

from typing import Any

from isodream.adapters.dm_env import from_dm_env
from isodream.adapters.gymnasium import from_gymnasium
from isodream.environment import Environment, Spec

__all__ = ["adapt", "from_dm_env", "from_gymnasium"]


def adapt(env: Any) -> Environment:
    """Whatever `env` is, as an environment of ours with default options.

    Raises:
        TypeError: if it has none of the known interfaces.
    """
    if isinstance(getattr(env, "spec", None), Spec):
        return env  # type: ignore[no-any-return]
    if hasattr(env, "action_space"):
        return from_gymnasium(env)
    if hasattr(env, "action_spec"):
        return from_dm_env(env)
    raise TypeError(
        f"{type(env).__name__} is neither a Gymnasium nor a dm_env environment; "
        "write a class with the methods of isodream.Environment around it"
    )
