"""Frames per second of dm_control's own pictures: SECONDS DOMAIN/TASK; a control step and a 64 x 64 picture each."""

import sys
import time

import numpy as np
from dm_control import suite

seconds = float(sys.argv[1])
domain, task = sys.argv[2].split("/")
environment = suite.load(domain, task, task_kwargs={"random": 0})
environment.reset()
specification = environment.action_spec()
random = np.random.RandomState(0)


def frame():
    environment.step(random.uniform(specification.minimum, specification.maximum))
    environment.physics.render(64, 64, camera_id=0)


# The first one compiles shaders.
frame()
begun = time.perf_counter()
frames = 0
while time.perf_counter() - begun < seconds:
    frame()
    frames += 1
print(frames / (time.perf_counter() - begun))
