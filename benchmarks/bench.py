"""The benchmark: physics against other engines, the time of an update, memory, growth with the batch.

    python -m benchmarks.bench --out bench.json

Everything is measured in one run; sides that are compared take turns, and medians are compared. This process itself
never starts JAX, so it disturbs nobody and its own memory is in no figure.
"""

from __future__ import annotations

import json
import os
import platform
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from ballmodel.io.atomic_files import replacing
from benchmarks.harness import Sides, WorkerError, print_table, run, summary


@dataclass(frozen=True)
class Sizes:
    """Amounts of what is measured.

    rounds       runs of each side
    fused, mjx   (lanes, chunks, physics steps): batches of that many robots one after the other on each device
    rollout      (robots, physics steps) of MuJoCo C
    pairs, repeats   of the update
    engines, turns   (pairs, repeats) of an update with each engine, and its runs
    scaling      (pairs, repeats) of updates from small to large
    """

    rounds: int = 7
    fused: tuple[int, int, int] = (768, 4, 200)
    mjx: tuple[int, int, int] = (256, 1, 200)
    rollout: tuple[int, int] = (512, 200)
    pairs: int = 200
    repeats: int = 15
    engines: tuple[int, int] = (200, 15)
    turns: int = 2
    scaling: tuple[tuple[int, int], ...] = ((2, 15), (8, 15), (20, 15), (50, 15), (200, 15), (800, 15))


FULL = Sizes()
QUICK = Sizes(
    rounds=3,
    fused=(768, 1, 100),
    mjx=(256, 1, 40),
    rollout=(256, 100),
    engines=(20, 15),
    turns=1,
    scaling=((2, 15), (20, 15)),
)
PHYSICS = ("fused", "fused_by_xla", "mjx", "mujoco_rollout")
MJX_LIMIT = 1800.0  # [s] for compilation and first update with MJX, and for each further one


def main(*, out: Path | None = None, quick: bool = False) -> None:
    """Measures and prints the tables.

    Args:
        out: file of all figures, as JSON
        quick: fewer and shorter runs: a first impression in two minutes
    """
    report = measure(QUICK if quick else FULL)
    show(report)
    if out is not None:
        with replacing(out) as temporary:
            temporary.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
        print(out)


