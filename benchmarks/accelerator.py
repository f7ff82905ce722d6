"""An accelerator's updates: ``python -m benchmarks.accelerator [--out accelerator.json] [--seconds 3]``.

The update of ``paper.yaml`` from small to large, with loops over time as kernels and, for some sizes, left to XLA, and
its roll-outs alone; the update of ``robust.yaml`` by first-order gradients; the returns of the same 6,000 episodes on
the accelerator and, in a process of its own, on the processor. Runs on whatever JAX finds, a processor as well.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks import sides
from benchmarks.harness import run

PAPER = ((200, 15), (800, 15), (3200, 15), (12800, 15))  # pairs, repeats
BY_XLA = ((200, 15), (3200, 15))
ROLLOUTS = ((200, 15), (3200, 15))
FIRST_ORDER = (256, 4096, 32768)  # repeats of a pair
AGREEMENT = (200, 15)


def main(
    *, out: Path = Path("accelerator.json"), seconds: float = 3.0, returns: Path | None = None, most: int = 2**31
) -> None:
    """Measures, prints and writes.

    Args:
        seconds: of runs of each update, after its compilation
        returns: only write the returns of the compared episodes to this file
        most: episodes of an update; larger ones are left out
    """
    if returns:
        np.savez(returns, **play_compared())
        return
    report: dict[str, Any] = {"updates": []}

    def measured(name: str, make: Any) -> None:
        began = time.perf_counter()
        try:
            about, work = make()
            episodes = work()
        except Exception as error:  # such as memory that does not suffice; the other sizes are wanted all the same
            print(f"{name}: {type(error).__name__}: {str(error)[:200]}", flush=True)
            return
        compiling = time.perf_counter() - began
        spent: list[float] = []
        while len(spent) < 3 or sum(spent) < seconds:
            before = time.perf_counter()
            work()
            spent.append(time.perf_counter() - before)
        row = {"name": name, "episodes": episodes, "compiling": compiling, "seconds": median(spent), "runs": len(spent)}
        report.update(about)
        report["updates"].append(row)
        each = 1e6 * row["seconds"] / episodes
        print(
            f"{name}: {episodes:,} episodes, {1e3 * row['seconds']:.2f} ms "
            f"({1e3 * min(spent):.2f} to {1e3 * max(spent):.2f}, {len(spent)} runs), {each:.2f} us an episode, "
            f"ready after {compiling:.0f} s",
            flush=True,
        )
        out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")

    for by, what, sizes, make in (
        ("kernels", "roll-outs of paper.yaml", ROLLOUTS, sides.rollout),
        ("XLA", "roll-outs of paper.yaml", ROLLOUTS, sides.rollout),
        ("kernels", "paper.yaml", PAPER, sides.update),
        ("XLA", "paper.yaml", BY_XLA, sides.update),
    ):
        for pairs, repeats in sizes:
            if 2 * pairs * repeats <= most:
                changes = [f"optimiser.num_directions={pairs}", f"optimiser.repeats={repeats}"]
                changes += ["task.lanes=false"] if by == "XLA" else []
                measured(f"{what} by {by}, {pairs} pairs x {repeats}", lambda m=make, c=changes: m(c))
    for repeats in FIRST_ORDER:
        if 2 * repeats <= most:
            changes = [f"optimiser.repeats={repeats}"]
            measured(f"robust.yaml, first order, {repeats} repeats", lambda c=changes: sides.update(c, name="robust"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "returns.npz"
        command = [sys.executable, "-m", "benchmarks.accelerator", "--returns", str(path)]
        subprocess.run(command, check=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
        report["agreement"] = compared(play_compared(), dict(np.load(path)))
    out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(f"{report.get('device')}: {report['agreement']}\nwritten to {out}")


def play_compared() -> dict[str, np.ndarray]:
    """Returns and outcomes of the same episodes wherever they are played."""
    pairs, repeats = AGREEMENT
    result = sides.played([f"optimiser.num_directions={pairs}", f"optimiser.repeats={repeats}"])
    return {"returns": np.asarray(result.returns), "outcome": np.asarray(result.outcome)}


def compared(here: dict[str, np.ndarray], there: dict[str, np.ndarray]) -> dict[str, float]:
    """Share of outcomes alike, share of returns with the same bits, and their largest difference."""
    apart = np.abs(here["returns"] - there["returns"])
    return {
        "episodes": int(apart.size),
        "outcomes alike": float((here["outcome"] == there["outcome"]).mean()),
        "returns bit for bit": float((here["returns"] == there["returns"]).mean()),
        "largest difference of returns": float(apart.max()),
        "mean return here": float(here["returns"].mean()),
        "mean return there": float(there["returns"].mean()),
    }


if __name__ == "__main__":
    run(main)
