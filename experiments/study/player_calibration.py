"""Distance of the virtual players from the paper's people: target against reached, as tables and a picture.

    python -m experiments.study.player_calibration --first runs/player3_m0 --later runs/player3_m2 runs/medium \\
        --out calibration

First balls are compared with M0 and rally balls with M1 and M2, each through the path of real data: seen by cameras at
125 Hz with noise, fitted, cleaned by DBSCAN, minima and maxima taken. The rallies of D1 are those with the policies
``--first``, those of D2's additions with ``--later``, in the paper's numbers of balls: 60 and 70 updates of 30 balls.
Rally lengths over all policies are compared with the table of player skill. ``--tune N`` first moves, N times over, the
ends of the players' spreads by what the fitted numbers that follow from them lack, and writes the players' files anew.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import yaml
from matplotlib.lines import Line2D

from ballmodel import registry
from ballmodel.distribution import BallDistribution
from ballmodel.fit_distribution import fit_human
from ballmodel.io import yaml as yaml_file
from ballmodel.io.atomic_files import replacing
from ballmodel.state import BallState
from ballmodel.trajectory import Dataset
from experiments.evaluation.figures import STYLE
from experiments.runs import load_policy
from experiments.study.target_domain import hidden_effects
from mjx_tt import platform
from mjx_tt.env.task import TaskConfig
from mjx_tt.rally import human_player
from mjx_tt.rally.end_reasons import ROWS
from mjx_tt.rally.simulator import RallySimulator
from mjx_tt.sim import model as models

Row = dict[str, Any]  # of a table: cells by column

UPDATE_BALLS = 30  # of fine-tuning: 5 pairs, 3 balls each
ROUNDS = {"M0": 0, "M1": 60 * UPDATE_BALLS, "M2": 70 * UPDATE_BALLS}  # balls that are added
FIRST_BALLS = 200  # D0; the paper does not tell (estimate)
TARGET, REACHED = "#7f7f7f", "#0072b2"
NOISE = 0.003  # [m] of the cameras, standard deviation (estimate)
LANES, RALLIES, CAPACITY = 8, 30, 400  # per player and policy


@dataclass(frozen=True)
class Reached:
    """One player: fitted numbers by model, and rally lengths."""

    numbers: dict[str, np.ndarray]  # model -> (16,) in the order of NUMBERS
    lengths: np.ndarray  # (n,) of the rallies that count
    balls: dict[str, int]  # model -> number of balls


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="calibrate_players", description=__doc__.splitlines()[0])
    parser.add_argument("--first", nargs="+", required=True, help="runs or artefacts trained on first balls")
    parser.add_argument("--later", nargs="+", required=True, help="runs or artefacts trained on rally balls")
    parser.add_argument("--model", help="model YAML of the world that is played in; default: the nominal one")
    parser.add_argument("--out", default="calibration")
    parser.add_argument("--tune", type=int, default=0, metavar="N", help="rounds of tuning before the comparison")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    platform.configure()
    calibration = Calibration(chosen.first, chosen.later, chosen.model)
    for tuning in range(chosen.tune):
        rows = calibration.table(calibration.play(chosen.seed + 1 + tuning))
        tune(rows)
        print(f"tuning {tuning + 1} of {chosen.tune}: medians of the deviations {medians_of(rows)}", flush=True)
    reached = calibration.play(chosen.seed)
    rows, lengths = calibration.table(reached), calibration.lengths(reached)
    write(Path(chosen.out), rows, lengths)
    return 0


NUMBERS = tuple(
    f"{part}.{axis} {end}"
    for part, axes in (("position", "xyz"), ("velocity", "xyz"), ("landing", "xy"))
    for axis in axes
    for end in ("min", "max")
)


# Number of a fitted model -> the end of a spread that it follows. Velocities along y are negative, speeds are not.
FOLLOWS = tuple(
    ("M0", f"{number} {end}", "first", spread, ends[end == "max"])
    for number, spread, ends in (
        ("position.x", "x", ("low", "high")),
        ("position.y", "y", ("low", "high")),
        ("position.z", "z", ("low", "high")),
        ("velocity.x", "sideways", ("low", "high")),
        ("velocity.y", "forward", ("-high", "-low")),
        ("velocity.z", "climb", ("low", "high")),
        ("landing.x", "side", ("low", "high")),
        ("landing.y", "landing", ("low", "high")),
    )
    for end in ("min", "max")
) + (
    ("M2", "position.y max", "strokes", "plane", "high"),
    ("M2", "position.z min", "strokes", "height", "low"),
    ("M2", "velocity.y min", "strokes", "speed", "-high"),
    ("M2", "velocity.y max", "strokes", "speed", "-low"),
    ("M2", "velocity.z max", "strokes", "climb", ""),
    ("M2", "landing.x min", "strokes", "aim_x", "low"),
    ("M2", "landing.y max", "strokes", "aim_y", "high"),
)
TUNING = 0.5  # share of what a number lacks by which its end is moved
FARTHEST = 0.4  # [m], [m/s] that an end may be from the number that it follows


class Calibration:
    """The virtual players, played with given policies."""

    def __init__(self, first: Sequence[str], later: Sequence[str], model_path: str | None = None) -> None:
        self.model = models.ModelFile.load(model_path).model if model_path else models.SimModel()
        self.first = len(first)
        self.policies = [load_policy.load(folder).policy for folder in (*first, *later)]
        self.names = human_player.names()
        self.simulator = RallySimulator(TaskConfig(sim_rate=150.0))
        self.lanes = [(p, k) for p in range(len(self.names)) for k in range(len(self.policies)) for _ in range(LANES)]
        columns = [self.policies[k] for _, k in self.lanes]
        self.policy = jax.tree.map(
            lambda *arrays: jnp.stack([jnp.asarray(a, jnp.float32) for a in arrays], axis=1), *columns
        )

    def people(self) -> human_player.Player:
        """The players of the lanes, read anew."""
        loaded = [human_player.load(name) for name in self.names]
        return human_player.stack([loaded[p] for p, _ in self.lanes])

    def play(self, seed: int) -> dict[str, Reached]:
        """Plays and fits. Returns what each player reached."""
        keys = jax.random.split(jax.random.key(seed), 3)
        result = self.simulator.play(self.policy, self.people(), self.model, keys[0], RALLIES, capacity=CAPACITY)
        result = jax.tree.map(np.asarray, result)
        person, who = np.array(self.lanes).T
        filtered = np.array([row[3] for row in ROWS])[result.end]
        kept = np.arange(CAPACITY)[:, None] < result.balls.count
        rng, reached = np.random.default_rng(seed), {}
        for p, name in enumerate(self.names):
            lobs = human_player.first_ball(
                human_player.load(name),
                human_player.fresh((FIRST_BALLS,)),
                jax.random.fold_in(keys[1], p),
                (FIRST_BALLS,),
            )
            data, numbers, counts = [jax.tree.map(np.asarray, lobs)], {}, {}
            for model, added in ROUNDS.items():
                if added:
                    group = (who < self.first) if model == "M1" else (who >= self.first)
                    inside = kept & (person == p) & group
                    found = [getattr(result.balls, part)[:, inside] for part in ("position", "velocity", "spin")]
                    order = rng.permutation(inside.sum())[:added]
                    data.append(BallState(*(x[:, order] for x in found)))
                balls = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *data)
                seen = hidden_effects.measure(self.model, balls, NOISE, jax.random.fold_in(keys[2], 3 * p + len(data)))
                dataset = Dataset(tuple(seen.trajectories(name)), name)
                fitted, _ = fit_human(dataset, self.model.ball)
                numbers[model], counts[model] = sixteen(fitted), len(dataset)
            lane = person == p
            reached[name] = Reached(numbers, result.length[:, lane][~filtered[:, lane]], counts)
        return reached

    def table(self, reached: dict[str, Reached]) -> list[Row]:
        """A row for every player, model and number: target, reached, and the difference as a share of the range."""
        rows = []
        for name, person in reached.items():
            for model, numbers in person.numbers.items():
                wanted = sixteen(registry.load(f"{name}/{model}"))
                for i, number in enumerate(NUMBERS):
                    span = wanted[i | 1] - wanted[i & ~1]
                    rows.append(
                        {
                            "player": name,
                            "model": model,
                            "number": number,
                            "target": round(float(wanted[i]), 3),
                            "reached": round(float(numbers[i]), 3),
                            "deviation": round(float(abs(numbers[i] - wanted[i]) / span), 3),
                            "balls": person.balls[model],
                        }
                    )
        return rows

    def lengths(self, reached: dict[str, Reached]) -> list[Row]:
        """A row for every player: rally lengths, the paper's and reached."""
        rows = []
        for name, person in reached.items():
            skill, lengths = registry.skill(name), np.sort(person.lengths)
            best = lengths[len(lengths) // 6 :]  # as "the top 50 of 60" does
            for label, wanted, found in (
                ("min", skill.min, best.min()),
                ("p25", skill.p25, np.percentile(best, 25)),
                ("mean", skill.mean, best.mean()),
                ("std", skill.std, best.std()),
                ("p75", skill.p75, np.percentile(best, 75)),
                ("max", skill.max, best.max()),
            ):
                rows.append(
                    {
                        "player": name,
                        "level": skill.level,
                        "statistic": label,
                        "target": float(wanted),
                        "reached": round(float(found), 2),
                        "rallies": int(best.size),
                    }
                )
        return rows


def tune(rows: list[Row]) -> None:
    """Moves the ends of the players' spreads by half of what the numbers of these rows lack, and writes their files."""
    for name in human_player.names():
        path = human_player.FOLDER / f"{name}.yaml"
        data = yaml_file.read(path)
        found = {(r["model"], r["number"]): r for r in rows if r["player"] == name}
        for model, number, group, spread, end in FOLLOWS:
            row, sign = found[model, number], -1.0 if end.startswith("-") else 1.0
            wanted = sign * row["target"]
            part, at = data[group], {"low": 0, "high": 2}.get(end.removeprefix("-"))
            old = part[spread] if at is None else part[spread][at]
            new = old + TUNING * sign * (row["target"] - row["reached"])
            new = round(float(np.clip(new, wanted - FARTHEST, wanted + FARTHEST)), 3)
            if at is None:
                part[spread] = new
                continue
            values = part[spread]
            values[at] = min(new, values[1]) if at == 0 else max(new, values[1])
            if group == "first":
                values[1] = round(0.5 * (values[0] + values[2]), 3)
        with replacing(path) as temporary:
            temporary.write_text(
                yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110), encoding="utf-8"
            )


