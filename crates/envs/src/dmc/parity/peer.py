"""Drives tasks of dm_control: SEED EPISODES STEPS DOMAIN/TASK...

Writes doubles in the machine's byte order, exactly as they are: for each task and episode qpos and qvel after the
reset, then for each step the reward, qpos and qvel. Actions come from RandomState(SEED + 1), which goes on from
episode to episode: uniform in [-2, 2], clipped to [-1, 1], and held for ten steps, so that bodies get moving.
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
        for step in range(steps):
            if step % 10 == 0:
                action = np.clip(actions.uniform(-2, 2, size), -1, 1)
            reward = environment.step(action).reward
            write([reward], data.qpos, data.qvel)
