"""What Weights & Biases is handed, by a stand-in for its client: its package is large, its servers are elsewhere."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from isodream import to_wandb


class Wandb:
    """Remembers runs by their id, as the server does."""

    def __init__(self) -> None:
        self.runs: dict[str, Wandb.Run] = {}

    class Run:
        def __init__(self, settings: dict[str, Any]) -> None:
            self.settings = settings
            self.rows: list[dict[str, Any]] = []
            self.step_metrics: dict[str, str | None] = {}
            self.finished = 0

        @property
        def summary(self) -> dict[str, Any]:
            return {key: value for row in self.rows for key, value in row.items()}

        def define_metric(self, name: str, *, step_metric: str | None = None, hidden: bool = False) -> None:
            self.step_metrics[name] = step_metric

        def log(self, row: dict[str, Any]) -> None:
            self.rows.append(row)

        def finish(self) -> None:
            self.finished += 1

    class Video:
        def __init__(self, path: str, *, format: str) -> None:  # noqa: A002
            assert format == "mp4"
            self.path = Path(path)

    def init(self, *, id: str, resume: str, **settings: Any) -> Wandb.Run:  # noqa: A002
        assert resume == "allow"
        return self.runs.setdefault(id, self.Run(settings))


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Wandb:
    stand_in = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    return stand_in


def add_rows(run_dir: Path, *rows: dict[str, float | None]) -> None:
    with (run_dir / "metrics.jsonl").open("a") as file:
        file.writelines(json.dumps(row) + "\n" for row in rows)


def add_film(run_dir: Path, frames: int) -> None:
    (run_dir / f"media/episode-{frames:010}.mp4").write_bytes(b"film")
    (run_dir / f"media/episode-{frames:010}.json").write_text("{}")


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    folder = tmp_path / "runs/group/seed-3"
    (folder / "media").mkdir(parents=True)
    (folder / "config.toml").write_text('seed = 3\n[env]\nid = "highway/day"\n')
    add_rows(
        folder,
        {"frames": 100, "time": 1.0, "train/loss/image": 9.5, "train/loss/reward": None},
        {"frames": 100, "time": 2.0, "episode/score": -4.0},
        {"frames": 300, "time": 3.0, "eval/score": 7.25},
    )
    add_film(folder, 200)
    return folder


def test_rows_configuration_and_films_arrive(run_dir: Path, wandb: Wandb) -> None:
    assert to_wandb.upload(run_dir, "test", "team") == 3
    (run,) = wandb.runs.values()
    assert run.settings == {
        "project": "test",
        "entity": "team",
        "name": "runs/group/seed-3",
        "config": {"seed": 3, "env": {"id": "highway/day"}},
    }
    assert run.step_metrics["*"] == "frames"
    assert run.rows[0] == {"frames": 100, "time": 1.0, "train/loss/image": 9.5}
    assert run.rows[1] == {"frames": 100, "time": 2.0, "episode/score": -4.0}
    film = run.rows[2].pop("eval/film")
    assert film.path == run_dir / "media/episode-0000000200.mp4"
    assert run.rows[2] == {"frames": 300, "time": 3.0, "eval/score": 7.25, "eval/film_frames": 200}
    assert run.finished == 1


def test_the_same_command_adds_what_is_new(run_dir: Path, wandb: Wandb) -> None:
    metrics = run_dir / "metrics.jsonl"
    unfinished = '{"frames": 400, "ti'
    metrics.write_text(metrics.read_text() + unfinished)
    assert to_wandb.upload(run_dir, "test") == 3
    metrics.write_text(metrics.read_text().removesuffix(unfinished))
    add_rows(run_dir, {"frames": 400, "time": 4.0, "eval/score": 8.0})
    # Encoded after the row of its frames had been written, and handed over.
    add_film(run_dir, 290)
    moved = run_dir.rename(run_dir.with_name("elsewhere"))
    assert to_wandb.upload(moved, "test") == 1
    (run,) = wandb.runs.values()
    assert [row["frames"] for row in run.rows] == [100, 100, 300, 400]
    assert run.rows[3]["eval/film"].path.name == "episode-0000000290.mp4"
    assert to_wandb.upload(moved, "test") == 0


def test_rows_that_a_resumed_learner_cut_off_do_not_hide_new_ones(run_dir: Path, wandb: Wandb) -> None:
    assert to_wandb.upload(run_dir, "test") == 3
    metrics = run_dir / "metrics.jsonl"
    metrics.write_text(metrics.read_text().splitlines(keepends=True)[0])
    assert to_wandb.upload(run_dir, "test") == 0
    add_rows(run_dir, {"frames": 300, "time": 5.0, "eval/score": 6.0})
    assert to_wandb.upload(run_dir, "test") == 1
    (run,) = wandb.runs.values()
    assert [row["time"] for row in run.rows] == [1.0, 2.0, 3.0, 5.0]


def test_a_folder_without_metrics_is_refused_by_name(tmp_path: Path) -> None:
    line = [sys.executable, "-m", "isodream.to_wandb", str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 1
    assert f"{tmp_path} is no run directory" in done.stderr
