"""Run directories on Weights & Biases: `python -m isodream.to_wandb runs/mine`.

Each run directory becomes a run there: metrics over environment frames, the configuration, the films and panels of
`media/`. The same command later adds what is new. `WANDB_MODE=offline` writes to `wandb/` instead, for `wandb sync`.
"""

from __future__ import annotations

import argparse
import json
import math
import secrets
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

METRICS = "metrics.jsonl"
RUN_ID = "wandb-run-id"
MEDIA = {"episode": "eval/film", "open_loop": "open_loop/moving"}


def rows(run_dir: Path) -> list[dict[str, float | None]]:
    """The lines of `metrics.jsonl` but one that is still being written; values that were no numbers are None."""
    lines = (run_dir / METRICS).read_text().splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def media(run_dir: Path) -> Iterator[tuple[int, str, Path]]:
    """Frames, metric and file of every film and panel, in the order of frames."""
    found = []
    for path in (run_dir / "media").glob("*.mp4"):
        kind, _, frames = path.stem.rpartition("-")
        if kind in MEDIA and frames.isdecimal():
            found.append((int(frames), MEDIA[kind], path))
    yield from sorted(found)


def upload(run_dir: Path, project: str, entity: str | None = None) -> int:
    """Hands a run directory to Weights & Biases, which must be installed, and returns the number of new rows."""
    if not (run_dir / METRICS).is_file():
        msg = f"{run_dir} is no run directory: it has no {METRICS}"
        raise FileNotFoundError(msg)
    import wandb

    config = tomllib.loads((run_dir / "config.toml").read_text())
    # Known by it wherever the directory is moved to.
    known_as = run_dir / RUN_ID
    if not known_as.exists():
        known_as.write_text(secrets.token_hex(4))
    name = "/".join(part for part in run_dir.resolve().parts[-3:] if part != "/")
    run = wandb.init(project=project, entity=entity, id=known_as.read_text(), name=name, config=config, resume="allow")
    run.define_metric("frames", hidden=True)
    run.define_metric("*", step_metric="frames")
    # The newest values are known there. Rows are told apart by time: a learner that resumes cuts rows off. Films come
    # later than the rows of their frames, so that the frames of the newest one of a kind are told beside it.
    summary: Any = run.summary

    def newest(key: str) -> float:
        return float(summary.get(key, -math.inf))

    newest_time = newest("time")
    new = [row for row in rows(run_dir) if (row["time"] or 0.0) > newest_time]
    films = [film for film in media(run_dir) if film[0] > newest(f"{film[1]}_frames")]
    for row in new:
        shown: dict[str, Any] = {key: value for key, value in row.items() if value is not None}
        while films and films[0][0] <= (row["frames"] or 0.0):
            frames, metric, path = films.pop(0)
            shown |= {metric: wandb.Video(str(path), format="mp4"), f"{metric}_frames": frames}
        run.log(shown)
    run.finish()
    return len(new)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m isodream.to_wandb", description=__doc__.partition("\n")[0])
    parser.add_argument("run_dirs", nargs="+", type=Path, metavar="RUN_DIR")
    parser.add_argument("--project", default="isodream")
    parser.add_argument("--entity", help="a team, or the user who is logged in")
    args = parser.parse_args()
    for run_dir in args.run_dirs:
        try:
            new = upload(run_dir, args.project, args.entity)
        except (ImportError, OSError) as error:
            cure = "; pip install wandb" if isinstance(error, ImportError) else ""
            raise SystemExit(f"error: {error}{cure}") from error
        print(f"{run_dir}: {new} new rows")


if __name__ == "__main__":
    main()