def medians_of(rows: list[Row]) -> dict[str, dict[str, float]]:
    """Median deviation over the sixteen numbers, by player and model."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        found.setdefault(row["player"], {}).setdefault(row["model"], []).append(row["deviation"])
    return {name: {m: round(float(np.median(d)), 3) for m, d in by.items()} for name, by in found.items()}


def sixteen(distribution: BallDistribution) -> np.ndarray:
    """The 16 numbers (16,) of a distribution in the order of NUMBERS."""
    low, high = (
        [v for part in ("position", "velocity", "landing") for v in getattr(distribution, f"{part}_{end}")]
        for end in ("min", "max")
    )
    return np.array([low, high]).T.ravel()


def write(folder: Path, rows: list[Row], lengths: list[Row]) -> None:
    """calibration.csv, calibration_rallies.csv, calibration.json and calibration.png; prints the medians."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (("calibration.csv", rows), ("calibration_rallies.csv", lengths)):
        with replacing(folder / name) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, content[0])
            writer.writeheader()
            writer.writerows(content)
    medians = medians_of(rows)
    with replacing(folder / "calibration.json") as temporary:
        temporary.write_text(json.dumps({"medians": medians, "numbers": rows, "rallies": lengths}, indent=1))
    picture(folder / "calibration.png", rows, lengths)
    for name, by in medians.items():
        one = {r["statistic"]: r for r in lengths if r["player"] == name}
        print(
            name,
            "  ".join(f"{m} {d:.3f}" for m, d in by.items()),
            "  rallies",
            "  ".join(f"{s} {r['reached']:g}/{r['target']:g}" for s, r in one.items()),
        )


