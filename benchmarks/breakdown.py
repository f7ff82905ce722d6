"""Cost of a control step: its parts one by one, at the size of a block of episodes, beside the peaks of the core.

Each part runs in a loop of its own whose state depends on its results, so that nothing is hoisted or dropped.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ballmodel import flight, registry
from ballmodel.flight import PaddlePose, ball_params
from ballmodel.sampling import sample_pool
from ballmodel.state import BallState
from benchmarks import roofline
from benchmarks.operations import count, count_lanes
from mjx_tt.env.episode import EpisodeConstants, Episodes, EpisodeState
from mjx_tt.env.policy import PolicyController, initial_theta
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import Task, TaskConfig
from mjx_tt.lanes import loop, machine
from mjx_tt.lanes.loop import while_any
from mjx_tt.robot.scalar_algebra import optimization_barrier
from mjx_tt.sim import latency, noise
from mjx_tt.sim.model import SimModel
from robot_io.contract import LIMITS, N_JOINTS, N_OBSERVATION, unflatten
from robot_io.limits import limit_velocity

WHOLE = "control step"
BY_LANES = "control step by lanes"
RUNS = 5  # of each part, of which the fastest counts: the others were disturbed


def time_parts(rows: int, columns: int, ticks: int) -> Callable[[], dict]:
    """Compiles the parts for a block of rows x columns episodes; the function returned measures them.

    "parts", each: part, calls per control step, ns per episode and control step, share of the whole; operations,
    transcendentals and bytes of the compiled program, likewise; its kernels per control step of the block. "rest" is
    the whole less the parts, and can be negative where a part alone costs more than in its place. "peaks": what the
    core reaches at best, see ``roofline.measure``; "working_set_mb": arguments and temporaries of the whole. All of
    them are compiled by XLA but for the last row, the whole compiled lane by lane.
    """
    config = TaskConfig()
    parts = _parts(config, rows, columns)
    loops = {name: (calls, *_compiled(step, start, ticks)) for name, (calls, step, start) in parts.items()}

    counts = {name: calls / ticks / (rows * columns) * count(run) for name, (calls, run, _) in loops.items()}
    counts = {name: replace(each, kernels=each.kernels * rows * columns) for name, each in counts.items()}
    by_lanes = _by_lanes(config, rows, columns, ticks)
    lane_counts = count_lanes(str(machine.optimised(loop.compiled()[-1])), rounds=config.substeps)
    memory = loops[WHOLE][1].memory_analysis()
    working_set = memory.argument_size_in_bytes + memory.temp_size_in_bytes
    peaks = roofline.measure(working_set)

    def measure() -> dict:
        nanoseconds = {}
        for name, (calls, run, start) in loops.items():
            fastest = min(_seconds(run, start) for _ in range(RUNS))
            nanoseconds[name] = calls * fastest / ticks / (rows * columns) * 1e9
        whole = nanoseconds.pop(WHOLE)
        table: list[dict[str, Any]] = [
            {"part": name, "calls": loops[name][0], "ns": ns, **asdict(counts[name])}
            for name, ns in nanoseconds.items()
        ]
        table.append({"part": "rest", "calls": 1, "ns": whole - sum(nanoseconds.values())})
        table.append({"part": WHOLE, "calls": 1, "ns": whole, **asdict(counts[WHOLE])})
        fastest = min(_seconds(*by_lanes) for _ in range(RUNS))
        ns = fastest / ticks / (rows * columns) * 1e9
        table.append({"part": BY_LANES, "calls": 1, "ns": ns, **asdict(lane_counts)})
        parts = [row | {"share": row["ns"] / whole} for row in table]
        return {"parts": parts, "peaks": peaks(), "working_set_mb": working_set / 1e6}

    return measure


def _compiled(step: Callable, start: Any, ticks: int) -> tuple[Callable, Any]:
    def loop(state: Any) -> Any:
        return jax.lax.fori_loop(0, ticks, lambda tick, s: optimization_barrier(step(tick, s)), state)

    start = jax.block_until_ready(jax.tree.map(jnp.asarray, start))
    run = jax.jit(loop).lower(start).compile()
    _seconds(run, start)
    return run, start


def _seconds(run: Callable, start: Any) -> float:
    began = time.perf_counter()
    jax.block_until_ready(run(start))
    return time.perf_counter() - began


def _block(
    config: TaskConfig, rows: int, columns: int
) -> tuple[Task, Episodes, EpisodeConstants, PolicyController, EpisodeState]:
    """A block of episodes of random policies: what the loop over time needs, and their first state."""
    simulator, lanes = Simulator(config), rows * columns
    task = simulator.task
    pool = sample_pool(jax.random.key(0), registry.resolve("player3/M0"), ball_params(), 1024)
    episodes = jax.tree.map(
        lambda x: x.reshape(*x.shape[:-2], lanes) if x.ndim >= 2 else x,
        simulator.draw(jax.random.key(1), pool, SimModel(), (), rows, columns),
    )
    theta = jnp.stack([initial_theta(key) for key in jax.random.split(jax.random.key(2), columns)], axis=-1)
    controller = PolicyController(unflatten(theta), jnp.zeros(N_OBSERVATION), jnp.ones(N_OBSERVATION))
    return task, episodes, task.prepare(episodes), controller, task.reset(episodes, controller)


def _by_lanes(config: TaskConfig, rows: int, columns: int, ticks: int) -> tuple[Callable, Any]:
    """The whole compiled lane by lane: ``ticks`` control steps of every episode, whether it has ended or not."""
    task, episodes, constants, controller, first = _block(config, rows, columns)

    def step(tick: Array, now: tuple, by_lane: tuple, by_column: Any) -> tuple:
        return now[0], task.step(tick, now[1], *by_lane, by_column)

    def run(arguments: tuple) -> Any:
        state, by_lane, by_column = arguments
        going = jnp.ones(rows * columns, bool)
        return while_any(lambda now: now[0], step, (going, state), by_lane, by_column, limit=ticks)

    arguments = jax.block_until_ready(jax.tree.map(jnp.asarray, (first, (episodes, constants), controller)))
    compiled = jax.jit(run).lower(arguments).compile()
    _seconds(compiled, arguments)
    return compiled, arguments


def _parts(config: TaskConfig, rows: int, columns: int) -> dict[str, tuple[int, Callable, object]]:
    """By name: calls per control step, a step (tick, state) -> state, its first state."""
    lanes, timestep = rows * columns, 1.0 / config.sim_rate
    task, episodes, constants, controller, first = _block(config, rows, columns)
    speeds = 0.1 * jax.random.normal(jax.random.key(4), (N_JOINTS, lanes))
    pose = task.kinematics.pose(first.qpos, speeds)
    observation = jnp.concatenate([first.ball.position, first.qpos])
    nothing = 1e-9  # couples a result to the next call without moving it

    def kinematics(_: Array, state: tuple[Array, PaddlePose]) -> tuple[Array, PaddlePose]:
        qpos, last = state
        return qpos + nothing * last.position[0], task.kinematics.pose(qpos, speeds)

    def ball(_: Array, state: BallState) -> BallState:
        moved, events = flight.step(episodes.model.ball, state, timestep, (pose, pose))
        events = optimization_barrier(events)
        return jax.tree.map(lambda x: x + nothing * events.time, moved)

    def policy(tick: Array, state: tuple[Any, Array]) -> tuple[Any, Array]:
        memory, seen = state
        action, memory = controller.act(tick, memory, seen)
        return memory, seen.at[:N_JOINTS].add(nothing * action)

    def clearance(_: Array, qpos: Array) -> Array:
        gaps = task.clearance(optimization_barrier(task.kinematics.links(qpos)), qpos[0])
        return qpos + nothing * (gaps.table + gaps.own + gaps.blade)

    def signals(tick: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        """Delayed, noisy observation; limited, delayed command."""
        seen, sent, reference, previous, captured = state
        delayed = jnp.concatenate(
            [
                latency.read_ring(seen[:, :3], tick - constants.ball.periods),
                latency.read_ring(seen[:, 3:], tick - constants.joints.periods),
            ]
        )
        u = noise.symmetric_uniform(episodes.seed, tick, 3)
        observed = optimization_barrier(jnp.concatenate([delayed[:3] + 0.08 * u, delayed[3:]]))
        request = observed[3:] * jnp.asarray(LIMITS.policy_velocity)[:, None]
        command = optimization_barrier(limit_velocity(request, previous, reference, config.period, xp=jnp))
        sent = latency.write_ring(sent, tick, command)
        old = latency.read_ring(sent, tick - constants.action.periods - 1)
        new = latency.read_ring(sent, tick - constants.action.periods)
        for i in range(config.substeps):
            share = latency.share_old_command(constants.action, i, timestep)
            control = optimization_barrier(new + share * (old - new))
            weight = latency.weigh_capture(constants.joints, i, config.substeps, timestep)
            captured = captured.at[3:].add(weight * control)
        return latency.write_ring(seen, tick, nothing * captured), sent, reference, command, captured

    def whole(tick: Array, state: EpisodeState) -> EpisodeState:
        return task.step(tick, state, episodes, constants, controller)

    zeros = jnp.zeros_like(first.qpos)
    n = config.substeps
    return {
        "arm dynamics": (n, lambda _, state: task.engine.step(state[0], state[1], speeds), (first.qpos, first.qvel)),
        "paddle kinematics": (n, kinematics, (first.qpos, pose)),
        "ball": (n, ball, first.ball),
        "policy": (1, policy, (first.controller, observation)),
        "clearances": (1, clearance, first.qpos),
        "delays, noise, limits": (
            1,
            signals,
            (first.observations, first.commands, first.reference, zeros, jnp.zeros_like(observation)),
        ),
        WHOLE: (1, whole, first),
    }
