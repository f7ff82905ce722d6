"""An emulated Festo axis: a register bank, a drive behind it, the delays of both.

``AxisEmulator`` has no socket and no clock: the rig steps it with the plant's position and moves the plant by the
velocity it gives; ``DirectLink`` or ``serve`` brings the registers to the computer that is being tested.

Latency of a change of the commanded velocity, seen at the set-point for the plant, with the defaults: half a cycle of
the bus (4 ms), the dead time (50 ms), half of the acceleration's ramp over one policy period (6.7 ms), half of the
smoothing window (4 ms): 64.7 ms.
"""

from __future__ import annotations

import threading
from collections import deque

from robot_io.devices.festo.modbus_link import AxisLost
from robot_io.emulator.axis_drive import Drive as Drive
from robot_io.emulator.axis_drive import DriveParams as DriveParams
from robot_io.emulator.axis_drive import Power as Power
from robot_io.emulator.axis_motion import Past
from robot_io.emulator.axis_registers import REGISTERS, AxisUnits, CmmtRegisters, FhppRegisters
from robot_io.emulator.axis_server import AxisServer as AxisServer
from robot_io.emulator.axis_server import serve as serve

SAFE_TORQUE_OFF = 0x33  # our number
MAILBOX_READ, MAILBOX_WRITE, MAILBOX_ERROR, MAILBOX_DONE = 0x01, 0x02, 0x03, 0x10  # as in festo-edcon


class IllegalAddress(AxisLost):
    """Registers that the bank does not have, or not for that."""


