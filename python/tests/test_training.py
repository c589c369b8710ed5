"""Isodream trained on a Gymnasium environment in Python, and its policy back in Python; and what README shows."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from conftest import ROOT, Isodream
from libtorch import LibtorchRandom, derive_seed, parameters_drawn

from isodream import Environment, Policy, Server, from_gymnasium

README = (ROOT / "python/README.md").read_text()


def pendulum() -> Environment:
    return from_gymnasium(gymnasium.make("Pendulum-v1", render_mode="rgb_array"), action_repeat=4, time_limit=20)


def test_a_policy_is_trained_in_processes_and_earns_the_same_in_python(isodream: Isodream, tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with Server(pendulum, environments=3, processes=True) as server:
        remote = f"grpc://{server.address}"
        (rates,) = isodream.json("env", "bench", remote, "--seconds", 0.1)
        assert rates["frames_per_s"] > 4
        settings = [f"env.id={remote}", "learner.env_frames=700", "env.time_limit=20"]
        options = [word for setting in settings for word in ("--set", setting)]
        said = isodream("train", "--preset", "debug", "--run-dir", run_dir, "--eval-episodes", 1, *options)
        assert "trained" in said, said
        evaluation = isodream.json("eval", "--checkpoint", run_dir, "--episodes", 2)
    assert "gymnasium/Pendulum-v1" in evaluation["env"]

    policy = Policy.load(run_dir)
    assert policy.checkpoint.updates == evaluation["updates"] > 0
    seed = policy.checkpoint.config["seed"]
    noise = LibtorchRandom(derive_seed(seed, "eval", "noise"))
    noise.skip(parameters_drawn(policy.checkpoint.weights))
    policy.rng = noise  # type: ignore[assignment]
    env, scores = pendulum(), []
    policy.reset(1)
    for episode in range(2):
        row, score = env.reset(derive_seed(seed, "eval", str(episode))), 0.0
        is_first = np.array([True])
        while not row.is_last:
            row = env.step(policy.act(row.image[None], is_first)[0])
            score, is_first = score + row.reward, np.array([False])
        scores.append(score)
    assert scores == pytest.approx(evaluation["policies"]["trained"]["returns"], rel=1e-3)


@contextmanager
def script(text: str, path: Path) -> Iterator[str]:
    """Where the server of a program listens, which is then interrupted."""
    path.write_text(text.replace("127.0.0.1:7100", "127.0.0.1:0"))
    with subprocess.Popen([sys.executable, path], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        words = process.stdout.readline().split(" at ")
        yield words[-1].strip()
        process.send_signal(signal.SIGINT)
        assert process.wait(15) == 0


def blocks(section: str) -> list[str]:
    """The programs of a section of README."""
    text = README.split(f"## {section}\n")[1].split("\n## ")[0]
    return re.findall(r"```python\n(.*?)```", text, re.S)


def test_the_first_example_serves_in_ten_lines(isodream: Isodream, tmp_path: Path) -> None:
    (example,) = blocks("An environment of Gymnasium")
    assert len([line for line in example.splitlines() if line]) <= 10
    with script(example, tmp_path / "serve.py") as remote:
        said = isodream("env", "play", remote, "--steps", 2, "--out", tmp_path / "car.png")
        assert "return" in said


def test_an_example_serves_dm_control(isodream: Isodream, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")  # Not all machines have OpenGL.
    (example,) = blocks("An environment of dm_env")
    with script(example, tmp_path / "serve.py") as remote:
        refused = isodream.refused("env", "play", remote, "--steps", 1, "--out", tmp_path / "walker.png")
        assert "No OpenGL rendering backend is available" in refused, "all but the picture works"


def test_examples_that_cannot_run_here_are_python() -> None:
    for section in ("Any other environment", "A policy"):
        (example,) = blocks(section)
        compile(example, "README.md", "exec")
