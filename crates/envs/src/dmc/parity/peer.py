"""Drives tasks of dm_control: SEED EPISODES STEPS DOMAIN/TASK...

Writes doubles in the machine's byte order, exactly as they are: for each task and episode qpos and qvel after the
reset, then for each step the reward, qpos and qvel. Actions are uniform draws from RandomState(SEED + 1), which goes
on from episode to episode.
"""

import sys

import numpy as np
from dm_control import suite

seed, episodes, steps = map(int, sys.argv[1:4])


def write(*values):
    sys.stdout.buffer.write(np.concatenate(values).astype(np.float64).tobytes())


for name in sys.argv[4:]:
    domain, task = name.split("/")
    environment = suite.load(domain, task, task_kwargs={"random": seed})
    data = environment.physics.data
    actions = np.random.RandomState(seed + 1)
    size = environment.action_spec().shape
    for _ in range(episodes):
        environment.reset()
        write(data.qpos, data.qvel)
        for _ in range(steps):
            reward = environment.step(actions.uniform(-1, 1, size)).reward
            write([reward], data.qpos, data.qvel)