def picture(path: Path, rows: list[Row], lengths: list[Row]) -> None:
    """Target and reached intervals of every player, model and coordinate, and the rally lengths, as PNG."""
    names, coordinates = list(dict.fromkeys(r["player"] for r in rows)), [n.removesuffix(" min") for n in NUMBERS[::2]]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(3, 3, figsize=(12.5, 9.5), layout="constrained")
        for axis, coordinate in zip(axes.flat[: len(coordinates)], coordinates, strict=True):
            for p, name in enumerate(names):
                for m, model in enumerate(ROUNDS):
                    chosen = [r for r in rows if r["player"] == name and r["model"] == model]
                    low, high = (
                        next(r for r in chosen if r["number"] == f"{coordinate} {end}") for end in ("min", "max")
                    )
                    x = 3.4 * p + m
                    axis.plot(
                        [x - 0.2] * 2, [low["target"], high["target"]], color=TARGET, linewidth=4, solid_capstyle="butt"
                    )
                    axis.plot(
                        [x + 0.2] * 2,
                        [low["reached"], high["reached"]],
                        color=REACHED,
                        linewidth=4,
                        solid_capstyle="butt",
                    )
            axis.set_title(f"{coordinate} [{'m/s' if coordinate.startswith('velocity') else 'm'}]", fontsize=10)
            axis.set_xticks(
                [3.4 * p + m for p in range(len(names)) for m in range(3)], [*ROUNDS] * len(names), fontsize=7
            )
            for p, name in enumerate(names):
                axis.text(
                    3.4 * p + 1,
                    1.0,
                    name.removeprefix("player"),
                    transform=axis.get_xaxis_transform(),
                    ha="center",
                    va="top",
                    fontsize=8,
                )
        axis = axes.flat[-1]
        for p, name in enumerate(names):
            one = {r["statistic"]: r for r in lengths if r["player"] == name}
            for shift, kind, colour in ((-0.2, "target", TARGET), (0.2, "reached", REACHED)):
                axis.plot(
                    [p + shift] * 2,
                    [one["p25"][kind], one["p75"][kind]],
                    color=colour,
                    linewidth=8,
                    solid_capstyle="butt",
                )
                axis.plot(p + shift, one["mean"][kind], "o", color="white", markeredgecolor="black", markersize=5)
        axis.set_xticks(range(len(names)), [n.removeprefix("player") for n in names])
        axis.set_title("rally length: quartiles and mean", fontsize=10)
        figure.legend(
            handles=[
                Line2D([], [], color=TARGET, linewidth=4, label="the paper's player"),
                Line2D([], [], color=REACHED, linewidth=4, label="virtual player"),
            ],
            loc="outside lower center",
            ncols=2,
            frameon=False,
        )
        with replacing(path) as temporary:
            figure.savefig(temporary, format="png", dpi=110)
        plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
