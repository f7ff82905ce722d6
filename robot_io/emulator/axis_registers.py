"""Emulated register banks: how words written to an axis move its drive, and what it reports.

Written from the registers' side without the computer's codecs (``robot_io.devices.festo``); only names are shared.
"""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass

from robot_io.devices.festo.cmmt import STW1, ZSW1, PosSTW1, PosZSW1
from robot_io.devices.festo.fhpp import CCON, CDIR, CPOS, SCON, SPOS
from robot_io.emulator.axis_drive import Drive, Power

MAILBOX_READ, MAILBOX_WRITE, MAILBOX_ERROR, MAILBOX_DONE = 0x01, 0x02, 0x03, 0x10  # as in festo-edcon
FULL = 0x4000  # 100 % in a word, 100 % * 2**16 in a double word


def _int32(low: int, high: int) -> int:
    value = low + 65536 * high
    return value - 2**32 if value >= 2**31 else value


def _words(value: int) -> tuple[int, int]:
    """Low and high word; what does not fit stays at the end of the range."""
    value = min(max(value, -(2**31)), 2**31 - 1)
    return value & 0xFFFF, (value >> 16) & 0xFFFF


@dataclass(frozen=True)
class AxisUnits:
    """Counts by the drive's set-up: [m] and [m/s] of one count, and of 100 % [m/s], [m/s^2]."""

    position: float
    velocity: float = 1e-3
    base_velocity: float = 2.0
    base_acceleration: float = 15.0


class Registers(ABC):
    """One axis's bank: its registers, and what an image of the outputs, which begin at 0, does to the drive.

    guard_code  fault for a computer that has fallen silent
    shortest    registers of an image, of at most ``longest``
    inputs      first address of those that report
    outputs     as last written
    blocks      all that can be read, by first address
    node_guard  silence after which an enabled drive faults [s], 0 for never
    """

    units: AxisUnits
    guard_code: int
    shortest: int
    longest: int
    inputs: int
    blocks: dict[int, list[int]]

    def __init__(self, units: AxisUnits | None, node_guard: float) -> None:
        self.units, self.node_guard = units or self.units, node_guard
        self.outputs = [0] * self.longest

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """First and one past the last address of each block."""
        return [(start, start + len(block)) for start, block in self.blocks.items()]

    def readable(self, address: int, count: int) -> bool:
        return count > 0 and any(low <= address and address + count <= high for low, high in self.ranges)

    def writable(self, address: int, values: list[int]) -> bool:
        """Process data only as a whole: half an image from a damaged request must not move anything."""
        if not self.readable(address, len(values)) or not all(0 <= v <= 0xFFFF for v in values):
            return False
        if address < self.longest:
            return address == 0 and self.shortest <= len(values)
        return self._start(address) != self.inputs

    def read(self, address: int, count: int, drive: Drive, position: float, velocity: float) -> list[int]:
        """Registers of a drive that reports this position [m] and velocity [m/s]."""
        self.blocks[self.inputs] = self.report(drive, position, velocity)
        start = self._start(address)
        return self.blocks[start][address - start : address - start + count]

    def _start(self, address: int) -> int:
        return max(start for start in self.blocks if start <= address)

    def write(self, address: int, values: list[int]) -> None:
        """Take registers; an image of the outputs does nothing until it is applied."""
        self.outputs[: len(values)] = values

    @abstractmethod
    def apply(self, words: list[int], drive: Drive) -> None:
        """Let one image of the output registers act."""

    @abstractmethod
    def report(self, drive: Drive, position: float, velocity: float) -> list[int]:
        """The input registers."""


