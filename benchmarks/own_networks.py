"""Cost of a user's networks beside the paper's: ``python -m benchmarks.own_networks my_task.py [--devices 1]``.

Random policies of each network play the same episodes; the paper's network and the user's take turns.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from ballmodel import registry
from ballmodel.sampling import sample_pool
from benchmarks.harness import run
from mjx_tt import platform
from mjx_tt.env import user_defined
from mjx_tt.env.network import Network
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import SimModel
from robot_io.contract import N_OBSERVATION, n_parameters

COLUMNS, REPEATS = 200, 10
ROUNDS = 5


def main(definitions: Path, *, devices: int = 1) -> None:
    """Measures and prints episodes per second of each network in the file."""
    platform.configure(devices=devices)
    simulator = Simulator(TaskConfig(sim_rate=150.0), devices)
    model = SimModel()
    pool = sample_pool(jax.random.key(0), registry.resolve("player3/M0"), model.ball, 4096)
    networks: dict[str, Network | None] = {"the paper's": None}
    networks |= user_defined.load(definitions.read_text(encoding="utf-8"), str(definitions)).networks
    calls = {name: prepared(simulator, network, pool, model) for name, network in networks.items()}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            began = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - began)
    base = float(np.median(seconds["the paper's"]))
    for name, taken in seconds.items():
        size = n_parameters() if networks[name] is None else networks[name].size
        middle = float(np.median(taken))
        rate = COLUMNS * REPEATS / middle
        print(f"{name}: {size} parameters, {rate:,.0f} episodes/s, {middle / base:.2f} x the paper's time")


def prepared(simulator: Simulator, network: Network | None, pool: object, model: SimModel) -> Callable[[], None]:
    """One rollout of COLUMNS random policies, compiled and called once."""
    key = jax.random.key(1)
    size = n_parameters() if network is None else network.size
    keys = jax.random.split(key, COLUMNS)
    theta = jnp.stack([initial_theta(k, 0.02, size) for k in keys], axis=-1)  # all near rest: the same episodes
    policy = Policy(theta, jnp.zeros(N_OBSERVATION), jnp.ones(N_OBSERVATION), network)

    def play(policy: Policy, pool: object) -> jax.Array:
        episodes = simulator.draw(key, pool, model, (), REPEATS, COLUMNS)  # type: ignore[arg-type]
        mine = replace(policy, theta=simulator.local(policy.theta))
        return jax.lax.psum(simulator.rollout(mine, simulator.local(episodes)).returns.sum(), "perturbation")

    compiled = jax.jit(simulator.on_devices(play, out_specs=PartitionSpec()))
    arguments = simulator.replicate((policy, pool))
    jax.block_until_ready(compiled(*arguments))

    def call() -> None:
        jax.block_until_ready(compiled(*arguments))

    return call


if __name__ == "__main__":
    run(main)
