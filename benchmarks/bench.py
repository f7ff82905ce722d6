"""The benchmark: physics against other engines, the time of an update and where it goes, memory, growth with the batch.

    python -m benchmarks.bench --json bench.json

Everything is measured in one run; sides that are compared take turns, and medians are compared. This process itself
never starts JAX, so it disturbs nobody and its own memory is in no figure.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.table import Table

from ballmodel.io.atomic_files import replacing
from benchmarks.worker import Worker, WorkerError, summary, take_turns


@dataclass(frozen=True)
class Sizes:
    """Amounts of what is measured.

    rounds       runs of each side
    fused, mjx   (lanes, chunks, physics steps): batches of that many robots one after the other on each device
    rollout      (robots, physics steps) of MuJoCo C
    pybullet     physics steps of one robot per core
    pairs, repeats   of the update
    engines, turns   (pairs, repeats) of an update with each engine, and its runs
    scaling      (pairs, repeats) of updates from small to large
    block, ticks     rows x columns of episodes and control steps of the breakdown
    """

    rounds: int = 7
    fused: tuple[int, int, int] = (768, 4, 200)
    mjx: tuple[int, int, int] = (256, 1, 200)
    rollout: tuple[int, int] = (512, 200)
    pybullet: int = 20_000
    pairs: int = 200
    repeats: int = 15
    engines: tuple[int, int] = (200, 15)
    turns: int = 2
    scaling: tuple[tuple[int, int], ...] = ((2, 15), (8, 15), (20, 15), (50, 15), (200, 15), (800, 15))
    block: tuple[int, int] = (3, 200)  # as two devices run the update
    ticks: int = 100


FULL = Sizes()
QUICK = Sizes(
    rounds=3,
    fused=(768, 1, 100),
    mjx=(256, 1, 40),
    rollout=(256, 100),
    pybullet=4_000,
    engines=(20, 15),
    turns=1,
    scaling=((2, 15), (20, 15)),
    ticks=20,
)
PHYSICS = ("fused", "fused_by_xla", "mjx", "mujoco_rollout", "mujoco_batch", "pybullet")
MJX_LIMIT = 1800.0  # [s] for compilation and first update with MJX, and for each further one
TRAINED = Path("runs/quickstart")  # measured too when it is there


def main(console: Console, json_path: str | None = None, quick: bool = False) -> int:
    """Measures, prints the tables and writes the JSON; returns the exit status."""
    report = measure(QUICK if quick else FULL, console)
    show(report, console)
    if json_path is not None:
        with replacing(Path(json_path)) as temporary:
            temporary.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
        console.print(json_path, highlight=False)
    return 0


def measure(sizes: Sizes, console: Console) -> dict:
    """All figures as plain data. Raises WorkerError when a side does not start."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    report: dict[str, Any] = {"cpu": processor(), "cores": len(cores), "python": platform.python_version()}
    console.print("physics steps per second of the robot alone ...")
    report |= measure_physics(sizes, len(cores))
    console.print(f"one update: {2 * sizes.pairs} perturbations x {sizes.repeats} episodes ...")
    report |= measure_update(sizes, cores)
    pairs, repeats = sizes.engines
    console.print(f"one update of {2 * pairs * repeats:,} episodes with each engine (MJX takes minutes) ...")
    report |= measure_engines(pairs, repeats, sizes.turns, console)
    console.print("parts of a control step ...")
    rows, columns = sizes.block
    with Worker("breakdown", {cores[0]}, rows=rows, columns=columns, ticks=sizes.ticks) as worker:
        worker.wait_ready()
        found = _run(worker)
    report["breakdown"] = found.pop("parts")
    report["roofline"] = found
    report["batch_scaling"] = []
    for pairs, repeats in sizes.scaling:
        console.print(f"updates of {2 * pairs * repeats:,} episodes ...")
        report["batch_scaling"].append(measure_batch(pairs, repeats, min(sizes.rounds, 5)))
    return report


def _run(worker: Worker) -> Any:
    worker.start()
    return worker.finish()


