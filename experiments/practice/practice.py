"""The course of a session: watch, notice a change, identify the world anew, train, compare, exchange, and go back.

Nothing here plays or reads a log. Balls come in the order of play with the joints' motion; what comes out is a policy
that should be in play, and why. So a robot, the rig and a simulated session are the same to it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ballmodel.distribution import save_distribution
from ballmodel.fit_distribution import fit_human
from ballmodel.registry import Balls
from ballmodel.trajectory import Dataset, Trajectory
from experiments.practice import beliefs
from experiments.practice.learner import Learner, Trial
from experiments.runs import lines, load_policy
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.diagnosis.monitor.cusum import Alarm, Cusum
from mjx_tt.diagnosis.monitor.scores import NAMES, Scorer
from mjx_tt.sim.model import ModelFile, SimModel

FIRST = 40  # balls after which the world is identified for the first time
AFTER = 30  # balls since a change, from which it is identified anew
MORE = 10  # balls, where these were too few
FALSE_ALARMS = 12_000  # balls in which one alarm by chance is allowed: ten hours of play
MARGIN = 0.01  # of the return rate, by which a new policy has to be better than the one in play
WORSE = 0.02  # of the return rate, by which a new policy may be worse in play than the old one was in the trial
ODDS = 20.0  # at which a new policy's balls say that it is worse, and it goes, or as good, and it stays
STROKES = 60  # of the person, from which their own distribution is trained for
MOST = 400  # of the newest of these
JOURNAL = "journal.jsonl"


@dataclass
class Piece:
    """Balls in the order of play, with their returns, whether each was returned, and the joints on the same clock."""

    balls: list[Trajectory] = field(default_factory=list)
    returned: list[bool] = field(default_factory=list)
    joints: tuple[JointRecord, ...] = ()


@dataclass(frozen=True)
class Exchange:
    """A policy that should be in play from now on, and why."""

    policy: Path  # run or artefact
    version: int
    reason: str


class Practice:
    """One session. folder: of its journal, worlds and trainings; balls: that the first policy was trained for.

    The journal has a line for every event: which policy, which alarm, which world, with the number of the ball.
    """

    def __init__(
        self,
        policy: Path,
        balls: Balls,
        folder: Path,
        learner: Learner,
        say: Callable[[str], None],
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.policy, self.world = folder, policy, ModelFile(SimModel())
        self.alarm: Alarm | None = None
        self.version = self.count = 0
        self._learner, self._say, self._human = learner, say, balls
        self._scorer: Scorer | None = None
        self._test: Cusum | None = None
        self._since: list[Trajectory] = []  # balls in the world as it is now
        self._strokes: list[Trajectory] = []
        self._before: tuple[Path, float, float] | None = None  # policy of before, return rates of it and of the new one
        self._odds = 0.0
        self._identified, self._wanted = False, FIRST  # balls since the change, for an identification

    def add(self, piece: Piece) -> Alarm | None:
        """Takes balls that were played; the alarm that one of them raises."""
        first = self.count
        self.count += len(piece.balls)
        self._strokes = [*self._strokes, *piece.balls][-MOST:]
        self._since = [*self._since, *piece.balls][-MOST:]
        for was_returned in piece.returned:
            self._follow(was_returned)
        if self._scorer is None or self._test is None or self.alarm is not None:
            return None
        for i, score in enumerate(self._scorer.score(piece.balls, piece.joints)):
            alarm = self._test.add(score)
            if alarm is not None:
                self.alarm, self._wanted = alarm, AFTER
                # Of the balls in this world only those after the change are left.
                self._since = self._since[-(len(piece.balls) - 1 - i + alarm.at - alarm.since + 1) :]
                self._note("alarm", first + i + 1, since=first + i + 1 - (alarm.at - alarm.since), **_plain(alarm))
                return alarm
        return None

    @property
    def due(self) -> bool:
        """True where enough balls are there to identify the world for the first time, or after a change."""
        return len(self._since) >= self._wanted and (self.alarm is not None or not self._identified)

    def refine(self, joints: Sequence[JointRecord]) -> Exchange | None:
        """Identifies the world, trains and compares; the exchange that follows, if any.

        joints: on the balls' clock, all along the balls since the change.
        """
        began, number = time.monotonic(), self.count
        balls = list(self._since)
        inside = tuple(r.between(balls[0].time[0] - 0.5, balls[-1].time[-1] + 0.5) for r in joints)
        try:
            world = beliefs.identify(balls, inside, self.world)
        except ValueError as error:  # too few that can be used: with more of them
            self._wanted = len(balls) + MORE
            self._note("not identified", number, reason=str(error))
            return None
        changes = beliefs.compare(self.world, world) if self._identified else ()
        path = self.folder / f"world{number}.yaml"
        world.save(path)
        seconds = time.monotonic() - began
        self._note(
            "identified", number, world=path.name, changes=[asdict(c) for c in changes], seconds=round(seconds, 1)
        )
        sentence = beliefs.say(changes) if self._identified else "the world of this session is known"
        self._say(f"ball {number}: {sentence}")
        self.world, self._identified, self.alarm = world, True, None
        self._scorer = Scorer(world.model)
        self._test = Cusum(NAMES, self._scorer.score(balls, inside), FALSE_ALARMS)
        return self._train(number, path, sentence)

    def _train(self, number: int, world: Path, sentence: str) -> Exchange | None:
        began, human = time.monotonic(), self._person()
        balls = self.folder / f"balls{number}.yaml"
        save_distribution(balls, human)
        trained = self._learner.train(world, balls, self.policy, self.folder / f"policy{number}")
        trial = self._learner.compare(load_policy.load(self.policy).policy, trained.policy, self.world, human)
        seconds = round(time.monotonic() - began, 1)
        better = trial.low > 0.0 and trial.new - trial.old > MARGIN
        self._note("trained", number, policy=trained.source.name, seconds=seconds, better=better, **asdict(trial))
        self._say(f"ball {number}: {_say_trial(trial, better)}")
        if not better:
            return None
        return self.exchange(trained.source, trial, sentence)

    def exchange(self, policy: Path, trial: Trial, reason: str) -> Exchange:
        self._before, self._odds = (self.policy, trial.old, trial.new), 0.0
        return self._put(policy, reason)

    def _put(self, policy: Path, reason: str) -> Exchange:
        self.policy, self.version = policy, self.version + 1
        self._note("exchange", self.count, policy=str(policy), version=self.version, reason=reason)
        return Exchange(policy, self.version, reason)

    def back(self) -> Exchange | None:
        """The policy of before, where the new one's balls say that it is worse."""
        if self._before is None or self._odds < np.log(ODDS):
            return None
        policy, _, _ = self._before
        self._before, self._odds = None, 0.0
        return self._put(policy, f"returned less than the policy of before, at odds of {ODDS:g} to 1")

    def _follow(self, was_returned: bool) -> None:
        """Odds that the policy in play returns less than the one of before, rather than as in the trial.

        Wald's sequential test (Ann. Math. Stat. 16, 1945): it ends at ODDS to 1 for either, so that a policy as good as
        its trial goes back in one case of ODDS at most.
        """
        if self._before is None:
            return
        _, old, new = self._before
        worse, good = (min(max(rate, 0.005), 0.995) for rate in (old - WORSE, new))
        step = np.log(worse / good) if was_returned else np.log((1.0 - worse) / (1.0 - good))
        self._odds += float(step)
        if self._odds <= -np.log(ODDS):  # it is as good as the trial said
            self._before = None

    def _person(self) -> Balls:
        """The person's distribution: fitted to the session's strokes once there are enough of them."""
        if len(self._strokes) >= STROKES:
            try:
                data = Dataset(tuple(self._strokes), "session")
                self._human, _ = fit_human(data, self.world.model.ball, name="session", short_balls=True)
            except ValueError as error:
                self._note("person not fitted", self.count, reason=str(error))
        return self._human

    def _note(self, event: str, ball: int, **values: Any) -> None:
        entry = {"ball": ball, "event": event, "version": self.version, "time": round(time.time(), 3), **values}
        lines.append(self.folder / JOURNAL, (json.dumps(entry) + "\n").encode())


def _plain(alarm: Alarm) -> dict[str, Any]:
    return {"name": alarm.name, "shift": round(alarm.shift, 2), "others": list(alarm.others)}


def _say_trial(trial: Trial, better: bool) -> str:
    gain = f"{100 * trial.low:+.1f} to {100 * trial.high:+.1f} points"
    return f"in the identified world {trial.old:.1%} are returned, {trial.new:.1%} after training ({gain}): " + (
        "exchanged" if better else "kept"
    )
