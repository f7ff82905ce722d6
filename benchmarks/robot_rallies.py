"""Rallies through the bridge beside the simulator's: ``python -m benchmarks.robot_rallies POLICY [--player player3]``.

The same policy and virtual player, in the rig in lock-step and in the simulator's rally code: lengths with 95 %
intervals and how rallies ended; the bridge's counts are compared with what the world saw.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import mean_interval, run
from experiments.config.build import Experiment
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.finetuning import loop
from experiments.runs import load_policy
from mjx_tt import platform
from mjx_tt.env.policy import Policy
from mjx_tt.rally import human_player
from mjx_tt.rally.simulator import Box, RallySimulator
from mjx_tt.robot.robots import paper
from robot_io.control import rally
from robot_io.control.config import RobotConfig
from robot_io.control.interfaces import BridgeConfig
from robot_io.emulator.config import RigParams
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.opponent import Rallies
from robot_io.emulator.tracker import TrackerParams
from robot_io.policy.numpy_policy import StreamingPolicy
from robot_io.rally_ends import FILTERED, End

SCENE = str(paper().scene())
LONGEST_RALLY = 60.0  # [s] per rally on average before something is wrong


def main(
    policy: str,
    *,
    player: str = "player3",
    rallies: int = 100,
    simulated: int = 2000,
    tracker: Literal["ball", "stroke", "lost"] = "ball",
    noise: float = 0.003,
    seed: int = 1,
) -> None:
    """Measures and prints rallies in the simulator and in the rig.

    Args:
        policy: run or artefact
        rallies: in the rig
        simulated: in the simulator
        tracker: its numbers are per ball, per stroke, or it loses the ball at the human's side
        noise: [m] of the tracker
    """
    platform.configure(devices=1)
    experiment, loaded = loop.experiment_of(policy), load_policy.load(policy).policy.astype(np.float32)
    box = Box.of(experiment.distribution)
    if simulated:
        play_simulated(loaded, player, experiment, box, simulated, seed)
    if rallies:
        params = RigParams(tracker=TrackerParams(identity=tracker, noise=noise), seed=seed)
        play_rig(loaded, player, params, box, rallies, seed)


def play_simulated(policy: Policy, player: str, experiment: Experiment, box: Box, rallies: int, seed: int) -> None:
    """Rallies of the simulator, 10 in each lane."""
    lanes = max(rallies // 10, 1)
    spread = jax.tree.map(jnp.asarray, policy)
    spread = replace(spread, theta=jnp.repeat(spread.theta[:, None], lanes, axis=1))
    low, high = (jnp.repeat(end[:, None], lanes, axis=1) for end in (box.low, box.high))
    people = human_player.stack([human_player.load(player)] * lanes)
    simulator = RallySimulator(experiment.task)
    result = simulator.play(spread, people, experiment.model.model, jax.random.key(seed), 10, Box(low, high))
    length, end = np.asarray(result.length).ravel(), np.asarray(result.end).ravel()
    counts = ~np.isin(end, [int(e) for e in FILTERED])
    show("simulator", length[counts], Counter(End(e).name for e in end[counts]), float(np.sum(result.seconds)))


def bridge_config(box: Box) -> BridgeConfig:
    """The bridge's, with that box of balls."""
    return BridgeConfig(RobotConfig().delays, box=rally.Box(tuple(box.low.tolist()), tuple(box.high.tolist())))


def play_rig(policy: Policy, player: str, params: RigParams, box: Box, rallies: int, seed: int) -> None:
    """Rallies through the bridge in lock-step."""
    robot = LockStep(SCENE, VirtualPlayer(player, seed), StreamingPolicy(policy), params, bridge_config(box))
    robot.start()
    robot.throwing, began = True, time.monotonic()
    while len(robot.rallies) < rallies and robot.now < LONGEST_RALLY * rallies:
        if robot.run(1.0, lambda: robot.bridge.state.value in ("fault", "disarmed")):
            print(f"fault: {robot.bridge.gate.faults}")
            robot.recover()
    kept = [r for r in robot.rallies[:rallies] if not r.filtered]
    show(params.tracker.identity, [r.length for r in kept], Counter(r.end for r in kept), robot.now)
    assert isinstance(robot.thrower, Rallies)
    seen = [r.touches for r in robot.thrower.played[: len(robot.rallies)]]
    wrong = sum(a != b.length for a, b in zip(seen, robot.rallies, strict=False))
    print(f"  lengths that differ from the world's: {wrong}; {robot.now / (time.monotonic() - began):.1f} x real time")


def show(name: str, lengths: Sequence[int] | np.ndarray, ends: Counter[str], seconds: float) -> None:
    """Mean with its interval by the bootstrap, the longest, and the ends."""
    values = np.asarray(lengths, float)
    mean, low, high = mean_interval(values)
    print(
        f"{name}: {values.size} rallies, {mean:.2f} touches ({low:.2f} to {high:.2f}), longest "
        f"{values.max():.0f}, {seconds:.0f} s of play"
    )
    print("  " + ", ".join(f"{n / values.size:.0%} {end.lower().replace('_', ' ')}" for end, n in ends.most_common()))


if __name__ == "__main__":
    run(main)
