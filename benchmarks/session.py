"""Sealed sessions: ``python -m benchmarks.session [--out runs/sessions] [--seeds 3] [--kinds rubber camera]``.

A session in a hidden reality: the shipped quickstart plays, after some balls one thing changes that the software is not
told of, and play goes on. Recorded are: after how many balls the change was noticed and under which name, what the
identification says, how long the way to a new policy took, and what share of the same balls each policy returns in the
changed world: the one that was in play and the new one.
Resumable: what is finished is kept, ``--show`` prints it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ballmodel.partial_params import without_nominal
from benchmarks.harness import print_table, read_all, run
from benchmarks.identification import BELIEVED, CAMERA_NOISE, returned
from experiments.config import build
from experiments.config import study as studies
from experiments.practice.learner import Learner
from experiments.practice.practice import Exchange, Piece, Practice
from experiments.runs import load_policy, run_dir
from experiments.runs.locate import find_policy
from experiments.study.target_domain.lab_logs import HitLog, record_hits
from experiments.study.target_domain.virtual import VirtualReality
from mjx_tt import platform
from mjx_tt.env.policy import Policy
from mjx_tt.sim import model as models

PIECE = 5  # balls between two looks
LATER = 1000.0  # [s] between two logs on the session's clock
KNOWN = 80  # balls before the change
LONGEST = 240  # balls after it
Values = Mapping[str, float]


def moved(**changes: float) -> dict[str, float]:
    """Changes by path, with dots written as double underscores."""
    return {path.replace("__", "."): change for path, change in changes.items()}


# What is added to a reality's own value; of a player, nothing is.
CHANGES: dict[str, dict[str, float]] = {
    "nothing": {},
    "table restitution": moved(ball__table__restitution=-0.12),
    "table friction": moved(ball__table__friction=-0.2),
    "fan": moved(ball__flight__wind_x=1.5),
    "heavy ball": moved(ball__flight__mass=-0.0009),
    "rubber": moved(ball__paddle__restitution=-0.35),
    "rubber's grip": moved(ball__paddle__tangential_gain=-0.45),
    "camera moved": moved(sensing__ball_offset_x=0.06, sensing__ball_offset_z=0.05),
    "camera turned": moved(sensing__camera_rotation_x=0.04, sensing__camera_rotation_y=0.03),
    "clock": moved(latency__ball_observation=0.04),
    "joint lag": moved(drives__joint_5__lag=0.06, drives__joint_4__lag=0.06),
    "joint gain": moved(drives__joint_5__velocity_gain=-0.3),
    "joint zero": moved(drives__joint_5__joint_offset=0.09),
    "drives' delay": moved(latency__festo_action=0.06),
    "table and camera": moved(ball__table__restitution=-0.08, sensing__ball_offset_z=0.05),
    "another player": {},
}
OTHER_PLAYER = "player5"


def main(
    *,
    out: Path = Path("runs/sessions"),
    kinds: tuple[str, ...] = tuple(CHANGES),
    seeds: int = 3,
    first: int = 0,
    updates: int = 300,
    player: str = "player3",
    costs: bool = False,
    show: bool = False,
) -> int:
    """Plays the sessions that are missing, and prints all; returns the exit status.

    Args:
        kinds: of changes
        first: seed of the first reality
        updates: of each training
        player: of all sessions
        costs: only print what each change costs the policy in play
        show: only print what is there
    """
    platform.configure(devices=1)
    if not show:
        study = studies.parse({"name": "x", "simulation": {"rounds": [{"simulated": 1, "real": 1}] * 3}}, "study")
        reality, learner = VirtualReality(study, first), Learner(updates)
        for seed in range(first, first + seeds):
            for kind in kinds:
                session = Session(reality.at(seed), seed, kind, player)
                if costs:
                    print(f"{seed} {kind}: {session.costs()}", flush=True)
                    continue
                path = out / f"session_{kind.replace(' ', '_')}_{seed:03d}.json"
                if not path.exists():
                    out.mkdir(parents=True, exist_ok=True)
                    run_dir.write_json(path, session.play(path.with_suffix(""), learner))
                    print(f"{path} written", flush=True)
    found = read_all(out, "session") if out.exists() else []
    print_table(
        "sessions",
        ("change", "seed", "balls", "noticed as", "identified", "was", "old", "new", "robust", "s"),
        [_row(one) for one in found],
    )
    return 0


class Session:
    """One session of a reality, with a change of some kind."""

    def __init__(self, reality: VirtualReality, seed: int, kind: str, player: str) -> None:
        self._reality, self._seed, self._kind = reality, seed, kind
        base = models.paths(reality.model)
        values = {path: base[path] + change for path, change in CHANGES[kind].items()}
        self._models = reality.known, without_nominal(models.with_values(reality.model, values))
        self._names = player, OTHER_PLAYER if kind == "another player" else player
        self._players = tuple(reality.player(name) for name in self._names)
        self._key = build.key(seed, hash(kind) % 1000)
        self._logs = 0

    def costs(self) -> str:
        """Returned before and after the change, of the policy in play."""
        policy = load_policy.load("quickstart").policy
        before, after = (f"{100 * self._rate(policy, late):.1f}" for late in (False, True))
        return f"{before} -> {after} %"

    def play(self, folder: Path, learner: Learner) -> dict[str, Any]:
        """Plays it; the record of all that happened."""
        spoken: list[str] = []
        shipped = find_policy("quickstart")
        balls = build.distribution(f"{self._names[0]}/M0", "balls")
        practice = Practice(shipped, balls, folder, learner, spoken.append)
        policy, alarm, seconds = load_policy.load(shipped).policy, None, 0.0
        policy, _, _ = self._until(practice, policy, False, KNOWN)
        before = policy
        began = time.monotonic()
        policy, alarm, balls_until = self._until(practice, policy, True, LONGEST)
        seconds = time.monotonic() - began
        robust = load_policy.load("robust").policy if _ships("robust") else None
        return {
            "kind": self._kind,
            "seed": self._seed,
            "noticed": alarm,
            "said": spoken,
            "exchanged": policy is not before,
            "balls": balls_until,
            "seconds": round(seconds, 1),
            "was": self._rate(before, False),
            "old": self._rate(before, True),
            "new": self._rate(policy, True),
            "robust": None if robust is None else self._rate(robust, True),
        }

    def _until(
        self, practice: Practice, policy: Policy, late: bool, most: int
    ) -> tuple[Policy, dict[str, Any] | None, int]:
        """Plays so many balls, or until a change was noticed and answered; the policy in play and the alarm."""
        count, alarm = 0, None
        while count < most:
            log, begin = self._log(policy, late)
            for i in range(0, len(log.balls.trajectories), PIECE):
                new = list(log.balls.trajectories[i : i + PIECE])
                count += len(new)
                raised = practice.add(Piece(new, log.returned[i : i + PIECE].tolist(), log.joints))
                if raised is not None and alarm is None:
                    alarm = {"name": raised.name, "others": list(raised.others), "balls": count}
                exchange: Exchange | None = practice.back()
                if exchange is None and practice.due:
                    exchange = practice.refine(log.joints)
                    if late and exchange is None and alarm is not None:
                        return policy, alarm, count
                if exchange is not None:
                    policy = load_policy.load(exchange.policy).policy
                    if late:
                        return policy, alarm, count
                    break  # the rest of the log was played by the policy of before
                if count >= most:
                    break
        return policy, alarm, count

    def _log(self, policy: Policy, late: bool) -> tuple[HitLog, float]:
        self._logs += 1
        begin = LATER * self._logs
        log = record_hits(
            self._reality.simulator,
            self._models[late],
            self._players[late],
            policy,
            jax.random.fold_in(self._key, self._logs),
            f"session{self._logs}",
            CAMERA_NOISE,
            BELIEVED,
        )
        balls = tuple(replace(t, time=t.time + begin) for t in log.balls.trajectories)
        joints = tuple(
            replace(r, command_time=r.command_time + begin, state_time=r.state_time + begin) for r in log.joints
        )
        return replace(log, balls=replace(log.balls, trajectories=balls), joints=joints), begin

    def _rate(self, policy: Policy, late: bool) -> float:
        model, player = self._models[late], self._players[late]
        return float(np.mean(returned(self._reality, player, model, policy, jax.random.fold_in(self._key, 0))))


def _ships(name: str) -> bool:
    try:
        find_policy(name)
    except Exception:
        return False
    return True


def _row(one: dict[str, Any]) -> tuple[Any, ...]:
    noticed = one["noticed"] or {"name": "", "balls": None}
    last = next((text for text in reversed(one["said"]) if "->" in text), "")
    rates = [None if one[name] is None else f"{100 * one[name]:.1f}" for name in ("was", "old", "new", "robust")]
    return one["kind"], one["seed"], noticed["balls"], noticed["name"], last[:60], *rates, one["seconds"]


if __name__ == "__main__":
    run(main)
