"""Worth of the identification: ``python -m benchmarks.identification [--out runs/identification] [--realities 10]``.

In each of several hidden realities, every second one from outside of the model's class, a player's balls, a minute of
the joints and a hundred hits are logged and the simulation is identified. The shipped quickstart is trained on by
first-order gradients, as ``robust.yaml`` does it, in the nominal world, in the prior alone, in the identified worlds
without and with hits, and in the reality itself, on balls of the human model that is fitted to the logged balls, short
ones included; all five then play in the reality, on the same balls. Resumable: what is finished is kept, ``--show``
prints it.
"""

from __future__ import annotations

import time
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from ballmodel.distribution import save_distribution
from ballmodel.fit_distribution import fit_human
from ballmodel.flight import ball_params
from benchmarks.harness import each_missing, read_all, run
from experiments import measurements
from experiments.config import build, experiment, files
from experiments.config import study as studies
from experiments.runs import load_policy, run_dir
from experiments.runs.run_dir import Run
from experiments.stats import wilson
from experiments.study import identification
from experiments.study.analysis.identified import LOGS, holds, list_estimates
from experiments.study.target_domain import hidden_effects
from experiments.study.target_domain.lab_logs import record_hits, record_joints
from experiments.study.target_domain.virtual import VirtualReality
from experiments.training.loop import train
from mjx_tt import platform
from mjx_tt.env.episode import RETURNED
from mjx_tt.env.policy import Policy
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, SimModel

QUICKSTART = Path("experiments/shipped/policies/quickstart")
World = Literal["nominal", "prior", "identified", "hits", "truth"]
WORLDS: tuple[World, ...] = ("nominal", "prior", "identified", "hits", "truth")
CLASSES = ((), ("lift",), (), ("bounce",), (), ("blade",), (), ("mount",), (), ("lift", "bounce", "blade", "mount"))
BALLS = 4000  # of each evaluation
STROKES = 512  # from which the spin of a player's strokes is known
CAMERA_NOISE = 0.003  # [m]
BELIEVED = SimModel().latency.ball_observation  # [s]
SHARED = {"lift": ("flight",), "bounce": ("restitution",), "blade": ("paddle.restitution",), "mount": ()}


def main(
    *,
    out: Path = Path("runs/identification"),
    realities: int = 10,
    first: int = 0,
    updates: int = 600,
    player: str = "player3",
    balls: int = 300,
    seconds: float = 60.0,
    worlds: tuple[World, ...] = WORLDS,
    show: bool = False,
) -> int:
    """Measures, prints and writes; returns the exit status.

    Args:
        first: seed of the first reality
        updates: of 512 balls, of each training
        balls: across the table, before the first play
        seconds: of the joints' motion
        worlds: to train in
        show: only print what is finished
    """
    platform.configure(devices=1)
    for seed, path in () if show else each_missing(out, "reality", range(first, first + realities)):
        # In a process of its own: a dozen compiled programs each, and a process may map only so many of them.
        given = (
            path,
            seed,
            updates,
            player,
            (balls, seconds),
            tuple(w for w in WORLDS if w in worlds),
        )
        process = get_context("spawn").Process(target=_one, args=given)
        process.start()
        process.join()
        if process.exitcode:
            raise SystemExit(f"reality {seed}: the process ended with {process.exitcode}; run it again to go on")
    found = read_all(out, "reality")
    if not found:
        print(f"{out}: no reality is finished")
        return 1
    text = summary(found)
    (out / "summary.txt").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


def _one(
    path: Path, seed: int, updates: int, player: str, logged: tuple[int, float], worlds: tuple[World, ...]
) -> None:
    platform.configure(devices=1)
    run_dir.write_json(path, of_reality(path.parent, seed, updates, player, logged, worlds))