class AxisEmulator:
    """One axis. ``exchange`` may be called from another thread than ``step``.

    profile         "cmmt" or "fhpp"
    dead_time       from the writing of registers to their effect [s]
    feedback_delay  age of the position and velocity that can be read [s]
    node_guard      silence after which an enabled drive faults [s], 0 for never; CMMT: may be written over
    units           counts of the drive's set-up, those of the profile's defaults when not given
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
        self.node_guard = node_guard
        self.images = 0  # of the output registers taken so far
        self.disconnected = False
        self.guard_tripped = False  # until the server has closed the connection
        self._bank: CmmtRegisters | FhppRegisters = REGISTERS[profile](units)
        self._dead_time, self._delay = dead_time, feedback_delay
        self._lock = threading.Lock()
        self._now = 0.0
        self._written: float | None = None
        self._outputs = [0] * self._bank.longest
        self._arrived: deque[list[int]] = deque()
        self._queue: deque[tuple[float, list[int]]] = deque()
        self._past = Past(feedback_delay + 0.02)
        self._reported = (0.0, 0.0)
        self._mailbox = [0] * 74
        self._parameters = self._bank.parameters()

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
                drive.step(max(due, self._now))
                self._now = max(due, self._now)
                self._bank.apply(words, drive)
            guard, silent = self.node_guard, self._written is not None and now - self._written > self.node_guard
            if guard > 0.0 and silent and drive.power is not Power.INHIBITED and drive.power is not Power.READY:
                self.guard_tripped = True
                drive.fault(self._bank.guard_code)
            drive.step(now)
            self._now = now
            self._past.add(now, position, velocity)
            delayed, delayed_velocity = self._past.at(now - self._delay)
            self._reported = (delayed - (drive.origin or 0.0), delayed_velocity)
            return drive.set_point()

    def exchange(self, write_address: int, values: list[int], read_address: int, count: int) -> list[int]:
        """Writes, then reads; neither when one of them is not possible. Raises AxisLost."""
        with self._lock:
            if self.disconnected:
                raise AxisLost("the emulated axis is disconnected")
            if not self.readable(read_address, count) or not self.writable(write_address, values):
                raise IllegalAddress(
                    f"illegal data address: writing {len(values)} registers from {write_address} on, reading {count} "
                    f"from {read_address} on; there are {self._bank.ranges}"
                )
            self._write(write_address, list(values))
            return self._read(read_address, count)

    def write(self, address: int, values: list[int]) -> None:
        with self._lock:
            if self.disconnected or not self.writable(address, values):
                raise IllegalAddress(f"illegal data address: writing {len(values)} registers from {address} on")
            self._write(address, list(values))

    def read(self, address: int, count: int) -> list[int]:
        with self._lock:
            if self.disconnected or not self.readable(address, count):
                raise IllegalAddress(f"illegal data address: reading {count} registers from {address} on")
            return self._read(address, count)

    @property
    def ranges(self) -> tuple[tuple[int, int], ...]:
        """First and one past the last address of each block of registers."""
        return self._bank.ranges

    def readable(self, address: int, count: int) -> bool:
        return count > 0 and any(low <= address and address + count <= high for low, high in self._bank.ranges)

    def writable(self, address: int, values: list[int]) -> bool:
        """Process data only as a whole: half an image from a damaged request must not move anything."""
        bank, count = self._bank, len(values)
        if not self.readable(address, count) or not all(0 <= v <= 0xFFFF for v in values):
            return False
        if address < bank.output_address + bank.longest:
            return address == bank.output_address and bank.shortest <= count <= bank.longest
        return bank.read_only is None or not bank.read_only[0] <= address < bank.read_only[1]

    def inject_fault(self, code: int) -> None:
        """A fault of the drive; it brakes, and stays off until the fault is acknowledged."""
        with self._lock:
            self.drive.fault(code)

    def cut_power(self) -> None:
        """Its STO inputs are open: no power stage, until they close and it is switched on again."""
        with self._lock:
            self.drive.fault(SAFE_TORQUE_OFF)

    def power_cycle(self, reading: float) -> None:
        """The drive's supply is switched off and on: it has no reference, and reads ``reading`` [m] where it stands."""
        with self._lock:
            self.drive.restart(reading)

    def disconnect(self) -> None:
        """The cable is pulled: nothing gets through until ``reconnect``."""
        self.disconnected = True

    def reconnect(self) -> None:
        self.disconnected = False

    @property
    def outputs(self) -> list[int]:
        """The image of the output registers last written."""
        with self._lock:
            return list(self._outputs)

    def _write(self, address: int, values: list[int]) -> None:
        bank = self._bank
        if address == bank.output_address:
            self._outputs[: len(values)] = values
            self._arrived.append(list(self._outputs))
            self.images += 1
        elif bank.guard_address is not None and bank.guard_address <= address < bank.guard_address + 2:
            both = self._guard_words()
            both[address - bank.guard_address : address - bank.guard_address + len(values)] = values
            self.node_guard = (both[0] + 65536 * both[1]) / 1000.0
        elif bank.mailbox_address is not None:
            start = address - bank.mailbox_address
            self._mailbox[start : start + len(values)] = values
            if start <= 3 < start + len(values):
                self._mailbox[3] = self._mailbox_answer(self._mailbox[3])

    def _read(self, address: int, count: int) -> list[int]:
        bank = self._bank
        if bank.input_address <= address < bank.input_address + bank.inputs:
            block, start = bank.report(self.drive, *self._reported), bank.input_address
        elif address < bank.longest:
            block, start = self._outputs, bank.output_address
        elif bank.mailbox_address is not None and address >= bank.mailbox_address:
            block, start = self._mailbox, bank.mailbox_address
        else:
            block, start = self._guard_words(), bank.guard_address or 0
        return [int(v) for v in block[address - start : address - start + count]]

    def _guard_words(self) -> list[int]:
        milliseconds = round(self.node_guard * 1000.0)
        return [milliseconds & 0xFFFF, milliseconds >> 16]

    def _mailbox_answer(self, request: int) -> int:
        """Parameters have no effect: number, subindex, elements, request, length, then from 510 on the data."""
        key = (self._mailbox[0], self._mailbox[1])
        if request == MAILBOX_WRITE:
            self._parameters[key] = [self._mailbox[4], *self._mailbox[10:]]
            return MAILBOX_DONE
        if request == MAILBOX_READ and key in self._parameters:
            self._mailbox[4], *data = self._parameters[key]
            self._mailbox[10:] = [*data, *[0] * 64][:64]
            return MAILBOX_DONE
        return MAILBOX_ERROR
