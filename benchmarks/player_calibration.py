"""Distance of the virtual players from the paper's people: target against reached, as tables and a picture.

    python -m benchmarks.player_calibration --first runs/player3_m0 --later runs/player3_m2 --out calibration

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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import yaml
from matplotlib.figure import Figure

from ballmodel import registry
from ballmodel.fit_distribution import fit_human
from ballmodel.io import yaml as yaml_file
from ballmodel.io.atomic_files import replacing
from ballmodel.state import BallState
from ballmodel.trajectory import Dataset
from experiments.runs import load_policy
from experiments.study.analysis import study_folder
from experiments.study.report.plots import STYLE, add_legend, line
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
COLOURS = {"target": "#7f7f7f", "reached": "#0072b2"}
NOISE = 0.003  # [m] of the cameras, standard deviation (estimate)
LANES, RALLIES, CAPACITY = 8, 30, 400  # per player and policy
QUANTITIES = tuple(name.replace(" ", ".") for name in study_folder.QUANTITIES)
NUMBERS = tuple(f"{quantity} {end}" for quantity in QUANTITIES for end in ("min", "max"))
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


@dataclass(frozen=True)
class Reached:
    """One player: fitted numbers by model, and rally lengths."""

    numbers: dict[str, np.ndarray]  # model -> (16,) in the order of NUMBERS
    lengths: np.ndarray  # (n,) of the rallies that count
    balls: dict[str, int]  # model -> number of balls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", nargs="+", required=True, help="runs or artefacts trained on first balls")
    parser.add_argument("--later", nargs="+", required=True, help="runs or artefacts trained on rally balls")
    parser.add_argument("--model", help="model YAML of the world that is played in; default: the nominal one")
    parser.add_argument("--out", default="calibration", type=Path)
    parser.add_argument("--tune", type=int, default=0, metavar="N", help="rounds of tuning before the comparison")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    platform.configure()
    model = models.ModelFile.load(chosen.model).model if chosen.model else models.SimModel()
    simulator = RallySimulator(TaskConfig(sim_rate=150.0))
    for tuning in range(chosen.tune):
        rows = compare_numbers(play(simulator, model, chosen.first, chosen.later, chosen.seed + 1 + tuning))
        tune(rows)
        print(f"tuning {tuning + 1} of {chosen.tune}: medians of the deviations {medians_of(rows)}", flush=True)
    reached = play(simulator, model, chosen.first, chosen.later, chosen.seed)
    write(chosen.out, compare_numbers(reached), compare_lengths(reached))


def play(
    simulator: RallySimulator, model: models.SimModel, first: Sequence[str], later: Sequence[str], seed: int
) -> dict[str, Reached]:
    """Results of each player in rallies with the policies of these runs; the players' files are read anew."""
    names, policies = human_player.names(), [load_policy.load(folder).policy for folder in (*first, *later)]
    people = [human_player.load(name) for name in names]
    person, who = np.indices((len(names), len(policies))).reshape(2, -1).repeat(LANES, axis=1)
    columns = [policies[k] for k in who]
    policy = jax.tree.map(lambda *arrays: jnp.stack([jnp.asarray(a, jnp.float32) for a in arrays], axis=1), *columns)
    rally_key, lob_key, camera_key = jax.random.split(jax.random.key(seed), 3)
    player = human_player.stack([people[p] for p in person])
    result = jax.tree.map(np.asarray, simulator.play(policy, player, model, rally_key, RALLIES, capacity=CAPACITY))
    filtered = np.array([row[3] for row in ROWS])[result.end]
    kept = np.arange(CAPACITY)[:, None] < result.balls.count
    rng, reached = np.random.default_rng(seed), {}
    for p, name in enumerate(names):
        key, fresh = jax.random.fold_in(lob_key, p), human_player.fresh((FIRST_BALLS,))
        data = [jax.tree.map(np.asarray, human_player.first_ball(people[p], fresh, key, (FIRST_BALLS,)))]
        numbers, counts = {}, {}
        for round_, added in ROUNDS.items():
            if added:
                inside = kept & (person == p) & ((who < len(first)) if round_ == "M1" else (who >= len(first)))
                order = rng.permutation(inside.sum())[:added]
                parts = (getattr(result.balls, part)[:, inside] for part in ("position", "velocity", "spin"))
                data.append(BallState(*(x[:, order] for x in parts)))
            balls = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *data)
            seen = hidden_effects.measure(model, balls, NOISE, jax.random.fold_in(camera_key, 3 * p + len(data)))
            dataset = Dataset(tuple(seen.trajectories(name)), name)
            numbers[round_], counts[round_] = study_folder.numbers(fit_human(dataset, model.ball)[0]), len(dataset)
        lane = person == p
        reached[name] = Reached(numbers, result.length[:, lane][~filtered[:, lane]], counts)
    return reached