def of_reality(
    out: Path, seed: int, updates: int, player: str, logged: tuple[int, float], trained_in: tuple[World, ...]
) -> dict[str, Any]:
    """Logs, identification, trainings and evaluations of one reality."""
    outside = CLASSES[seed % len(CLASSES)]
    rounds = [{"simulated": 1, "real": 1}] * 3
    study = studies.parse(
        {"name": "x", "simulation": {"rounds": rounds}, "reality": {"outside": list(outside)}}, "study"
    )
    reality, folder = VirtualReality(study, seed), out / f"logs_{seed}"
    person, whole = reality.player(player), jax.random.key(seed)
    keys = [*jax.random.split(whole, 6), jax.random.fold_in(whole, 6)]
    measurements.write_csv(_made(folder) / "D0.csv", reality.first_balls(person, logged[0], keys[0], "D0"))
    records = record_joints(reality.simulator.task, reality.known, keys[1], logged[1])
    identification.write_joints(folder / "joints", records)
    policy = load_policy.load(QUICKSTART).policy
    log = record_hits(reality.simulator, reality.known, person, policy, keys[2], "hits", CAMERA_NOISE, BELIEVED)
    identification.write_hits(folder / "hits", log.balls, log.joints)
    prior = identification.read_prior(studies.PRIOR, "prior")
    worlds = {"nominal": ModelFile(SimModel()), "prior": ModelFile(SimModel(), prior)}
    seconds: dict[str, float] = {}
    logs = [folder / "D0.csv", folder / "joints"]
    counts = {}
    for name, hits in (("identified", ()), ("hits", (folder / "hits",))):
        began = time.monotonic()
        world = identification.identify(logs, 400, ModelFile(SimModel()), prior, hits)
        seconds[name], worlds[name] = time.monotonic() - began, world
        counts[name] = (world.provenance or {})["identified"]["hits"]
        world.save(folder / f"{name}.yaml")
    worlds["truth"] = ModelFile(add_spin(reality, player, keys[6]))
    base = {
        "seed": seed,
        "outside": list(outside),
        "reality": hidden_effects.list_differences(reality.model),
        "hits": counts["hits"],
        "identification_seconds": seconds,
        "intervals": {name: intervals(worlds[name], reality.model) for name in ("identified", "hits")},
    }
    human, _ = fit_human(measurements.read_trajectories([folder / "D0.csv"]), ball_params(), short_balls=True)
    save_distribution(folder / "M0.yaml", human)
    policies: dict[str, Policy] = {
        name: trained(out / "runs" / f"{name}_{seed}", worlds[name], updates, folder / "M0.yaml") for name in trained_in
    }
    policies["quickstart"] = policy
    played = {name: returned(reality, person, reality.known, p, keys[3]) for name, p in policies.items()}
    return base | {
        "returned": {name: _rate(x) for name, x in played.items()},
    }


def add_spin(reality: VirtualReality, player: str, key: jax.Array) -> SimModel:
    """The reality's model with mean and spread of the spin of a player's strokes."""
    state = reality.simulator.start(reality.player(player), reality.known, key, STROKES)
    spin = np.asarray(state.ball.spin)
    mean, std = (
        {f"ball_spin.{kind}_{axis}": float(x) for axis, x in zip("xyz", values, strict=True)}
        for kind, values in (("mean", spin.mean(axis=1)), ("std", spin.std(axis=1)))
    )
    return models.with_values(reality.model, mean | std)


def trained(folder: Path, world: ModelFile, updates: int, human: Path) -> Policy:
    """The quickstart after so many updates in a world, on balls of a human model."""
    _made(folder)
    world.save(folder.parent / f"{folder.name}.yaml")
    overrides = (
        f"balls={human}",
        f"model={folder.parent / f'{folder.name}.yaml'}",
        f"training.updates={updates}",
        "training.evaluate_every=null",
        "training.devices=1",
    )
    config = experiment.load(files.find_shipped("robust", "train"), overrides)
    made, run = build.experiment(config, folder.name), Run(folder)
    if not run.trained(made.config):
        train(made, run, Console(quiet=True))
    return load_policy.load(folder).policy


def returned(reality: VirtualReality, person: Any, model: SimModel, policy: Policy, key: jax.Array) -> np.ndarray:
    """Which of the same BALLS first balls of the player are returned in a world, (BALLS,)."""
    start_key, key = jax.random.split(key)
    wide = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x, jnp.float32)[..., None], BALLS, axis=-1), policy)
    # The player aims in the reality whatever the world: the balls are the same.
    state = reality.simulator.start(person, reality.known, start_key, BALLS)
    _, shots = reality.simulator.shots(wide, person, model, state, key)
    return np.asarray((shots.outcome == RETURNED) & shots.finite)


