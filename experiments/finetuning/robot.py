"""The interfaces of a robot and of its operator to fine-tuning, and the emulated robot in lock-step."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import mjx_tt
from experiments.errors import RunError
from robot_io.contract import PAPER, Contract
from robot_io.control.bridge import BridgeState
from robot_io.control.episode import EpisodeSummary
from robot_io.control.interfaces import BridgeConfig
from robot_io.control.interfaces import Policy as StepPolicy
from robot_io.control.rally import RallySummary
from robot_io.emulator.config import RigParams
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.opponent import Opponent, Throws
from robot_io.emulator.world import World
from robot_io.errors import RefusedError
from robot_io.log.messages import Ball, Record
from robot_io.log.recorder import NullRecorder, SessionRecorder
from robot_io.policy.backends import make_policy
from robot_io.policy.policy import Policy

SCENE = Path(mjx_tt.__file__).parent / "assets" / "scene.xml"
EXCHANGE = 0.03  # [s] of play that an exchange of policies takes, as through the pipe of a control process
LONGEST_WAIT = 120.0  # [s] of play for a ball
REPORTING = 1.0  # [s] within which the outcome of an episode that a fault ended is known


@dataclass(frozen=True)
class PlayedBall:
    """One episode: its summary, and the ball as it was measured, (n, 4): t [s], x, y, z [m], in the order of time."""

    summary: EpisodeSummary
    trajectory: np.ndarray


class Robot(Protocol):
    """Plays one ball at a time.

    repeatable  an episode's number decides its ball and all else that is random: evaluations before and after can be
                compared ball by ball
    """

    repeatable: bool

    def play(self, policy: Policy, episode_number: int) -> PlayedBall:
        """Plays the next ball with a policy in float32.

        A fault that ends the episode is in its summary, and the robot stands ready again when this returns. Raises
        RunError, RefusedError or DeviceError when no episode can be played; the fine-tuning can then be continued.
        """

    def describe(self) -> dict[str, Any]:
        """Its description as plain JSON data; a run is continued on a robot of the same description."""


class Operator:
    """The person at the robot, asked between episodes; this one lets everything run."""

    def discarded(self) -> bool:
        """True for a ball that is to be played again; called once after every ball."""
        return False

    def retracts(self, seconds: float = 0.0) -> bool:
        """True when the ball before the newest was discarded after it had been played; waits for it so long."""
        return False

    def paused(self) -> bool:
        """True while the fine-tuning is to wait; polled."""
        return False

    def stopped(self) -> bool:
        """True to stop here; the same command continues later."""
        return False


class _Emulated:
    """The emulated robot in this process; contract: of the robot in ``scene``."""

    def __init__(self, params: RigParams | None, scene: str | Path, contract: Contract) -> None:
        self._params, self._scene, self._contract = params or RigParams(), scene, contract

    def _computed(self, policy: Policy) -> StepPolicy:
        return make_policy("numpy" if policy.network is None else "jit", policy, self._contract)

    def _described(self, name: str) -> dict[str, Any]:
        other = {} if self._contract == PAPER else {"joints": self._contract.robot}
        return {"robot": name, "params": repr(self._params)} | other


class LockStepRobot(_Emulated):
    """The emulated robot in this process. Every episode begins with power-on, so that it depends on its number only.

    throws  the balls; episode n meets ball n, and ball n - size after the last
    """

    repeatable = True

    def __init__(
        self,
        throws: Throws,
        params: RigParams | None = None,
        scene: str | Path = SCENE,
        contract: Contract = PAPER,
    ) -> None:
        super().__init__(params, scene, contract)
        self._throws = throws
        self._world = World(scene, self._params.world, contract)

    def play(self, policy: Policy, episode_number: int) -> PlayedBall:
        balls = BallRecorder()
        rig = LockStep(
            self._scene,
            self._throws,
            self._computed(policy),
            self._params,
            BridgeConfig(contract=self._contract),
            recorder=balls,
            first=episode_number,
            world=self._world,
        )
        rig.start()
        found = rig.play(1)
        if not found and rig.run(REPORTING, lambda: bool(rig.summaries)):  # a fault: the outcome comes a tick later
            found = [rig.summaries.popleft()]
        if not found:
            state = f"{rig.bridge.state.value}, faults: {[str(f) for f in rig.bridge.gate.faults]}"
            raise RunError(f"episode {episode_number}: the emulated robot saw no ball ({state})")
        return PlayedBall(found[0], balls.trajectory(found[0].ball))

    def describe(self) -> dict[str, Any]:
        return self._described("lock-step") | {"balls": int(self._throws.position.shape[1])}


class LockStepRallies(_Emulated):
    """The emulated robot in this process, in rallies with an opponent; one session, which is not repeated.

    It takes balls only while an episode is asked for, and credits only those that the policy of that episode played.
    recorder: of the whole session
    """

    repeatable = False

    def __init__(
        self,
        opponent: Opponent,
        params: RigParams | None = None,
        scene: str | Path = SCENE,
        recorder: SessionRecorder | None = None,
        contract: Contract = PAPER,
    ) -> None:
        super().__init__(params, scene, contract)
        config = BridgeConfig(contract=contract)
        self._made = partial(LockStep, scene, opponent, params=self._params, config=config, recorder=recorder)
        self._rig: LockStep | None = None
        self._version = 0

    @property
    def rallies(self) -> list[RallySummary]:
        """Rallies so far."""
        return [] if self._rig is None else self._rig.rallies

    def play(self, policy: Policy, episode_number: int) -> PlayedBall:
        """Play the next ball of the session, whatever ``episode_number`` is."""
        if self._rig is None:
            self._rig = self._made(policy=self._computed(policy))
            self._rig.start()
            self._rig.throwing = True
        rig, bridge = self._rig, self._rig.bridge
        self._version += 1
        end = rig.now + LONGEST_WAIT
        exchanged = False
        while not exchanged:  # as soon as the ball before is not played any more
            rig.run(EXCHANGE)
            with suppress(RefusedError):
                bridge.set_policy(self._computed(policy), self._version)
                exchanged = True
        bridge.paused = False
        while rig.now < end:
            rig.run(0.1, lambda: bool(rig.summaries) or bridge.state in (BridgeState.FAULT, BridgeState.DISARMED))
            found = rig.summaries.popleft() if rig.summaries else None
            if bridge.state in (BridgeState.FAULT, BridgeState.DISARMED):
                rig.run(REPORTING)
                rig.recover()
            if found is not None and found.policy_version == self._version:
                bridge.paused = True
                return PlayedBall(found, rig.track)
        raise RunError(f"no ball was played for {LONGEST_WAIT:g} s: {[str(f) for f in bridge.gate.faults]}")

    def describe(self) -> dict[str, Any]:
        return self._described("rallies in lock-step")


class BallRecorder(NullRecorder):
    """Keeps the accepted samples of the ball and nothing else."""

    def __init__(self) -> None:
        self._samples: dict[int, list[tuple[float, ...]]] = {}

    def put(self, *records: Record) -> None:
        for record in records:
            if isinstance(record, Ball):
                sample = (record.capture_time, *map(float, record.position))
                self._samples.setdefault(record.id, []).append(sample)

    @property
    def balls(self) -> list[int]:
        """Numbers of the balls in the order of their first samples."""
        return list(self._samples)

    def trajectory(self, ball: int) -> np.ndarray:
        """Samples (n, 4) of the tracker's ball of that number: t [s], x, y, z [m], in the order of capture."""
        samples = sorted({sample[0]: sample for sample in self._samples.get(ball, [])}.values())
        return np.array(samples, float).reshape(-1, 4)
