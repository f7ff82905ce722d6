"""Stand-ins for arm and axes in a dry run: what is commanded is done at once, in thought; nothing is sent.

The real arm is listened to: until the bridge is armed, the stand-in is where the real one is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robot_io.devices.egm.messages import ArmFeedback
from robot_io.devices.egm.session import EgmConfig, EgmSession

HEARD = 0.2  # [s] since a packet of the real arm


class DryArm(EgmSession):
    """An EGM session that never answers; ``real`` is the one with the controller.

    position (6,) [rad]: where it is while no controller is heard
    """

    def __init__(self, config: EgmConfig, position: np.ndarray) -> None:
        super().__init__(config)
        self.real = EgmSession(config)
        self.statistics = self.real.statistics
        self._place, self._count, self._armed = np.array(position), 0, False

    def receive(self, datagram: bytes, source: tuple[str, int], now: float) -> bool:
        """Take one datagram of the real controller; False: there is nothing to answer."""
        self.real.receive(datagram, source, now)
        return False

    def pretend(self, now: float, armed: bool) -> None:
        """Report where the arm is in thought, ``armed`` or where the real one is."""
        heard = self.real.feedback
        if not armed and heard is not None and now - heard.received < HEARD:
            self._place = heard.position
        self._armed, self._count = armed, self._count + 1
        self.feedback = ArmFeedback(self._count, now, self._place, True, True, True, now)

    def reply(self, position: ArrayLike, velocity: ArrayLike, now: float) -> None:
        """Do what would have been sent."""
        if self._armed:
            self._place = np.array(position, float)

    def problem(self, now: float) -> str | None:
        return None


@dataclass
class DryAxes:
    """Linear axes in thought, for ``AxesThread``; position (axes,) [m]."""

    position: np.ndarray
    received: float = 0.0
    cycles: int = 0
    late: int = 0
    fault: None = None
    homed: bool = True
    answering: bool = True
    homing: bool = False

    @property
    def state(self) -> DryAxes:
        return self

    def cycle(self, now: float) -> None:
        """Report the position at ``now``."""
        self.received = now

    def command(self, position: ArrayLike, velocity: ArrayLike, now: float) -> None:
        self.position = np.array(position, float)

    def start(self) -> None: ...

    enable = home = acknowledge = stop = disable = close = start

    def preparable(self, now: float) -> bool:
        return True

    def problem(self, now: float) -> str | None:
        return None
