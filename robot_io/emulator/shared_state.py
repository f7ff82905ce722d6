"""The state that the rig's processes share: the world writes it, the emulators of arm and axes write set-points.

One block of float64 in shared memory. The world counts a version up before and after it writes, so a reader that
has read half of two states knows and reads again.
"""

from __future__ import annotations

import math
import sys
import time as clock
from multiprocessing import shared_memory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robot_io.contract import N_JOINTS

JOINT_FIELDS = ("qpos", "qvel", "setpoint")
# held: 1: the ball is at the place that follows, 2: it is clipped to the blade; driven: time [s] up to which arm and
# axes have given their set-points.
OTHER_FIELDS = {"ball": 3, "held": 4, "driven": 2} | dict.fromkeys(
    ("version", "time", "ball_number", "ball_in_play", "collisions", "throwing", "thrown", "finish", "jog"), 1
)

START_TIME = 60.0  # [s] of a process of the rig, an opponent's compilations included
AHEAD = 0.004  # [s] by which positions are told ahead of the world's newest state: two of its steps
LATE = 0.01  # [s] from which on a world catches up in step with arm and axes
LOOK = 0.0005  # [s] between looks at a late world
ASLEEP = 0.5  # [s] from which on a process that is late makes up for nothing
PATIENCE = 0.6  # [s] of looks at a process that does nothing until it counts as stopped: it will have been ASLEEP


class Shared:
    """Fields of the block by name; ``Shared()`` makes one for so many joints, ``Shared(name)`` attaches to it."""

    def __init__(self, name: str | None = None, joints: int = N_JOINTS) -> None:
        counts = dict.fromkeys(JOINT_FIELDS, joints) | OTHER_FIELDS
        kind = np.dtype([(field, np.float64, (count,)) for field, count in counts.items()])
        # Python 3.13 can attach without its resource tracker, which otherwise unlinks the block when one process ends.
        untracked: dict[str, Any] = {"track": False} if name is not None and sys.version_info >= (3, 13) else {}
        self._owner = name is None
        self._patience = Patience()
        self._memory = shared_memory.SharedMemory(name=name, create=name is None, size=kind.itemsize, **untracked)
        self._block = np.ndarray((), kind, self._memory.buf)
        if self._owner:
            for field in counts:
                self[field][:] = 0.0

    @property
    def name(self) -> str:
        return self._memory.name

    def __getitem__(self, field: str) -> np.ndarray:
        return self._block[field]

    def value(self, field: str) -> float:
        return float(self[field][0])

    def publish(self, **state: ArrayLike) -> None:
        """Write fields of one state of the world."""
        self["version"][0] += 1
        for field, value in state.items():
            self[field][:] = value
        self["version"][0] += 1

    def read(self, *fields: str) -> list[np.ndarray]:
        """Copies of fields that belong to one state."""
        while True:
            before = self.value("version")
            copies = [self[field].copy() for field in fields]
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