class CmmtRegisters(Registers):
    """Telegram 111: outputs 0..27, inputs 100..127, time-out 400, parameter mailbox 500..573."""

    units = AxisUnits(position=1e-6)
    guard_code = 391
    shortest, longest = 11, 28
    inputs = 100

    def __init__(self, units: AxisUnits | None, node_guard: float) -> None:
        super().__init__(units, node_guard)
        self._last = [0] * self.shortest
        milliseconds = round(node_guard * 1000.0)
        self.blocks = {0: self.outputs, 100: [0] * 28, 400: [milliseconds & 0xFFFF, milliseconds >> 16], 500: [0] * 74}
        # The drive's units by number and subindex: bytes of data, then words. Resolutions are powers of ten, one byte.
        resolutions = {11724: self.units.position, 11725: self.units.velocity}
        base = self.units.base_acceleration
        reals = {12345: self.units.base_velocity, 12346: base, 12347: base}
        self._parameters = {(n, 0): [1, round(math.log10(value)) & 0xFF] for n, value in resolutions.items()}
        for n, value in reals.items():
            self._parameters[n, 0] = [4, *struct.unpack("<HH", struct.pack("<f", value))]

    def write(self, address: int, values: list[int]) -> None:
        start = self._start(address)
        block = self.blocks[start]
        block[address - start : address - start + len(values)] = values
        if start == 400:
            self.node_guard = (block[0] + 65536 * block[1]) / 1000.0
        elif start == 500 and address <= 503 < address + len(values):
            block[3] = self._answer(block, block[3])

    def _answer(self, mailbox: list[int], request: int) -> int:
        """Parameters have no effect: number, subindex, elements, request, length, then from 510 on the data."""
        key = (mailbox[0], mailbox[1])
        if request == MAILBOX_WRITE:
            self._parameters[key] = [mailbox[4], *mailbox[10:]]
            return MAILBOX_DONE
        if request == MAILBOX_READ and key in self._parameters:
            mailbox[4], *data = self._parameters[key]
            mailbox[10:] = [*data, *[0] * 64][:64]
            return MAILBOX_DONE
        return MAILBOX_ERROR

    def apply(self, words: list[int], drive: Drive) -> None:
        now, last = words[0], self._last[0]
        self._last = words
        rising = now & ~last
        if not now & STW1.CONTROL_BY_PLC:
            drive.request_power(False, True)
            return
        if rising & STW1.FAULT_ACKNOWLEDGE:
            drive.acknowledge()
        allowed = bool(now & STW1.NO_COAST_STOP and now & STW1.NO_QUICK_STOP)
        drive.request_power(bool(now & STW1.ON and now & STW1.ENABLE_OPERATION), allowed)
        if rising & STW1.START_HOMING:
            drive.home()
        elif drive.homing and not now & STW1.START_HOMING:
            drive.homing = False
        if not now & STW1.NO_REJECT_TASK:
            drive.halt()
        elif not now & STW1.NO_INTERMEDIATE_STOP:
            drive.paused = True
        else:
            drive.paused = False
            mode = words[1]
            absolute = bool(mode & PosSTW1.ABSOLUTE)
            update = drive.task and absolute and mode & PosSTW1.CONTINUOUS_UPDATE
            if mode & PosSTW1.MDI and now & STW1.ACTIVATE_TASK and (rising & STW1.ACTIVATE_TASK or update):
                drive.position(
                    _int32(words[5], words[6]) * self.units.position,
                    _int32(words[7], words[8]) * self.units.velocity * (min(words[4], FULL) / FULL),
                    min(words[9], words[10]) / FULL * self.units.base_acceleration,
                    relative=not absolute,
                )

    def report(self, drive: Drive, position: float, velocity: float) -> list[int]:
        power, last = drive.power, self._last[0]
        zsw1 = ZSW1.FOLLOWING | ZSW1.CONTROL_REQUESTED
        zsw1 |= ZSW1.READY_TO_SWITCH_ON * (power is not Power.INHIBITED) | ZSW1.READY_TO_OPERATE * drive.powered
        zsw1 |= ZSW1.OPERATION_ENABLED * drive.operating | ZSW1.FAULT * bool(drive.fault_code)
        zsw1 |= ZSW1.NO_COAST_STOP * bool(last & STW1.NO_COAST_STOP)
        zsw1 |= ZSW1.NO_QUICK_STOP * bool(last & STW1.NO_QUICK_STOP)
        zsw1 |= ZSW1.INHIBITED * (power is Power.INHIBITED) | ZSW1.TARGET_REACHED * (drive.reached and not drive.homing)
        zsw1 |= ZSW1.HOME_SET * drive.homed | ZSW1.STOPPED * (drive.v == 0.0)
        zsw1 |= ZSW1.TASK_ACKNOWLEDGED * bool(drive.task and last & STW1.ACTIVATE_TASK)
        mdi = bool(self._last[1] & PosSTW1.MDI) and drive.operating
        words = [int(zsw1), int(PosZSW1.HOMING * drive.homing | PosZSW1.MDI * mdi), 0, 0, 0]
        words += _words(round(position / self.units.position))
        words += _words(round(velocity / self.units.base_velocity * FULL * 65536))
        words += [drive.fault_code, 0]
        return words + [0] * (28 - len(words))