def compare_numbers(reached: dict[str, Reached]) -> list[Row]:
    """A row for every player, model and number: target, reached, and the difference as a share of the range."""
    rows = []
    for name, person in reached.items():
        for model, numbers in person.numbers.items():
            wanted = study_folder.numbers(registry.load(f"{name}/{model}"))
            for i, number in enumerate(NUMBERS):
                deviation = abs(numbers[i] - wanted[i]) / (wanted[i | 1] - wanted[i & ~1])
                values = {"target": wanted[i], "reached": numbers[i], "deviation": deviation}
                rounded = {key: round(float(value), 3) for key, value in values.items()}
                rows.append({"player": name, "model": model, "number": number, **rounded, "balls": person.balls[model]})
    return rows


def compare_lengths(reached: dict[str, Reached]) -> list[Row]:
    """A row for every player and statistic of rally lengths, the paper's and reached."""
    rows = []
    for name, person in reached.items():
        skill, lengths = registry.skill(name), np.sort(person.lengths)
        best = lengths[len(lengths) // 6 :]  # as "the top 50 of 60" does
        p25, p75 = np.percentile(best, (25, 75))
        found = {"min": best.min(), "p25": p25, "mean": best.mean(), "std": best.std(), "p75": p75, "max": best.max()}
        for statistic, value in found.items():
            numbers = {"target": float(getattr(skill, statistic)), "reached": round(float(value), 2)}
            rows.append({"player": name, "level": skill.level, "statistic": statistic, **numbers, "rallies": best.size})
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
            text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)
            temporary.write_text(text, encoding="utf-8")


def medians_of(rows: list[Row]) -> dict[str, dict[str, float]]:
    """Median deviation over the sixteen numbers, by player and model."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        found.setdefault(row["player"], {}).setdefault(row["model"], []).append(row["deviation"])
    return {name: {m: round(float(np.median(d)), 3) for m, d in by.items()} for name, by in found.items()}


def write(folder: Path, rows: list[Row], lengths: list[Row]) -> None:
    """calibration.csv, calibration_rallies.csv, calibration.json and calibration.png; prints the medians."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (("calibration.csv", rows), ("calibration_rallies.csv", lengths)):
        with replacing(folder / name) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, content[0])
            writer.writeheader()
            writer.writerows(content)
    content = {"medians": medians_of(rows), "numbers": rows, "rallies": lengths}
    with replacing(folder / "calibration.json") as temporary:
        temporary.write_text(json.dumps(content, indent=1))
    with matplotlib.rc_context(STYLE), replacing(folder / "calibration.png") as temporary:
        draw(rows, lengths).savefig(temporary, format="png", dpi=110)
    print(json.dumps(content["medians"], indent=1))


def draw(rows: list[Row], lengths: list[Row]) -> Figure:
    """Target and reached intervals of every player, model and quantity, and the rally lengths."""
    found = {(r["player"], r["model"], r["number"]): r for r in rows}
    players = list(dict.fromkeys(r["player"] for r in rows))
    figure = Figure(figsize=(12.5, 9.5))
    *panels, last = figure.subplots(3, 3).flat
    for axes, quantity in zip(panels, QUANTITIES, strict=True):
        for p, player in enumerate(players):
            for m, model in enumerate(ROUNDS):
                low, high = (found[player, model, f"{quantity} {end}"] for end in ("min", "max"))
                for shift, (kind, colour) in zip((-0.2, 0.2), COLOURS.items(), strict=True):
                    axes.vlines(3.4 * p + m + shift, low[kind], high[kind], color=colour, linewidth=4)
        axes.set_title(f"{quantity} [{'m/s' if quantity.startswith('velocity') else 'm'}]")
        labels = [f"{m}\n{p[-1]}" if m == "M1" else m for p in players for m in ROUNDS]
        axes.set_xticks([3.4 * p + m for p in range(len(players)) for m in range(3)], labels, fontsize=7)
    one = {(r["player"], r["statistic"]): r for r in lengths}
    for p, player in enumerate(players):
        for shift, (kind, colour) in zip((-0.2, 0.2), COLOURS.items(), strict=True):
            p25, mean, p75 = (one[player, statistic][kind] for statistic in ("p25", "mean", "p75"))
            last.vlines(p + shift, p25, p75, color=colour, linewidth=8)
            last.plot(p + shift, mean, "o", color="white", markeredgecolor="black", markersize=5)
    last.set_xticks(range(len(players)), [p[-1] for p in players])
    last.set_title("rally length: quartiles and mean")
    names = {"target": "the paper's player", "reached": "virtual player"}
    add_legend(figure, [line(label, COLOURS[kind], linewidth=4) for kind, label in names.items()])
    return figure


if __name__ == "__main__":
    main()
