"""An emulated Festo axis: a register bank, a drive behind it, the delays of both.

``AxisEmulator`` has no socket and no clock: the rig steps it with the plant's position and moves the plant by the
velocity it gives. It is the link of an axis in the same process itself; ``AxisServer`` brings it to another one.

Latency of a change of the commanded velocity, seen at the set-point for the plant, with the defaults: half a cycle of
the bus (4 ms), the dead time (50 ms), half of the acceleration's ramp over one policy period (6.7 ms), half of the
smoothing window (4 ms): 64.7 ms.
"""

from __future__ import annotations

import threading
from collections import deque

from robot_io.devices.festo.modbus_link import AxisLost
from robot_io.emulator.axis_drive import Drive, DriveParams, Power
from robot_io.emulator.axis_motion import Past
from robot_io.emulator.axis_registers import REGISTERS, AxisUnits

SAFE_TORQUE_OFF = 0x33  # our number


class AxisEmulator:
    """One axis. ``exchange`` may be called from another thread than ``step``.

    profile         "cmmt" or "fhpp"
    dead_time       from the writing of registers to their effect [s]
    feedback_delay  age of the position and velocity that can be read [s]
    node_guard      silence after which an enabled drive faults [s], 0 for never; CMMT: may be written over
    units           counts of the drive's set-up, those of the profile's defaults when not given

    images          of the output registers taken so far
    guard_tripped   until the server has closed the connection
    """

    def __init__(
        self,
        profile: str = "cmmt",
        dead_time: float = 0.050,
        feedback_delay: float = 0.033,
        node_guard: float = 1.0,
        params: DriveParams | None = None,
        units: AxisUnits | None = None,
    ) -> None:
        if profile not in REGISTERS:
            raise ValueError(f"axis profile {profile!r} does not exist, available are {', '.join(REGISTERS)}")
        for name, value in (("dead_time", dead_time), ("feedback_delay", feedback_delay), ("node_guard", node_guard)):
            if not 0.0 <= value <= 60.0:
                raise ValueError(f"{name} {value} must be 0 to 60 seconds")
        self.drive = Drive(params or DriveParams())
        self.bank = REGISTERS[profile](units, node_guard)
        self.images = 0
        self.disconnected = self.guard_tripped = False
        self._dead_time, self._delay = dead_time, feedback_delay
        self._lock = threading.Lock()
        self._now = 0.0
        self._written: float | None = None
        self._arrived: deque[list[int]] = deque()
        self._queue: deque[tuple[float, list[int]]] = deque()
        self._past = Past(feedback_delay + 0.02)
        self._reported = (0.0, 0.0)

    def step(self, now: float, position: float, velocity: float) -> float:
        """Moves on to ``now`` [s], the plant being at ``position`` [m] with ``velocity`` [m/s]; its new one [m/s]."""
        with self._lock:
            drive = self.drive
            drive.measure(position, velocity)
            while self._arrived:  # since the last step: later than in truth by less than a step, never earlier
                self._queue.append((now + self._dead_time, self._arrived.popleft()))
                self._written = now
            while self._queue and self._queue[0][0] <= now:
                due, words = self._queue.popleft()
                self._now = max(due, self._now)
                drive.step(self._now)
                self.bank.apply(words, drive)
            guard = self.bank.node_guard
            silent = self._written is not None and now - self._written > guard > 0.0
            if silent and drive.power is not Power.INHIBITED and drive.power is not Power.READY:
                self.guard_tripped = True
                drive.fault(self.bank.guard_code)
            drive.step(now)
            self._now = now
            self._past.add(now, position, velocity)
            delayed, delayed_velocity = self._past.at(now - self._delay)
            self._reported = (delayed - (drive.origin or 0.0), delayed_velocity)
            return drive.set_point()

    def exchange(self, write_address: int, values: list[int], read_address: int, count: int) -> list[int]:
        """Writes, then reads; neither when one of them is not possible. Raises AxisLost."""
        return self._access((write_address, list(values)), (read_address, count))

    def write(self, address: int, values: list[int]) -> None:
        """Writes registers from an address on. Raises AxisLost."""
        self._access((address, list(values)), None)

    def read(self, address: int, count: int) -> list[int]:
        """So many registers from an address on. Raises AxisLost."""
        return self._access(None, (address, count))

    def _access(self, write: tuple[int, list[int]] | None, read: tuple[int, int] | None) -> list[int]:
        bank = self.bank
        with self._lock:
            if self.disconnected:
                raise AxisLost("the emulated axis is disconnected")
            if write is not None and not bank.writable(*write):
                raise AxisLost(f"illegal data address: writing {len(write[1])} registers from {write[0]} on")
            if read is not None and not bank.readable(*read):
                raise AxisLost(f"illegal data address: reading {read[1]} registers from {read[0]} on")
            if write is not None:
                bank.write(*write)
                if write[0] == 0:  # process data
                    self._arrived.append(list(bank.outputs))
                    self.images += 1
            return [] if read is None else bank.read(*read, self.drive, *self._reported)

    def disconnect(self) -> None:
        """The cable is pulled: nothing gets through until ``reconnect``."""
        self.disconnected = True

    def reconnect(self) -> None:
        self.disconnected = False

    def close(self) -> None:
        """As the link of an axis: nothing is open."""

    def inject_fault(self, code: int) -> None:
        """A fault of the drive; it brakes, and stays off until the fault is acknowledged."""
        with self._lock:
            self.drive.fault(code)

    def cut_power(self) -> None:
        """Its STO inputs are open: no power stage, until they close and it is switched on again."""
        self.inject_fault(SAFE_TORQUE_OFF)

    def power_cycle(self, reading: float) -> None:
        """The drive's supply is switched off and on: it has no reference, and reads ``reading`` [m] where it stands."""
        with self._lock:
            self.drive.restart(reading)
