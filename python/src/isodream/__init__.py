"""Environments in Python for Isodream's actors, and Isodream's policies in Python.

- `serve`, `Server`: environments of this process for actors anywhere
- `from_gymnasium`, `from_dm_env`: environments of those interfaces; `Environment`, `Spec`, `Row`: any others
- `Secrets`: who may drive them
- `Policy`: a checkpoint that acts
"""

from isodream.adapters import from_dm_env, from_gymnasium
from isodream.environment import EnvError, Environment, Row, Spec
from isodream.policy import Policy
from isodream.security import Secrets, SecurityError
from isodream.server import Server, serve

__all__ = [
    "EnvError",
    "Environment",
    "Policy",
    "Row",
    "Secrets",
    "SecurityError",
    "Server",
    "Spec",
    "from_dm_env",
    "from_gymnasium",
    "serve",
]