def measure_physics(sizes: Sizes, cores: int) -> dict:
    """Physics steps per second by engine, on all cores, and the ratios of fused to the others."""
    with ExitStack() as stack:

        def side(name: str, copies: int = 1, **arguments: Any) -> list[Worker]:
            return [stack.enter_context(Worker(name, **arguments)) for _ in range(copies)]

        lanes, chunks, steps = sizes.fused
        sides = {name: side(name, lanes=lanes, chunks=chunks, steps=steps) for name in ("fused", "fused_by_xla")}
        lanes, chunks, steps = sizes.mjx
        sides["mjx"] = side("mjx", lanes=lanes, chunks=chunks, steps=steps)
        robots, steps = sizes.rollout
        sides["mujoco_rollout"] = side("mujoco_rollout", robots=robots, steps=steps, threads=cores)
        if importlib.util.find_spec("mujoco.batch"):  # since MuJoCo 3.17
            sides["mujoco_batch"] = side("mujoco_batch", robots=robots, steps=steps, threads=cores)
        if importlib.util.find_spec("pybullet"):
            sides["pybullet"] = side("pybullet", cores, steps=sizes.pybullet, seed=0)
        about = {name: [worker.wait_ready() for worker in workers][0] for name, workers in sides.items()}
        measured = take_turns(sides, sizes.rounds)
    speed = {name: median(amount / seconds for seconds, amount in runs) for name, runs in measured.items()}
    return {
        "device": about["fused"]["device"],
        "versions": {name: content["version"] for name, content in about.items()},
        "physics_steps_per_s": {name: speed.get(name) for name in PHYSICS},
        "ratios": {f"fused/{name}": speed["fused"] / speed[name] for name in speed if name != "fused"},
    }


def measure_update(sizes: Sizes, cores: list[int]) -> dict:
    """Seconds per update at the start of training and under a trained policy, by number of devices; peak memory."""
    scale = [f"optimiser.num_directions={sizes.pairs}", f"optimiser.repeats={sizes.repeats}"]
    n, common = len(cores), "optimiser.common_random_numbers=true"
    asked: dict[str, tuple[set[int] | None, dict[str, Any]]] = {
        "all_devices": (None, dict(changes=scale, devices=n)),
        "by_xla": (None, dict(changes=[*scale, "task.lanes=false"], devices=n)),
        "common_random_numbers": (None, dict(changes=[*scale, common], devices=n)),
        "one_device_all_cores": (None, dict(changes=scale, devices=1)),
        "one_device_one_core": ({cores[0]}, dict(changes=scale, devices=1)),
    }
    if TRAINED.is_dir():
        asked["trained_policy"] = (None, dict(changes=[*scale, f"initial_policy={TRAINED}"], devices=n))
    with ExitStack() as stack:
        sides = {
            name: [stack.enter_context(Worker("update", cpus, **arguments))]
            for name, (cpus, arguments) in asked.items()
        }
        for (worker,) in sides.values():
            worker.wait_ready()
        measured = take_turns(sides, sizes.rounds)
    seconds = {name: summary([s for s, _ in runs]) for name, runs in measured.items()}
    devices = {name: seconds[name]["median"] for name in ("one_device_one_core", "one_device_all_cores", "all_devices")}
    return {
        "update_episodes": 2 * sizes.pairs * sizes.repeats,
        "update_s": seconds["all_devices"],
        "update_by_xla_s": seconds["by_xla"],
        "lanes_speedup": seconds["by_xla"]["median"] / seconds["all_devices"]["median"],
        "update_common_random_numbers_s": seconds["common_random_numbers"],
        "update_trained_policy_s": seconds.get("trained_policy"),
        "devices_s": devices,
        "devices_speedup": devices["one_device_one_core"] / devices["all_devices"],
        "peak_memory_mb": round(sides["all_devices"][0].peak_memory, 1),
    }


def measure_engines(pairs: int, repeats: int, rounds: int, console: Console) -> dict:
    """Time and memory of an update with each engine, all devices; None where MJX exceeds MJX_LIMIT or the memory."""
    scale = [f"optimiser.num_directions={pairs}", f"optimiser.repeats={repeats}"]
    try:
        with ExitStack() as stack:
            sides = {
                engine: [
                    stack.enter_context(Worker("update", limit=MJX_LIMIT, changes=[*scale, f"task.engine={engine}"]))
                ]
                for engine in ("fused", "mjx")
            }
            for (worker,) in sides.values():
                worker.wait_ready()
            measured = take_turns(sides, rounds)
    except WorkerError as error:
        console.print(str(error), highlight=False)
        return {"engines": None}
    return {
        "engines": {
            "episodes": 2 * pairs * repeats,
            "update_s": {name: summary([s for s, _ in runs]) for name, runs in measured.items()},
            "peak_memory_mb": {name: round(worker.peak_memory, 1) for name, (worker,) in sides.items()},
        }
    }


def measure_batch(pairs: int, repeats: int, rounds: int) -> dict:
    """Time of an update and of its roll-outs, all devices, by the number of episodes."""
    changes = [f"optimiser.num_directions={pairs}", f"optimiser.repeats={repeats}"]
    with Worker("update", changes=changes) as update, Worker("rollout", changes=changes) as rollout:
        update.wait_ready(), rollout.wait_ready()
        measured = take_turns({"update": [update], "rollout": [rollout]}, rounds)
    seconds = {name: median(s for s, _ in runs) for name, runs in measured.items()}
    episodes = 2 * pairs * repeats
    return {
        "episodes": episodes,
        "update_s": seconds["update"],
        "rollout_s": seconds["rollout"],
        "us_per_episode": seconds["update"] / episodes * 1e6,
        "peak_memory_mb": round(update.peak_memory, 1),
    }