def intervals(world: ModelFile, reality: SimModel) -> dict[str, list[float]]:
    """Truth, low and high end of the 90 % interval of every parameter that the logs decided.

    Delays as sums or differences, which is all that logs and play show.
    """
    rows = list_estimates(world, hidden_effects.list_differences(reality))
    decided = [row for row in rows if row["decided by"] == LOGS and holds(row) is not None]
    return {row["parameter"]: [row["truth"], row["low"], row["high"]] for row in decided}


def summary(found: list[dict[str, Any]]) -> str:
    """Returned shares by reality and world, and by class the medians and the coverage of the intervals."""
    worlds: list[str] = [w for w in WORLDS if all(w in one["returned"] for one in found)]
    lines = ["seed class " + " ".join(f"{w:>16s}" for w in worlds)]
    for one in found:
        rates = [one["returned"][world] for world in worlds]
        cells = " ".join(f"{100 * r['rate']:5.1f} ({100 * r['low']:4.1f}-{100 * r['high']:4.1f})" for r in rates)
        lines.append(f"{one['seed']:4d} {'+'.join(one['outside']) or 'in':24s} {cells}")
    for title, outside in (("in class", False), ("outside", True)):
        some = [one for one in found if bool(one["outside"]) == outside]
        if some:
            lines += _of_class(title, some, worlds)
    seconds = ", ".join(f"{f['identification_seconds']['identified']:.0f}" for f in found)
    with_hits = ", ".join(f"{f['identification_seconds']['hits']:.0f}" for f in found)
    lines.append(f"seconds of identification: {seconds}; with hits, compiled or not: {with_hits}")
    return "\n".join(lines)


def _of_class(title: str, some: list[dict[str, Any]], worlds: list[str]) -> list[str]:
    rate = {w: np.array([100 * f["returned"][w]["rate"] for f in some]) for w in (*worlds, "quickstart")}
    medians = ", ".join(f"{w} {np.median(x):.1f}" for w, x in rate.items())
    lines = [f"{title}, {len(some)} realities, median returned [%]: {medians}"]
    for w in ("identified", "hits") if {"identified", "hits", "truth", "prior"} <= set(worlds) else ():
        gap, gain = rate["truth"] - rate[w], rate[w] - rate["prior"]
        lines.append(
            f"  {w}: {np.median(gap):.1f} points below the true world in the median ({gap.min():.1f} to "
            f"{gap.max():.1f}); above the prior alone in {int((gain > 0).sum())} of {len(some)}, by "
            f"{np.median(gain):.1f} in the median"
        )
        lines += [f"    {line}" for line in coverage(some, (w,))]
    return lines


def coverage(some: list[dict[str, Any]], worlds: tuple[str, ...]) -> list[str]:
    """Share of the truths in their 90 % intervals, over all parameters that the logs decided."""
    lines = []
    for w in worlds:
        hold: dict[str, list[bool]] = {}
        for f in some:
            changed = [part for effect in f["outside"] for part in SHARED[effect]]
            for path, (truth, low, high) in f["intervals"][w].items():
                if not any(part in path for part in changed):
                    hold.setdefault(path, []).append(low <= truth <= high)
        inside, total = sum(map(sum, hold.values())), sum(map(len, hold.values()))
        low, high = wilson(inside, total)
        worst = sorted(hold, key=lambda path: sum(hold[path]) - len(hold[path]))[:8]
        missed = ", ".join(f"{path} {hold[path].count(False)}" for path in worst if not all(hold[path]))
        share = f"{inside / total:.0%} ({low:.0%}-{high:.0%})"
        lines.append(f"{w}: {inside} of {total} truths in 90 % intervals, {share}; missed most: {missed or 'none'}")
    return lines


def _rate(x: np.ndarray) -> dict[str, float]:
    low, high = wilson(int(x.sum()), x.size)
    return {"rate": float(x.mean()), "low": low, "high": high}


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


if __name__ == "__main__":
    run(main)
