"""The tracker's clock against the bridge's: measured all the time from when frames were captured and when they came.

A frame comes no earlier than ``latency`` after its capture, and now and then hardly later. So the least delay of every
second, less that latency, is the offset between the clocks; a line through them is its drift. What frames cannot tell
is an error of ``latency`` itself: the offset is wrong by as much. Contacts of ball and paddle in a log tell it.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

WINDOW = 1.0  # [s] of which the least delay counts
KEPT = 60  # windows that the line goes through
SETTLED = 10  # windows from which on a drift is told, and judged
STEP = 0.5  # share of ``bound`` by which a second may miss the line of those before it
RHYTHM = 0.5  # of the time between two captures that must lie between the arrivals, or the frames waited together
MOST_DRIFT = 5e-4  # of any clock that works
EARLY = 3  # windows from which on an offset or a rate that is far off shows
ONE_OFF = 3  # seconds that miss it, and frames from before it, in a row before that counts


class Clock:
    """Offset of one session, bridge's clock less tracker's.

    offset    [s] as configured; None: that of the first second of frames
    latency   [s] least time from a capture to its arrival
    bound     [s] by which the measured offset may miss the configured one, and a second the line of those before
    drift     as calibrated; None: offsets stay as configured, and are only watched
    """

    def __init__(self, offset: float | None, latency: float, bound: float, drift: float | None = None) -> None:
        self._given, self._latency, self._bound, self._nominal = offset, latency, bound, drift
        self._corrects = offset is None or drift is not None
        self._last: tuple[float, float] | None = None  # capture and arrival of the newest frame
        # Shortest delay of a frame: by the first second, where the offset is given, and kept, or a later second could
        # be wrong by anything.
        self._floor: float | None = None if offset is not None else latency
        self.restart()

    def restart(self) -> None:
        """Forget what was measured: the tracker may have been started anew."""
        self._windows: deque[tuple[float, float]] = deque(maxlen=KEPT)  # capture and delay of the least delayed
        self._least: tuple[float, float] | None = None
        self._began = -math.inf
        self._missed, self._set_back, self._jumped = 0, 0, False
        self.drift, self._at = self._nominal or 0.0, 0.0
        self.windows = 0  # complete ones
        self.measured, self.residual = 0.0, 0.0  # [s] offset by the frames, and how far seconds miss the line

    def offset(self, captured: float) -> float | None:
        """Offset [s] at a capture on the tracker's clock; None while it is not known."""
        if self._corrects and self.windows:
            return self.measured + self.drift * (captured - self._at)
        return self._given

    def add(self, captured: float, now: float) -> bool:
        """Take a frame's capture [s, tracker's clock] and arrival [s, bridge's]; True when a second was completed."""
        delay, last, self._last = now - captured, self._last, (captured, now)
        self._set_back = self._set_back + 1 if captured < self._began - WINDOW else 0
        if self._set_back >= ONE_OFF:  # it was not one damaged stamp
            self.restart()
            self._jumped = True
        if captured < self._began or last is None:
            return False
        gap, silence = captured - last[0], now - last[1]
        if not RHYTHM * gap <= silence <= gap + self._bound:
            return False  # it waited while the bridge stood still, and tells nothing about the clocks
        if self._least is None or delay < self._least[1]:
            self._least = captured, delay
        if self._began == -math.inf:
            self._began = captured
        if captured - self._began < WINDOW:
            return False
        self._began = captured
        window, self._least = self._least, None
        self._close(*window)
        return True

    def _close(self, captured: float, delay: float) -> None:
        if self._floor is None:  # the configured offset holds at the start: what is over is the frames' latency
            self._floor = delay - (self._given or 0.0)
        if self.windows >= SETTLED:
            expected = self.measured + self._floor + self.drift * (captured - self._at)
            self._missed = self._missed + 1 if abs(delay - expected) > STEP * self._bound else 0
            if 0 < self._missed < ONE_OFF:
                return  # one slow second tells nothing about the clocks
            if self._missed:
                self._windows.clear()
                self.windows, self._missed, self._jumped = 0, 0, True
        self._windows.append((captured, delay))
        self.windows += 1
        self._jumped &= self.windows < SETTLED
        times, delays = np.array(self._windows).T
        if len(times) >= SETTLED:
            i, j = np.triu_indices(len(times), k=len(times) // 2)
            self.drift = float(np.median((delays[j] - delays[i]) / (times[j] - times[i])))
        level = float(np.median(delays - self.drift * (times - captured)))
        self._at = captured
        self.measured = level - self._floor
        self.residual = float(np.sqrt(np.mean((delays - self.drift * (times - captured) - level) ** 2)))

    def report(self) -> dict[str, float]:
        """Everything that was measured, for the log."""
        found = {"offset": self.measured, "at": self._at, "drift": self.drift, "residual": self.residual}
        return found | {"seconds": self.windows}

    @property
    def unready(self) -> str | None:
        """Reason why capture times cannot be trusted yet, as a sentence; None: nothing speaks against them."""
        late = 0.0 if self._given is None or self._floor is None else self._floor - self._latency
        if abs(late) > self._bound:
            return (
                f"the tracker's clock is off by {-1e3 * late:+.1f} ms, or tracker.latency is: by tracker.clock_offset "
                f"its frames come {1e3 * (late + self._latency):.1f} ms after their captures"
            )
        if self.problem or self.windows >= SETTLED:
            return self.problem
        if self.windows < EARLY:
            return f"the tracker's clock was heard for {self.windows} s, {EARLY} s are needed"
        times, delays = np.array(self._windows).T
        if np.ptp(delays) > STEP * self._bound:
            rate = 1e6 * float(delays[0] - delays[-1]) / float(times[-1] - times[0])
            return f"the tracker's clock does not keep the bridge's pace: {rate:+.0f} ppm over {self.windows} s"
        return self._off

    @property
    def problem(self) -> str | None:
        """Reason why capture times cannot be trusted, as a sentence; None when they can."""
        if self._jumped:
            return f"the tracker's clock jumped by more than {1e3 * STEP * self._bound:.1f} ms against the bridge's"
        if self.windows < SETTLED:
            return None
        if abs(self.drift) > MOST_DRIFT:
            return f"the tracker's clock drifts by {-1e6 * self.drift:+.0f} ppm, allowed are {1e6 * MOST_DRIFT:.0f}"
        return self._off

    @property
    def _off(self) -> str | None:
        """How far a fixed offset is off, where that is more than the bound."""
        if self._given is not None and not self._corrects and abs(self.measured - self._given) > self._bound:
            return (
                f"the tracker's clock is off by {1e3 * (self._given - self.measured):+.1f} ms (tracker.clock_bound: "
                f"{1e3 * self._bound:.1f} ms); calibrate it (mjx-tt calibrate clock)"
            )
        return None