def processor() -> str:
    """Name of the processor."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def show(report: dict, console: Console) -> None:
    """The figures as tables."""
    console.print(f"\n{report['cpu']}, {report['cores']} cores; JAX on {report['device']}", highlight=False)
    table = _table("Robot alone, physics steps per second", "engine", "steps/s", "fused is faster by")
    for name, speed in report["physics_steps_per_s"].items():
        ratio = report["ratios"].get(f"fused/{name}")
        table.add_row(name, f"{speed:,.0f}" if speed else "not installed", f"{ratio:.1f} x" if ratio else "")
    console.print(table)

    table = _table(f"One update, {report['update_episodes']:,} episodes", "", "median [s]", "min", "max")
    rows = {
        "start of training": report["update_s"],
        "control steps by XLA": report["update_by_xla_s"],
        "common random numbers": report["update_common_random_numbers_s"],
        "trained policy": report["update_trained_policy_s"],
    }
    for name, seconds in rows.items():
        if seconds:
            table.add_row(name, *(f"{seconds[key]:.3f}" for key in ("median", "min", "max")))
    for name, seconds in report["devices_s"].items():
        table.add_row(name.replace("_", " "), f"{seconds:.3f}")
    console.print(table)
    console.print(f"lane by lane against by XLA: {report['lanes_speedup']:.2f} x", highlight=False)
    console.print(
        f"all devices against one device on one core: {report['devices_speedup']:.2f} x; "
        f"peak memory {report['peak_memory_mb']:,.0f} MB",
        highlight=False,
    )

    if report["engines"]:
        engines = report["engines"]
        title = f"One update of {engines['episodes']:,} episodes by engine"
        table = _table(title, "engine", "median [s]", "min", "max", "peak memory [MB]")
        for name, seconds in engines["update_s"].items():
            figures = (f"{seconds[key]:.3f}" for key in ("median", "min", "max"))
            table.add_row(name, *figures, f"{engines['peak_memory_mb'][name]:,.0f}")
        console.print(table)

    table = _table("Parts of a control step, one core", "part", "calls", "ns per episode", "share")
    for row in report["breakdown"]:
        table.add_row(row["part"], str(row["calls"]), f"{row['ns']:.0f}", f"{row['share']:.0%}")
    console.print(table)

    show_roofline(report["breakdown"], report["roofline"], console)

    table = _table("Batch", "episodes", "update [s]", "roll-outs [s]", "us per episode", "peak memory [MB]")
    for row in report["batch_scaling"]:
        table.add_row(
            f"{row['episodes']:,}",
            f"{row['update_s']:.4f}",
            f"{row['rollout_s']:.4f}",
            f"{row['us_per_episode']:.1f}",
            f"{row['peak_memory_mb']:,.0f}",
        )
    console.print(table)


def show_roofline(parts: list[dict], roofline: dict, console: Console) -> None:
    """Operations and bytes of each part per episode and control step, and the share of one core's peaks reached."""
    peaks = roofline["peaks"]
    title = "Roofline: an episode's control step, one core; shares of the peak and of the roof"
    table = _table(title, "part", "kernels", "op", "kB", "op/B", "Gop/s", "peak", "roof")
    for row in parts:
        if "operations" not in row:
            continue
        rate, intensity = row["operations"] / row["ns"], row["operations"] / row["bytes"]
        peak = peaks["fma_peak"] / 1e9
        roof = min(peak, intensity * peaks["cache_bandwidth"] / 1e9)
        table.add_row(
            row["part"],
            f"{row['kernels']:,.0f}",
            f"{row['operations']:,.0f}",
            f"{row['bytes'] / 1e3:.1f}",
            f"{intensity:.2f}",
            f"{rate:.1f}",
            f"{rate / peak:.0%}",
            f"{rate / roof:.0%}",
        )
    console.print(table)
    best = {name: f"{value / 1e9:.1f}" for name, value in peaks.items()}
    console.print(
        f"peaks: {best['fma_peak']} Gop/s in multiply-adds of float32 (XLA {best['fma_xla']}, NumPy's matrix product "
        f"{best['fma_blas']}); {best['cache_bandwidth']} GB/s at the {roofline['working_set_mb']:.1f} MB that a block "
        f"of episodes uses, {best['memory_bandwidth']} GB/s in memory",
        highlight=False,
    )


def _table(title: str, first: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(first)
    for column in columns:
        table.add_column(column, justify="right")
    return table


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m benchmarks.bench", description=__doc__.split("\n")[0])
    parser.add_argument("--json", metavar="FILE", help="write the figures as JSON")
    parser.add_argument(
        "--quick", action="store_true", help="fewer and shorter runs: a first impression in two minutes"
    )
    options = parser.parse_args()
    sys.exit(main(Console(), options.json, options.quick))