def measure(sizes: Sizes) -> dict[str, Any]:
    """All figures as plain data. Raises WorkerError when a side does not start."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    report: dict[str, Any] = {"cpu": processor(), "cores": len(cores), "python": platform.python_version()}
    print("physics steps per second of the robot alone ...")
    report |= measure_physics(sizes, len(cores))
    print(f"one update: {2 * sizes.pairs} perturbations x {sizes.repeats} episodes ...")
    report |= measure_update(sizes, cores)
    pairs, repeats = sizes.engines
    print(f"one update of {2 * pairs * repeats:,} episodes with each engine (MJX takes minutes) ...")
    report["engines"] = measure_engines(pairs, repeats, sizes.turns)
    print("updates by number of episodes ...")
    report["batch_scaling"] = [measure_batch(*size, min(sizes.rounds, 5)) for size in sizes.scaling]
    return report


def measure_physics(sizes: Sizes, cores: int) -> dict[str, Any]:
    """Physics steps per second by engine, on all cores, and the ratios of fused to the others."""
    with Sides() as sides:
        for name, (lanes, chunks, steps) in {
            "fused": sizes.fused,
            "fused_by_xla": sizes.fused,
            "mjx": sizes.mjx,
        }.items():
            sides.add(name, name, lanes=lanes, chunks=chunks, steps=steps)
        robots, steps = sizes.rollout
        sides.add("mujoco_rollout", "mujoco_rollout", robots=robots, steps=steps, threads=cores)
        measured = sides.measure(sizes.rounds)
    speed = {name: median(amount / seconds for seconds, amount in runs) for name, runs in measured.items()}
    return {
        "device": sides.about["fused"]["device"],
        "versions": {name: content["version"] for name, content in sides.about.items()},
        "physics_steps_per_s": {name: speed.get(name) for name in PHYSICS},
        "ratios": {f"fused/{name}": speed["fused"] / speed[name] for name in speed if name != "fused"},
    }


def scale(pairs: int, repeats: int) -> list[str]:
    """Changes of an experiment that give an update this size."""
    return [f"optimiser.num_directions={pairs}", f"optimiser.repeats={repeats}"]


def seconds_of(runs: list[tuple[float, float]]) -> dict[str, float]:
    """Summary of the seconds of runs."""
    return summary([seconds for seconds, _ in runs])


def measure_update(sizes: Sizes, cores: list[int]) -> dict[str, Any]:
    """Seconds per update at the start of training, by number of devices; peak memory."""
    n, size = len(cores), scale(sizes.pairs, sizes.repeats)
    with Sides() as sides:
        sides.add("all_devices", "update", changes=size, devices=n)
        sides.add("by_xla", "update", changes=[*size, "task.lanes=false"], devices=n)
        common = "optimiser.common_random_numbers=true"
        sides.add("common_random_numbers", "update", changes=[*size, common], devices=n)
        sides.add("one_device_all_cores", "update", changes=size, devices=1)
        sides.add("one_device_one_core", "update", [{cores[0]}], changes=size, devices=1)
        seconds = {name: seconds_of(runs) for name, runs in sides.measure(sizes.rounds).items()}
    devices = {name: seconds[name]["median"] for name in ("one_device_one_core", "one_device_all_cores", "all_devices")}
    return {
        "update_episodes": 2 * sizes.pairs * sizes.repeats,
        "update_s": seconds["all_devices"],
        "update_by_xla_s": seconds["by_xla"],
        "lanes_speedup": seconds["by_xla"]["median"] / seconds["all_devices"]["median"],
        "update_common_random_numbers_s": seconds["common_random_numbers"],
        "devices_s": devices,
        "devices_speedup": devices["one_device_one_core"] / devices["all_devices"],
        "peak_memory_mb": sides.peak_memory("all_devices"),
    }


def measure_engines(pairs: int, repeats: int, rounds: int) -> dict[str, Any] | None:
    """Time and memory of an update with each engine, all devices; None where MJX exceeds MJX_LIMIT or the memory."""
    try:
        with Sides() as sides:
            for engine in ("fused", "mjx"):
                changes = [*scale(pairs, repeats), f"task.engine={engine}"]
                sides.add(engine, "update", limit=MJX_LIMIT, changes=changes)
            measured = sides.measure(rounds)
    except WorkerError as error:
        print(error)
        return None
    return {
        "episodes": 2 * pairs * repeats,
        "update_s": {name: seconds_of(runs) for name, runs in measured.items()},
        "peak_memory_mb": {name: sides.peak_memory(name) for name in measured},
    }


def measure_batch(pairs: int, repeats: int, rounds: int) -> dict[str, Any]:
    """Time of an update and of its roll-outs, all devices, by the number of episodes."""
    with Sides() as sides:
        for name in ("update", "rollout"):
            sides.add(name, name, changes=scale(pairs, repeats))
        seconds = {name: seconds_of(runs)["median"] for name, runs in sides.measure(rounds).items()}
    episodes = 2 * pairs * repeats
    return {
        "episodes": episodes,
        "update_s": seconds["update"],
        "rollout_s": seconds["rollout"],
        "us_per_episode": seconds["update"] / episodes * 1e6,
        "peak_memory_mb": sides.peak_memory("update"),
    }


def processor() -> str:
    """Name of the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def show(report: dict[str, Any]) -> None:
    """The figures as tables."""
    print(f"\n{report['cpu']}, {report['cores']} cores; JAX on {report['device']}")
    ratios = {name: report["ratios"].get(f"fused/{name}") for name in report["physics_steps_per_s"]}
    rows: list[tuple[Any, ...]] = [
        (name, f"{speed:,.0f}" if speed else "not installed", ratios[name] and f"{ratios[name]:.1f} x")
        for name, speed in report["physics_steps_per_s"].items()
    ]
    print_table("Robot alone, physics steps per second", ("engine", "steps/s", "fused is faster by"), rows)

    updates = {
        "start of training": "update_s",
        "control steps by XLA": "update_by_xla_s",
        "common random numbers": "update_common_random_numbers_s",
    }
    rows = [(name, *_spread(report[key])) for name, key in updates.items()]
    rows += [(name.replace("_", " "), f"{seconds:.3f}") for name, seconds in report["devices_s"].items()]
    print_table(f"One update, {report['update_episodes']:,} episodes", ("", "median [s]", "min", "max"), rows)
    print(f"lane by lane against by XLA: {report['lanes_speedup']:.2f} x")
    print(f"all devices against one device on one core: {report['devices_speedup']:.2f} x")
    print(f"peak memory {report['peak_memory_mb']:,.0f} MB")

    if engines := report["engines"]:
        memory = engines["peak_memory_mb"]
        rows = [(name, *_spread(found), f"{memory[name]:,.0f}") for name, found in engines["update_s"].items()]
        title = f"One update of {engines['episodes']:,} episodes by engine"
        print_table(title, ("engine", "median [s]", "min", "max", "peak memory [MB]"), rows)

    columns = {
        "episodes": ",",
        "update_s": ".4f",
        "rollout_s": ".4f",
        "us_per_episode": ".1f",
        "peak_memory_mb": ",.0f",
    }
    rows = [tuple(format(row[key], form) for key, form in columns.items()) for row in report["batch_scaling"]]
    print_table("Batch", ("episodes", "update [s]", "roll-outs [s]", "us per episode", "peak memory [MB]"), rows)


def _spread(seconds: dict[str, float]) -> list[str]:
    return [f"{seconds[key]:.3f}" for key in ("median", "min", "max")]


if __name__ == "__main__":
    run(main)
