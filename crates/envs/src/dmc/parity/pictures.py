"""Frames of dm_control's own renderer for given states, to compare ours with.

Usage: MUJOCO_GL=osmesa reference.py DOMAIN TASK [--green easy|hard] [--size N] < states > frames

Needs dm-control 1.0.50 with mujoco 3.17.0, and OSMesa (Debian: libosmesa6).

States: an unsigned 32-bit count, then for each state nq qpos and nv qvel. Where an episode places a target that is
no joint, the target's place follows: x and y for `reacher`, x and z for `finger` except for the task `spin`. All
numbers are 64-bit floats, all of it is little-endian.
Frames: [count, N, N, 3] bytes, RGB, top row first, of camera 0.

--green colours the sky as the video benchmark does before it keys the video in; `hard` colours the grid as well.
"""

import argparse
import re
import struct
import sys

import numpy as np
from dm_control import suite
from dm_control.suite import common

GREEN = ".2 .8 .2"


def make_green(hard):
    """Recolours textures of the models and of what they include; to be called before a model is loaded."""
    names = ("skybox", "grid") if hard else ("skybox",)

    def recolour(texture):
        text = texture.group(0)
        if not any(f'name="{name}"' in text for name in names):
            return text
        return re.sub(r'\b(rgb1|rgb2|markrgb)="[^"]*"', rf'\1="{GREEN}"', text)

    def recoloured(content):
        text = content.decode() if isinstance(content, bytes) else content
        return re.sub(r"<texture\b[^>]*>", recolour, text).encode()

    for path, content in common.ASSETS.items():
        if path.endswith(".xml"):
            common.ASSETS[path] = recoloured(content)
    read_model = common.read_model
    common.read_model = lambda name: recoloured(read_model(name))


def place_of_target(physics, domain, task):
    """The table of the model that holds a target which is no joint, and the target's cells in it."""
    if domain == "reacher":
        return physics.named.model.geom_pos, [["target", "x"], ["target", "y"]]
    if domain == "finger" and task != "spin":
        return physics.named.model.site_pos, [["target", "x"], ["target", "z"]]
    return None, []


def read_exactly(count):
    data = sys.stdin.buffer.read(count)
    if len(data) != count:
        sys.exit(f"states end after {len(data)} of {count} bytes, check nq and nv of the model")
    return data


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("domain")
    parser.add_argument("task")
    parser.add_argument("--green", choices=("easy", "hard"))
    parser.add_argument("--size", type=int, default=64)
    args = parser.parse_args()
    if args.green:
        make_green(args.green == "hard")
    env = suite.load(args.domain, args.task, task_kwargs={"random": 0})
    # The reset hides and resizes what the task hides and resizes.
    env.reset()
    physics = env.physics
    table, cells = place_of_target(physics, args.domain, args.task)
    nq, nv = physics.model.nq, physics.model.nv
    (states,) = struct.unpack("<I", read_exactly(4))
    for _ in range(states):
        numbers = np.frombuffer(read_exactly(8 * (nq + nv + len(cells))), "<f8")
        for (name, axis), value in zip(cells, numbers[nq + nv :]):
            table[name, axis] = value
        with physics.reset_context():
            physics.data.qpos[:] = numbers[:nq]
            physics.data.qvel[:] = numbers[nq : nq + nv]
        frame = physics.render(args.size, args.size, camera_id=0)
        sys.stdout.buffer.write(np.ascontiguousarray(frame).tobytes())
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