class FhppRegisters(Registers):
    """FHPP direct mode: four registers at 0, outputs when written and inputs when read."""

    units = AxisUnits(position=1e-5)
    guard_code = 0x47
    shortest = longest = 4
    inputs = 0

    def __init__(self, units: AxisUnits | None, node_guard: float) -> None:
        super().__init__(units, node_guard)
        self._last, self.blocks = (0, 0, 0), {0: [0] * 4}

    def apply(self, words: list[int], drive: Drive) -> None:
        ccon, cpos, cdir, percent = words[0] >> 8, words[0] & 0xFF, words[1] >> 8, words[1] & 0xFF
        last_ccon, last_cpos, last_cdir = self._last
        self._last = (ccon, cpos, cdir)
        if ccon & ~last_ccon & CCON.RESET:
            drive.acknowledge()
        drive.request_power(bool(ccon & CCON.ENABLE), bool(ccon & CCON.STOP))
        if cpos & ~last_cpos & CPOS.HOM:
            drive.home()
        elif drive.homing and not cpos & CPOS.HOM:
            drive.homing = False
        if not cpos & CPOS.HALT:
            drive.paused = True
            if cpos & CPOS.CLEAR:
                drive.halt()
            return
        drive.paused = False
        toggled = cdir & CDIR.CONT and cpos & CPOS.START and drive.task and (cdir ^ last_cdir) & CDIR.CONTT
        started = cpos & ~last_cpos & CPOS.START
        if ccon & CCON.OPM1 and not cdir & (CDIR.COM1 | CDIR.COM2) and (started or toggled):
            drive.position(
                _int32(words[3], words[2]) * self.units.position,
                min(percent, 100) / 100.0 * self.units.base_velocity,
                self.units.base_acceleration,
                relative=bool(cdir & CDIR.RELATIVE),
            )

    def report(self, drive: Drive, position: float, velocity: float) -> list[int]:
        ccon, cpos, cdir = self._last
        scon = SCON.VLOAD | SCON.FAULT * bool(drive.fault_code) | SCON.OPM1 * bool(ccon & CCON.OPM1)
        scon |= (SCON.ENABLED | SCON.OPEN) * drive.operating
        spos = SPOS.HALT * bool(cpos & CPOS.HALT) | SPOS.REF * drive.homed | SPOS.MOV * (drive.v != 0.0 or drive.homing)
        spos |= SPOS.ACK * bool(cpos & (CPOS.START | CPOS.HOM)) | SPOS.MC * (drive.reached and not drive.homing)
        percent = min(max(round(velocity / self.units.base_velocity * 100), -128), 127) & 0xFF
        low, high = _words(round(position / self.units.position))
        return [int(scon) << 8 | int(spos), (cdir & ~CDIR.CONTT) << 8 | percent, high, low]


REGISTERS: dict[str, type[Registers]] = {"cmmt": CmmtRegisters, "fhpp": FhppRegisters}
