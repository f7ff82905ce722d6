"""Emulated register banks: how words written to an axis move its drive, and what it reports.

Written from the registers' side without the computer's codecs (``robot_io.devices.festo``); only names are shared.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from robot_io.devices.festo.cmmt import STW1, ZSW1, PosSTW1, PosZSW1
from robot_io.devices.festo.fhpp import CCON, CDIR, CPOS, SCON, SPOS
from robot_io.emulator.axis_drive import Drive, Power

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


class CmmtRegisters:
    """Telegram 111: outputs 0..27, inputs 100..127, time-out 400, parameter mailbox 500..573."""

    units = AxisUnits(position=1e-6)
    guard_code = 391
    output_address, shortest, longest = 0, 11, 28
    input_address, inputs = 100, 28
    ranges = ((0, 28), (100, 128), (400, 402), (500, 574))
    read_only = (100, 128)
    guard_address: int | None = 400
    mailbox_address: int | None = 500

    def __init__(self, units: AxisUnits | None = None) -> None:
        self.units = units or self.units
        self._last = [0] * self.shortest

    def parameters(self) -> dict[tuple[int, int], list[int]]:
        """Its units by number and subindex: bytes of data, then words. Resolutions are powers of ten, bytes long."""
        units = self.units
        resolutions = {11724: units.position, 11725: units.velocity}
        reals = {12345: units.base_velocity, 12346: units.base_acceleration, 12347: units.base_acceleration}
        found = {(n, 0): [1, round(math.log10(value)) & 0xFF] for n, value in resolutions.items()}
        return found | {(n, 0): [4, *struct.unpack("<HH", struct.pack("<f", value))] for n, value in reals.items()}

    def apply(self, words: list[int], drive: Drive) -> None:
        """Takes one image of the output registers."""
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
            drive.abort_homing()
        if not now & STW1.NO_REJECT_TASK:
            drive.halt()
        elif not now & STW1.NO_INTERMEDIATE_STOP:
            drive.pause()
        else:
            drive.resume()
            mode = words[1]
            absolute = bool(mode & PosSTW1.ABSOLUTE)
            update = drive.task and absolute and mode & PosSTW1.CONTINUOUS_UPDATE
            if mode & PosSTW1.MDI and now & STW1.ACTIVATE_TASK and (rising & STW1.ACTIVATE_TASK or update):
                self._start(words, drive, absolute)

    def _start(self, words: list[int], drive: Drive, absolute: bool) -> None:
        override = min(words[4], FULL) / FULL
        drive.position(
            _int32(words[5], words[6]) * self.units.position,
            _int32(words[7], words[8]) * self.units.velocity * override,
            min(words[9], words[10]) / FULL * self.units.base_acceleration,
            relative=not absolute,
        )

    def report(self, drive: Drive, position: float, velocity: float) -> list[int]:
        """The input registers."""
        power, last = drive.power, self._last[0]
        powered = power in (Power.OPERATING, Power.SWITCHING_OFF)
        zsw1 = ZSW1.FOLLOWING | ZSW1.CONTROL_REQUESTED
        zsw1 |= ZSW1.READY_TO_SWITCH_ON * (power is not Power.INHIBITED) | ZSW1.READY_TO_OPERATE * powered
        zsw1 |= ZSW1.OPERATION_ENABLED * drive.operating | ZSW1.FAULT * bool(drive.fault_code)
        zsw1 |= ZSW1.NO_COAST_STOP * bool(last & STW1.NO_COAST_STOP) | ZSW1.NO_QUICK_STOP * bool(
            last & STW1.NO_QUICK_STOP
        )
        zsw1 |= ZSW1.INHIBITED * (power is Power.INHIBITED) | ZSW1.TARGET_REACHED * (drive.reached and not drive.homing)
        zsw1 |= ZSW1.HOME_SET * drive.homed | ZSW1.STOPPED * (drive.v == 0.0)
        zsw1 |= ZSW1.TASK_ACKNOWLEDGED * bool(drive.task and last & STW1.ACTIVATE_TASK)
        mdi = bool(self._last[1] & PosSTW1.MDI) and drive.operating
        words = [int(zsw1), int(PosZSW1.HOMING * drive.homing | PosZSW1.MDI * mdi), 0, 0, 0]
        words += _words(round(position / self.units.position))
        words += _words(round(velocity / self.units.base_velocity * FULL * 65536))
        words += [drive.fault_code, 0]
        return words + [0] * (self.inputs - len(words))


class FhppRegisters:
    """FHPP direct mode: four registers at 0, outputs when written and inputs when read."""

    units = AxisUnits(position=1e-5)
    guard_code = 0x47
    output_address, shortest, longest = 0, 4, 4
    input_address, inputs = 0, 4
    ranges = ((0, 4),)
    read_only: tuple[int, int] | None = None
    guard_address: int | None = None
    mailbox_address: int | None = None

    def __init__(self, units: AxisUnits | None = None) -> None:
        self.units = units or self.units
        self._last = (0, 0, 0)

    def parameters(self) -> dict[tuple[int, int], list[int]]:
        """It has no mailbox."""
        return {}

    def apply(self, words: list[int], drive: Drive) -> None:
        """Takes one image of the output registers."""
        ccon, cpos, cdir, percent = words[0] >> 8, words[0] & 0xFF, words[1] >> 8, words[1] & 0xFF
        last_ccon, last_cpos, last_cdir = self._last
        self._last = (ccon, cpos, cdir)
        if ccon & ~last_ccon & CCON.RESET:
            drive.acknowledge()
        drive.request_power(bool(ccon & CCON.ENABLE), bool(ccon & CCON.STOP))
        if cpos & ~last_cpos & CPOS.HOM:
            drive.home()
        elif drive.homing and not cpos & CPOS.HOM:
            drive.abort_homing()
        if not cpos & CPOS.HALT:
            drive.pause()
            if cpos & CPOS.CLEAR:
                drive.halt()
            return
        drive.resume()
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
        """The input registers."""
        ccon, cpos, cdir = self._last
        scon = SCON.VLOAD | SCON.FAULT * bool(drive.fault_code) | SCON.OPM1 * bool(ccon & CCON.OPM1)
        scon |= (SCON.ENABLED | SCON.OPEN) * drive.operating
        spos = SPOS.HALT * bool(cpos & CPOS.HALT) | SPOS.REF * drive.homed | SPOS.MOV * (drive.v != 0.0 or drive.homing)
        spos |= SPOS.ACK * bool(cpos & (CPOS.START | CPOS.HOM)) | SPOS.MC * (drive.reached and not drive.homing)
        percent = min(max(round(velocity / self.units.base_velocity * 100), -128), 127) & 0xFF
        low, high = _words(round(position / self.units.position))
        return [int(scon) << 8 | int(spos), (cdir & ~CDIR.CONTT) << 8 | percent, high, low]


REGISTERS: dict[str, type[CmmtRegisters] | type[FhppRegisters]] = {"cmmt": CmmtRegisters, "fhpp": FhppRegisters}
