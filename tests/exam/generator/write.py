"""Writes a hidden case: the log where the diagnosis reads it, the truth where it does not.

    python -m tests.exam.generator.write --cause wind_x --size 10 --noise ar1 --seed 3 --out DIR

DIR/log/ball.csv, or DIR/log/command.csv and DIR/log/state.csv for a robot; DIR/sealed/truth.json.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import numpy as np

from tests.exam.generator import cases
from tests.exam.generator.cases import BallCase, Case, RobotCase
from tests.exam.generator.invented_defects import INVENTED
from tests.exam.generator.sessions import NOISES, WRONG_NOISES, Log


def write(case: Case, folder: Path) -> tuple[list[Path], Path, BallCase | RobotCase]:
    """Log files, sealed truth and the drawn case."""
    log, sealed = folder / "log", folder / "sealed"
    for path in (log, sealed):
        path.mkdir(parents=True, exist_ok=True)
    if case.kind in ("robot", "unexcited", "robot_none"):
        drawn = cases.build_robot(case)
        command, state = drawn.rows()
        _replace(log / "command.csv", _lines("t,joint,velocity", command))
        _replace(log / "state.csv", _lines("t,joint,position", state))
        files = [log / "command.csv", log / "state.csv"]
    else:
        drawn = cases.build(case)
        _replace(log / "ball.csv", ball_csv(drawn.log()))
        files = [log / "ball.csv"]
    truth = sealed / "truth.json"
    _replace(truth, json.dumps(drawn.truth(), indent=1))
    return files, truth, drawn


def ball_csv(log: Log) -> str:
    """session,trajectory,t,x,y,z: one line for each sample that the tracker kept."""
    lines = ["session,trajectory,t,x,y,z"]
    for ball in range(log.session.size):
        kept = np.isfinite(log.position[0, :, ball])
        table = np.column_stack([log.time[kept, ball], *log.position[:, kept, ball]])
        head = f"day{log.session[ball]},{ball},"
        lines += [head + f"{t:.6f},{x:.6f},{y:.6f},{z:.6f}" for t, x, y, z in table]
    return "\n".join(lines) + "\n"


def _lines(header: str, rows) -> str:
    return "\n".join([header, *(f"{t:.6f},{name},{value:.7f}" for t, name, value in rows)]) + "\n"


def _replace(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def kind_of(causes: tuple[str, ...]) -> str:
    """The kind of case that a list of causes makes."""
    if any("." in c for c in causes):
        return "robot"
    if any(c in INVENTED for c in causes):
        return "invented"
    return ("none", "single", "pair", "triple")[len(causes)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cause", default="", help="comma-separated catalogue names, an invented one, or joint.effect")
    parser.add_argument("--size", type=float, default=10.0, help="median shift of the last sample [mm]")
    parser.add_argument("--noise", default="iid", choices=(*NOISES, *WRONG_NOISES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=cases.KINDS, help="deleted, unexcited ...; by default what the causes make")
    parser.add_argument("--balls", type=int, help="number of balls; drawn between 200 and 500 by default")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    causes = tuple(c for c in options.cause.split(",") if c)
    kind = options.kind or kind_of(causes)
    size = options.size if causes else 0.0
    files, truth, drawn = write(Case(kind, causes, size, options.noise, options.seed, count=options.balls), options.out)
    print(*files, truth, sep="\n")
    print(json.dumps(drawn.amounts))


if __name__ == "__main__":
    main()
