"""The operator's one key after a fault: axes on, reset, arm, each once nothing stands against it."""

from __future__ import annotations

from robot_io.control.messages import Arm, Prepare, Refused, Request, Reset, Status

LONGEST = 20.0  # [s] from the key until the robot is armed


class Recovery:
    """Steps from a fault to an armed robot, one per status of the control process.

    It waits for what is missing or present, and sends each request once; the first again while it is refused, since
    axes whose cable was out answer later.
    """

    def __init__(self, now: float) -> None:
        self._steps: list[Request] = [Prepare(), Reset(), Arm()]
        self._end, self._refusal = now + LONGEST, ""

    @property
    def done(self) -> bool:
        return not self._steps

    def refused(self, message: Refused) -> bool:
        """Take a refusal; True when it ends the recovery."""
        if not isinstance(message.request, Prepare):
            return True
        self._steps, self._refusal = [Prepare(), Reset(), Arm()], message.sentence
        return False

    def step(self, status: Status, now: float) -> Request | None:
        """Request that is due in this state; None: wait. Raises TimeoutError with what is missing."""
        if now > self._end:
            reasons = "; ".join(filter(None, [self._refusal, status.missing, *status.present.values()]))
            raise TimeoutError(f"not recovered within {LONGEST:g} s: {reasons or status.state}")
        request = self._steps[0]
        if not isinstance(request, Prepare) and (status.missing or status.present):
            return None
        if isinstance(request, Reset) and not status.faults:
            self._steps.pop(0)
            return self.step(status, now)
        if isinstance(request, Arm) and status.state != "disarmed":
            return None
        return self._steps.pop(0)
