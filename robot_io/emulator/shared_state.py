"""The state that the rig's processes share: the world writes it, the emulators of arm and axes write set-points.

One block of float64 in shared memory. The world counts a version up before and after it writes, so a reader that
has read half of two states knows and reads again.
"""

from __future__ import annotations

import math
import time as clock
from multiprocessing import shared_memory

import numpy as np

from robot_io.contract import N_JOINTS

JOINTS = -1  # stands for as many numbers as the robot has joints
_FIELDS = {
    "version": 1,
    "time": 1,
    "qpos": JOINTS,
    "qvel": JOINTS,
    "ball": 3,
    "ball_number": 1,
    "ball_in_play": 1,
    "collisions": 1,
    "setpoint": JOINTS,
    "throwing": 1,
    "thrown": 1,
    "finish": 1,
    "estop": 1,
    "jog": 1,
    "held": 4,  # 1: the ball is at the place that follows; 2: it is clipped to the blade
    "silent_until": 1,
    "driven": 2,  # time [s] up to which arm and axes have given their set-points
}

START_TIME = 60.0  # [s] of a process of the rig, an opponent's compilations included
AHEAD = 0.004  # [s] by which positions are told ahead of the world's newest state: two of its steps
LATE = 0.01  # [s] from which on a world catches up in step with arm and axes
LOOK = 0.0005  # [s] between looks at a late world
ASLEEP = 0.5  # [s] from which on a process that is late makes up for nothing
PATIENCE = 0.6  # [s] of looks at a process that does nothing until it counts as stopped: it will have been ASLEEP


class Shared:
    """Views into the block by name; ``Shared()`` makes one for so many joints, ``Shared(name)`` attaches to it."""

    def __init__(self, name: str | None = None, joints: int = N_JOINTS) -> None:
        counts = {field: joints if count == JOINTS else count for field, count in _FIELDS.items()}
        size = 8 * sum(counts.values())
        self._owner = name is None
        self._patience = Patience()
        self._memory = shared_memory.SharedMemory(name=name, create=name is None, size=size, **_untracked(name))
        self._block = np.ndarray((sum(counts.values()),), np.float64, self._memory.buf)
        if self._owner:
            self._block[:] = 0.0
        start = 0
        self.views: dict[str, np.ndarray] = {}
        for field, count in counts.items():
            self.views[field] = self._block[start : start + count]
            start += count

    @property
    def name(self) -> str:
        return self._memory.name

    def __getitem__(self, field: str) -> np.ndarray:
        return self.views[field]

    def value(self, field: str) -> float:
        return float(self.views[field][0])

    def publish(
        self,
        time: float,
        qpos: np.ndarray,
        qvel: np.ndarray,
        ball: np.ndarray,
        number: int,
        in_play: bool,
        collisions: int,
        thrown: int,
    ) -> None:
        """The world's state at ``time`` [s]."""
        views = self.views
        views["version"][0] += 1
        views["time"][0], views["qpos"][:], views["qvel"][:], views["ball"][:] = time, qpos, qvel, ball
        views["ball_number"][0], views["ball_in_play"][0] = number, in_play
        views["collisions"][0], views["thrown"][0] = collisions, thrown
        views["version"][0] += 1

    def read(self, *fields: str) -> list[np.ndarray]:
        """Copies of fields that belong to one state."""
        while True:
            before = self.value("version")
            copies = [self.views[field].copy() for field in fields]
            if before % 2 == 0 and self.value("version") == before:
                return copies

    def await_drives(self, time: float) -> None:
        """Wait, while the world is late, for the set-points of arm and axes: it must not run on at old ones.

        time: [s] that the world is going to; it goes on without them once they have done nothing for PATIENCE.
        """
        while time + LATE < clock.monotonic() and not self["finish"][0]:
            driven = float(self["driven"].min())
            if driven >= time - 2.0 * AHEAD or not self._patience.lasts(driven):
                return
            clock.sleep(LOOK)

    def close(self) -> None:
        self.views.clear()
        del self._block
        self._memory.close()
        self.unlink()

    def unlink(self) -> None:
        """Take away the name of a block that was made here: once all have attached, no death leaves it behind."""
        if self._owner:
            self._owner = False
            self._memory.unlink()


class Patience:
    """With another process, by looks at how far it is: it lasts while that one gets on, however late it is.

    Seconds would not do. Where the whole machine stands still they pass for the one that waits and the one that is
    waited for alike, and on a busy machine the waited-for gets on, but slowly.
    """

    LOOKS = round(PATIENCE / LOOK)

    def __init__(self) -> None:
        self._seen, self._left = -math.inf, self.LOOKS

    def lasts(self, time: float) -> bool:
        """One look at the ``time`` [s] that the other process has got to."""
        self._left = self.LOOKS if time > self._seen else max(self._left - 1, 0)
        self._seen = time
        return self._left > 0


class Motion:
    """The joints' motion as one emulator sees it, at the times of its own cycles.

    Hardware moves on whatever a scheduler does. A world that is late is waited for, so that its catching up is no jump
    of the joints from one cycle to the next; between two states that an emulator has slept through it interpolates.
    """

    def __init__(self, shared: Shared) -> None:
        """Waits for the world's first state; raises TimeoutError after START_TIME."""
        self._shared, began = shared, clock.monotonic()
        while not shared["version"][0] and not shared["finish"][0]:
            if clock.monotonic() > began + START_TIME:
                raise TimeoutError(f"the world has not begun within {START_TIME:g} s")
            clock.sleep(LOOK)
        self._newest = self._before = self._look()
        self._patience = Patience()

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (n,) at ``time`` [s]; as they were last when the world stands still."""
        if time > self._newest[0]:
            self._before, self._newest = self._newest, self._look()
        while (
            self._newest[0] < time - AHEAD and self._patience.lasts(self._newest[0]) and not self._shared["finish"][0]
        ):
            clock.sleep(LOOK)
            self._newest = self._look()
        (start, qpos, qvel), (end, following, faster) = self._before, self._newest
        if time >= end:
            return following + faster * min(time - end, AHEAD), faster
        share = min(max((time - start) / (end - start), 0.0), 1.0)
        return qpos + share * (following - qpos), qvel + share * (faster - qvel)

    def _look(self) -> tuple[float, np.ndarray, np.ndarray]:
        taken, qpos, qvel = self._shared.read("time", "qpos", "qvel")
        return float(taken[0]), qpos, qvel


def _untracked(name: str | None) -> dict:
    """Python 3.13 can attach without its resource tracker, which otherwise unlinks the block when one process ends."""
    import sys

    return {"track": False} if name is not None and sys.version_info >= (3, 13) else {}
