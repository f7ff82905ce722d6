"""The ball tracker: which of its datagrams to believe, and the ball in the table's frame, in order of capture."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within
from robot_io.calibrated import UNCALIBRATED, Calibration
from robot_io.devices.ball_datagram import FASTEST, REACH, SEQUENCE, BallSample, decode
from robot_io.devices.clock import Clock
from robot_io.history import History

JUMP = 0.1  # [m] of noise on the distance of two positions
AGREEING = 3  # frames in a row that the track is taken up again from after what looked like outliers
LONGEST_GAP = 0.5  # [s] of lost frames between two sequence numbers; one further ahead waits for a neighbour
FASTEST_RATE = 1000.0  # [Hz] of any tracker
SILENT = 0.5  # [s] without a frame
MANY, REFUSED = 10, 250  # frames refused for one reason, among so many accepted ones, are no accident
SILENCE = 1.0  # [s] after which the tracker may have been started anew


@dataclass(frozen=True)
class TrackerConfig:
    """Address that the tracker sends to, and limits of what is accepted.

    host, port       address that the bridge listens on
    source           IP address of the tracker; datagrams from elsewhere are ignored
    source_port      port that it sends from; None takes that of the first valid frame, and again after 1 s of silence
    oldest           [s] age at which a frame is too old to be used
    ahead            [s] by which a capture time may lie in the future: clocks that differ by more are refused
    clock_offset     [s] added to capture times: bridge's monotonic clock minus the tracker's clock; None: measured in
                     the first second of frames, which is not used otherwise
    clock_bound      [s] by which the measured offset may miss it before the robot is stopped
    latency          [s] least time from a capture to its arrival, from which the offset is measured
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Within(1, 65535)] = 6520
    source: str = "127.0.0.1"
    oldest: Annotated[float, Within(0.01, 0.2, "s")] = 0.15
    ahead: Annotated[float, Within(0.0, 0.02, "s")] = 0.005
    clock_offset: Annotated[float, Within(-1e10, 1e10, "s")] | None = 0.0
    clock_bound: Annotated[float, Within(0.001, 0.02, "s")] = 0.01
    latency: Annotated[float, Within(0.0, 0.1, "s")] = 0.015
    source_port: Annotated[int, Within(1, 65535)] | None = None


