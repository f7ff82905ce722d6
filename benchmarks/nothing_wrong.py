"""Logs in which nothing is wrong: ``python -m benchmarks.nothing_wrong [--logs 50] [--kinds balls hits session]``.

``balls``: 200 balls of the nominal simulator across its table and a minute of its joints. ``hits``: 120 balls of
rallies in it, from the player over the hit to the return, with the joints of all of them. ``session``: such rallies as
the robot's program records them, in an MCAP. Players and noise differ from log to log; every answer should be "none".
Resumable: what is finished is kept in --out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import jax
import numpy as np

from benchmarks.harness import each_missing, read_all, run
from experiments.config import study as studies
from experiments.deploy import session_logs
from experiments.runs import load_policy, run_dir
from experiments.stats import wilson
from experiments.study.target_domain import hidden_effects
from experiments.study.target_domain.lab_logs import record_hits, record_joints
from experiments.study.target_domain.virtual import VirtualReality
from mjx_tt import platform
from mjx_tt.diagnosis.diagnose import diagnose
from mjx_tt.diagnosis.logs import Logs
from mjx_tt.rally import human_player
from mjx_tt.sim import model as models
from mjx_tt.sim.model import LATENCIES, SimModel
from robot_io import log

QUICKSTART = Path("experiments/shipped/policies/quickstart")
Kind = Literal["balls", "hits", "session"]
KINDS: tuple[Kind, ...] = ("balls", "hits", "session")
PLAYERS = ("player1", "player2", "player3", "player4", "player5")
BALLS, SECONDS = 200, 60.0  # of the kind balls; of its joints [s]
NOISE = 0.003  # [m] of the camera
LATE = SimModel().latency.ball_observation  # [s]
EPOCH = 1_600_000_000_000_000_000  # [ns] since 1970 of the logs' begin
_lobs = jax.jit(human_player.first_ball, static_argnums=3)


class Nominal:
    """The nominal simulator as a laboratory sees it: one robot, so that its delays do not differ from ball to ball."""

    def __init__(self) -> None:
        rounds = [{"simulated": 1, "real": 1}] * 3
        study = studies.parse(
            {"name": "x", "simulation": {"rounds": rounds}, "reality": {"without": ["spin"]}}, "study"
        )
        self.reality = VirtualReality(study, 0)
        self.model = models.with_values(SimModel(), {f"latency.{name}_std": 0.0 for name in LATENCIES})
        self.policy = load_policy.load(QUICKSTART).policy

    def balls(self, seed: int) -> Logs:
        """Balls across the table and a minute of the joints."""
        key, camera, swept = jax.random.split(jax.random.key(seed), 3)
        player = self.reality.player(PLAYERS[seed % len(PLAYERS)])
        thrown = _lobs(player, human_player.fresh((BALLS,)), key, (BALLS,))
        seen = hidden_effects.measure(self.model, thrown, NOISE, camera)
        joints = record_joints(self.reality.simulator.task, self.model, swept, SECONDS)
        return Logs(tuple(seen.trajectories("nominal")), joints, {})

    def hits(self, seed: int) -> Logs:
        """Balls of rallies with the hits in them."""
        player = self.reality.player(PLAYERS[seed % len(PLAYERS)])
        key = jax.random.key(seed)
        found = record_hits(self.reality.simulator, self.model, player, self.policy, key, "nominal", NOISE, LATE)
        return Logs(tuple(found.balls), found.joints, {})


def recorded(logs: Logs) -> Logs:
    """The same after a session's log was written and read."""
    records: list[log.Ball | log.Joints | log.Command] = []
    for number, ball in enumerate(logs.balls):
        records += [log.Ball(t, t, place, number) for t, place in zip(ball.time, ball.position.T, strict=True)]
    unknown = np.full(len(logs.joints), np.nan)
    for i, joint in enumerate(logs.joints):
        for t, q in zip(joint.state_time, joint.state_position, strict=True):
            place = unknown.copy()
            place[i] = q
            records.append(log.Joints(t, place, unknown))
    sent = np.stack([joint.command_velocity for joint in logs.joints], axis=1)
    for tick, (t, u) in enumerate(zip(logs.joints[0].command_time, sent, strict=True)):
        records.append(log.Command(tick, t, u, u, unknown))
    with TemporaryDirectory() as name:
        with log.FileRecorder(Path(name), "session", {}, {}, 0.0, EPOCH) as recorder:
            recorder.put(*sorted(records, key=lambda record: record.log_time))
        balls, joints = session_logs.load(next(Path(name).glob("*.mcap")))
    return Logs(balls, joints, {})


def main(
    *, out: Path = Path("runs/nothing_wrong"), logs: int = 50, first: int = 0, kinds: tuple[Kind, ...] = KINDS
) -> int:
    """Answers and prints; 1 where one was not "none".

    Args:
        logs: of each kind
        first: seed of the first log
    """
    platform.configure(devices=1)
    nominal = Nominal()
    makers: dict[str, Callable[[int], Logs]] = {
        "balls": nominal.balls,
        "hits": nominal.hits,
        "session": lambda seed: recorded(nominal.hits(seed)),
    }
    for kind in kinds:
        for seed, path in each_missing(out, kind, range(first, first + logs)):
            run_dir.write_json(path, answer(makers[kind](seed), seed))
    text, good = summary(out)
    print(text)
    return 0 if good else 1


def answer(logs: Logs, seed: int) -> dict:
    """The headline of the diagnosis, and what it rests on."""
    verdict = diagnose(logs, seed=seed).verdict
    why = [cause.name for cause in verdict.causes]
    if verdict.unexplained is not None:
        why.append(f"{verdict.unexplained.block}, {verdict.unexplained.where}: {verdict.unexplained.size}")
    return {"answer": verdict.verdict, "why": "; ".join(why)}


def summary(out: Path) -> tuple[str, bool]:
    """A line for each kind; True where every answer is "none"."""
    lines, good = [], True
    for kind in KINDS:
        found = read_all(out, kind)
        if not found:
            continue
        none = sum(one["answer"] == "none" for one in found)
        low, high = wilson(none, len(found))
        lines.append(f"{kind}: none in {none} of {len(found)} (95 % interval {low:.1%} to {high:.1%})")
        lines += [f"  {count} x {why}" for why, count in Counter(o["why"] for o in found if o["why"]).most_common()]
        good &= none == len(found)
    return "\n".join(lines), good


if __name__ == "__main__":
    run(main)
