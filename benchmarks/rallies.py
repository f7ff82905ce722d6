"""Rallies per second: ``python -m benchmarks.rallies [--policy runs/quickstart] [--rallies 1000]``.

All rallies are played to their ends in one compiled call, by five virtual players in turn against one policy; without
``--policy`` an untrained one, whose rallies are short. Compilation and a first call are not counted.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from experiments.runs import load_policy as policies
from mjx_tt import platform
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.task import TaskConfig
from mjx_tt.rally import human_player
from mjx_tt.rally.end_reasons import End
from mjx_tt.rally.simulator import RallySimulator
from mjx_tt.sim.model import SimModel
from robot_io.contract import N_OBSERVATION

LANES = 200  # side by side; each plays its share one rally after the other
RUNS = 3  # of which the fastest counts


def main(arguments: list[str] | None = None) -> int:
    """Measures and prints; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", help="run or artefact")
    parser.add_argument("--rallies", type=int, default=1000)
    parser.add_argument("--lanes", type=int, default=LANES)
    parser.add_argument("--sim-rate", type=float, default=150.0, help="Hz")
    chosen = parser.parse_args(arguments)
    platform.configure(devices=1)
    if chosen.policy:
        policy = policies.load(chosen.policy).policy
    else:
        policy = Policy(initial_theta(jax.random.key(0)), np.zeros(N_OBSERVATION), np.ones(N_OBSERVATION))
    each = -(-chosen.rallies // chosen.lanes)
    names = human_player.names()
    people = human_player.stack([human_player.load(names[lane % len(names)]) for lane in range(chosen.lanes)])
    policy = jax.tree.map(jnp.asarray, policy.astype(np.float32))
    policy = replace(policy, theta=jnp.repeat(policy.theta[:, None], chosen.lanes, axis=1))
    simulator = RallySimulator(TaskConfig(sim_rate=chosen.sim_rate))

    def play(seed: int) -> tuple[float, np.ndarray, np.ndarray, float]:
        began = time.perf_counter()
        result = simulator.play(policy, people, SimModel(), jax.random.key(seed), each)
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
    return 0


if __name__ == "__main__":
    sys.exit(main())