class Tracker:
    """Keeps the ball's track from datagrams; knows no sockets and reads no clock."""

    def __init__(self, config: TrackerConfig, calibration: Calibration = UNCALIBRATED) -> None:
        self.config, self.frame = config, calibration.tracker
        clock = calibration.clock
        drift = clock.drift if clock.date else None
        self.clock = Clock(config.clock_offset, config.latency, config.clock_bound, drift)
        self.track = History(length=256, longest_hold=0.06)
        self.ball = -1  # number of the ball that the track belongs to
        self.received: float | None = None  # [s] when the last accepted frame came
        self.seen: float | None = None  # [s] capture time of the last frame that showed a ball
        self.newest: BallSample | None = None
        self.counts: Counter[str] = Counter()
        self._refusal = ""  # of the newest frame that was refused for its unit or clock
        self._refusals: deque[int] = deque(maxlen=MANY)  # frames that had been accepted before each
        self._heard: float | None = None  # [s] when the last frame came, accepted or not
        self._sequence: int | None = None
        self._port = config.source_port  # that frames are taken from
        self._far: int | None = None  # sequence number far ahead of the track's, not confirmed yet
        self._outliers: list[tuple[float, np.ndarray]] = []  # refused in a row; a track of their own when they agree

    def receive(self, datagram: bytes, source: str, now: float, port: int | None = None) -> BallSample | None:
        """Take one datagram from an IP address and port; the sample, or None when it was refused and counted."""
        silent = self.received is None or now - self.received > SILENCE
        if source != self.config.source or not (port is None or port == self._port or self._unpinned(silent)):
            self.counts["stranger"] += 1
            return None
        try:
            sample = decode(datagram)
        except ValueError as error:
            self.counts[str(error).split(":")[0]] += 1
            if str(error).startswith("position"):
                self._refuse(f"its {error} is no place within {REACH:g} m [m]: are these millimetres?")
            return None
        if silent and self._heard is not None and now - self._heard > SILENCE:
            self.clock.restart()
        self._heard = now
        self.clock.add(sample.captured, now)
        offset = self.clock.offset(sample.captured)
        if offset is None:
            self.counts["clock"] += 1
            return None
        captured = sample.captured + offset
        age = now - captured
        if age < -self.config.ahead or age > self.config.oldest:
            self.counts["future" if age < 0 else "stale"] += 1
            self._refuse(f"its frames are {age:+.3f} s old by its clock: tracker.clock_offset is not theirs")
            return None
        if self.newest is not None and not silent and not self._follows(sample.sequence, captured):
            return None
        self._sequence, self._far = sample.sequence, None
        self.received = now
        self._port = port if self._unpinned(silent) else self._port
        sample = self._in_table_frame(sample, captured)
        self.newest = sample
        if sample.position is None:
            self.counts["accepted"] += 1
            return sample
        new_track, newest, here = sample.ball != self.ball, self.track.newest, (captured, sample.position)
        if not new_track and newest is not None and not _near(*newest, *here):
            self.counts["outlier"] += 1
            agrees = bool(self._outliers) and _near(*self._outliers[-1], *here)
            self._outliers = [*self._outliers, here] if agrees else [here]
            if len(self._outliers) < AGREEING:
                return None
            new_track = True  # it was the track that was wrong
        self._outliers = []
        self.counts["accepted"] += 1
        if new_track:
            self.track.clear()
            self.ball = sample.ball
        if self.track.add(captured, sample.position):
            self.seen = captured
        return sample

    def _in_table_frame(self, sample: BallSample, captured: float) -> BallSample:
        velocity, covariance = sample.velocity, sample.covariance
        if velocity is not None and covariance is not None and not self.frame.neutral:
            turn = self.frame.matrix
            both = np.kron(np.eye(2), turn)
            velocity, covariance = turn @ velocity, both @ covariance @ both.T
        position = None if sample.position is None else self.frame.outward(sample.position)
        return BallSample(sample.sequence, sample.ball, captured, position, velocity, covariance)

    def problem(self, now: float) -> str | None:
        """Reason why nothing is known of the ball, as a sentence; None: frames come."""
        if self.received is not None and now - self.received <= SILENT:
            return None
        why = f"; {self.refused}" if self.refused else ""
        return f"silent: start the ball tracker, and check its address and clock{why}"

    @property
    def refused(self) -> str | None:
        """The newest frames were refused for their unit or clock, as a sentence; None: they were not."""
        many = len(self._refusals) == MANY and self.counts["accepted"] <= self._refusals[0] + REFUSED
        return self._refusal if many else None

    def _unpinned(self, silent: bool) -> bool:
        return self.config.source_port is None and silent

    def _refuse(self, reason: str) -> None:
        self._refusal = reason
        self._refusals.append(self.counts["accepted"])

    def _follows(self, sequence: int, captured: float) -> bool:
        """True when a frame comes after the newest by number and time; counts what was lost, or why it does not."""
        last = -np.inf if self.newest is None else self.newest.captured
        ahead = (sequence - (self._sequence or 0)) % SEQUENCE
        if ahead == 0 or ahead >= SEQUENCE // 2 or captured <= last:
            self.counts["duplicate" if ahead == 0 else "out of order"] += 1
            return False
        if ahead > FASTEST_RATE * max(LONGEST_GAP, captured - last):
            # One damaged number must not make the true ones look old: only its successor confirms it.
            confirmed = self._far is not None and 0 < (sequence - self._far) % SEQUENCE <= AGREEING
            self._far = sequence
            if not confirmed:
                self.counts["far ahead"] += 1
                return False
            return True
        self.counts["lost"] += ahead - 1
        return True


def _near(time: float, place: np.ndarray, later: float, there: np.ndarray) -> bool:
    """True when a ball can have come there by then."""
    return float(np.linalg.norm(there - place)) <= JUMP + FASTEST * (later - time)
