"""A test of the arm's controller: how long does it wait for a computer that does not answer?"""

from __future__ import annotations

import math

from robot_io.devices.egm.session import EgmSession
from robot_io.errors import RefusedError

LONGEST = 2.0  # [s]


class Mute:
    """A time without answers to a controller at rest.

    lasted  [s] after which EGM had ended, when it was tried last; None: it had not
    """

    def __init__(self, arm: EgmSession) -> None:
        self._arm = arm
        self.lasted: float | None = None
        self._began, self._end = math.inf, -math.inf

    def begin(self, now: float, seconds: float, at_rest: bool) -> None:
        """Leave the controller without answers until its EGM has ended. Raises RefusedError unless all is at rest."""
        if not at_rest or self._arm.problem(now):
            raise RefusedError("not muted: only at rest, disarmed and with EGM running, in mjx-tt robot commission")
        self.lasted, self._began, self._end = None, now, now + min(seconds, LONGEST)

    def active(self, now: float) -> bool:
        """True while the controller gets no answers."""
        feedback = self._arm.feedback
        if self.lasted is None and now >= self._began and feedback is not None:
            gone = now - feedback.received > self._arm.config.timeout
            if gone or not feedback.egm_running:
                self.lasted = feedback.received - self._began
        return self.lasted is None and self._began <= now < self._end
