"""Rallies per second: ``python -m benchmarks.rallies [--policy runs/quickstart] [--rallies 1000]``.

All rallies are played to their ends in one compiled call, by five virtual players in turn against one policy; without
``--policy`` an untrained one, whose rallies are short. Compilation and a first call are not counted.
"""

from __future__ import annotations

import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import run
from experiments.runs import load_policy as policies
from mjx_tt import platform
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.task import TaskConfig
from mjx_tt.rally import human_player
from mjx_tt.rally.end_reasons import End
from mjx_tt.rally.simulator import RallySimulator
from mjx_tt.sim.model import SimModel
from robot_io.contract import N_OBSERVATION

RUNS = 3  # of which the fastest counts


def main(*, policy: str | None = None, rallies: int = 1000, lanes: int = 200, sim_rate: float = 150.0) -> None:
    """Measures and prints rallies per second.

    Args:
        policy: run or artefact
        lanes: rallies side by side; each lane plays its share one after the other
        sim_rate: [Hz] of the physics
    """
    platform.configure(devices=1)
    if policy:
        played_by = policies.load(policy).policy
    else:
        played_by = Policy(initial_theta(jax.random.key(0)), np.zeros(N_OBSERVATION), np.ones(N_OBSERVATION))
    each = -(-rallies // lanes)
    names = human_player.names()
    people = human_player.stack([human_player.load(names[lane % len(names)]) for lane in range(lanes)])
    played_by = jax.tree.map(jnp.asarray, played_by.astype(np.float32))
    played_by = replace(played_by, theta=jnp.repeat(played_by.theta[:, None], lanes, axis=1))
    simulator = RallySimulator(TaskConfig(sim_rate=sim_rate))

    def play(seed: int) -> tuple[float, np.ndarray, np.ndarray, float]:
        began = time.perf_counter()
        result = simulator.play(played_by, people, SimModel(), jax.random.key(seed), each)
        length, end = np.asarray(result.length), np.asarray(result.end)
        return time.perf_counter() - began, length, end, float(result.seconds.sum())

    compiled, *_ = play(0)
    seconds, length, end, played = min(
        (play(seed) for seed in range(1, RUNS + 1)), key=lambda run: run[0] / run[1].sum()
    )
    print(
        f"{length.size} rallies, {length.sum()} touches, {played:.0f} s of play in one compiled call of "
        f"{seconds:.2f} s on {jax.devices()[0].platform}: {length.size / seconds:.0f} rallies/s, "
        f"{length.sum() / seconds:.0f} touches/s, {played / seconds:.0f} x real time; "
        f"the first call, with its compilation, took {compiled:.0f} s"
    )
    print(f"length {length.mean():.1f} on average, {length.max()} at most; ended by:")
    for row, count in zip(*np.unique(end, return_counts=True), strict=True):
        print(f"  {count / end.size:6.1%}  {End(row).name.lower().replace('_', ' ')}")


if __name__ == "__main__":
    run(main)
