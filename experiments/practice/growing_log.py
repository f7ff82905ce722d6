"""A robot's log while it is written, read again and again for what is new in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ballmodel.trajectory import Trajectory
from experiments.deploy import session_logs
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.robot import robots
from robot_io.log import reader, writer
from robot_io.log.messages import LogError

SETTLED = 1.5  # [s] after a ball's last sample, from which on nothing more of it comes
FEWEST = 8  # samples of a ball


class GrowingLog:
    """A session's log while it is written: its new balls at every look, and the joints all along."""

    def __init__(self, first: Path) -> None:
        self._first = first
        self._until = -np.inf  # [s] end of the last ball that was taken
        self._episodes = 0

    def read(self) -> tuple[tuple[Trajectory, ...], list[bool], tuple[JointRecord, ...]]:
        """Balls that ended since the last look, outcomes known since, and the joints of the last two files."""
        files = [path for path in writer.parts(self._first) if path.exists()]
        unfinished = writer.part_of(self._first, len(files) + 1).with_suffix(writer.UNFINISHED)
        try:
            logs = [reader.read(path) for path in files[-1:]]
            logs += [reader.read(unfinished, salvage=True)] if unfinished.exists() else []
        except (LogError, OSError):  # renamed meanwhile, or nothing in it yet
            return (), [], ()
        if not logs:
            return (), [], ()
        now = max(log.ball.capture_time.max(initial=-np.inf) for log in logs)
        tracks = [t for log in logs for t in session_logs.flights(log)]
        strokes = [s for t in tracks for s in session_logs.split_by_stroke(t)]
        done = [s for s in strokes if self._until < s.time[-1] < now - SETTLED and len(s) >= FEWEST]
        done.sort(key=lambda s: s.time[0])
        if done:
            self._until = max(s.time[-1] for s in done)
        ended = [e for log in logs for e in log.episodes if e.outcome]
        new = [e.outcome == "returned" for e in ended if e.number > self._episodes]
        self._episodes = max([self._episodes, *(e.number for e in ended)])
        return tuple(done), new, session_logs.joints_of(logs, robots.paper())
