"""Festo Handling and Positioning Profile, direct mode: eight bytes each way in four Modbus registers.

    out  CCON, CPOS, CDIR, speed [% of a base value], position (4)
    in   SCON, SPOS, SDIR, velocity [%, signed], position (4)
Modbus sends the high byte of a register first, so the first register is CCON * 256 + CPOS and the position comes high
word first. Bits: Festo's manuals of CMMP-AS (P.BE-CMMP-CAM-SW-EN, 6.4), CPX-CMAX and SFC-LACI (continuous setpoints);
registers and function code 0x17: GDCP-CMMO-ST-LK-C-HP-EN, 4.3. One per cent of the speed is the finest step.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag

from robot_io.devices.festo.faults import FHPP_FAULTS, fault_text
from robot_io.devices.festo.modbus_link import RegisterLink
from robot_io.devices.festo.profile import INT32, AxisCommand, AxisStatus, count_of, expect_count

ADDRESS, REGISTERS = 0, 4


class CCON(IntFlag):
    """Control byte 1."""

    ENABLE = 1 << 0
    STOP = 1 << 1  # 0: emergency ramp
    BRAKE = 1 << 2
    RESET = 1 << 3
    LOCK = 1 << 5  # keeps the set-up tool from taking over
    OPM1 = 1 << 6  # direct mode


class CPOS(IntFlag):
    """Control byte 2."""

    HALT = 1 << 0  # 0: brake
    START = 1 << 1
    HOM = 1 << 2
    CLEAR = 1 << 6  # a rising edge drops the rest of a halted task


class CDIR(IntFlag):
    """Control byte 3; 0 is an absolute position."""

    RELATIVE = 1 << 0
    COM1 = 1 << 1
    COM2 = 1 << 2
    CONT = 1 << 3
    CONTT = 1 << 4


class SCON(IntFlag):
    """Status byte 1."""

    ENABLED = 1 << 0
    OPEN = 1 << 1  # operation enabled
    WARN = 1 << 2
    FAULT = 1 << 3
    VLOAD = 1 << 4
    FCT = 1 << 5  # the set-up tool has control
    OPM1 = 1 << 6


class SPOS(IntFlag):
    """Status byte 2."""

    HALT = 1 << 0
    ACK = 1 << 1
    MC = 1 << 2  # motion complete
    MOV = 1 << 4
    DEV = 1 << 5  # following error
    REF = 1 << 7


@dataclass(frozen=True)
class FhppProfile:
    """FHPP direct mode with the units of the drive's set-up.

    position_unit  [m] a count of the position
    base_velocity  [m/s] that 100 % stand for
    continuous     mark new targets by CONT and an alternating CONTT, as SFC-LACI documents it; else by an edge of
                   START, which every FHPP drive knows and which takes a new target in every second cycle
    Direct mode carries no acceleration and no fault number; they, and the node guard (100 to 5000 ms), are set and read
    with Festo's Configuration Tool.
    """

    position_unit: float = 1e-5
    base_velocity: float = 2.0
    continuous: bool = False

    write_address = ADDRESS
    read_address = ADDRESS
    read_count = REGISTERS

    def __post_init__(self) -> None:
        for name in ("position_unit", "base_velocity"):
            if not 0 < getattr(self, name) < 1e6:
                raise ValueError(
                    f"FhppProfile.{name} is {getattr(self, name)}, it must be positive, as in the drive's set-up"
                )

    def encode(self, command: AxisCommand) -> list[int]:
        ccon = CCON.STOP | CCON.BRAKE | CCON.LOCK | CCON.OPM1
        if command.enable:
            ccon |= CCON.ENABLE
        if command.acknowledge:
            ccon |= CCON.RESET
        cpos, cdir, odd = CPOS(0), CDIR(0), command.sequence % 2 == 1
        if command.home:
            cpos |= CPOS.HALT | CPOS.HOM
        elif not command.move:
            cpos |= CPOS.CLEAR
        elif self.continuous:
            cpos |= CPOS.HALT | CPOS.START
            cdir |= CDIR.CONT | (CDIR.CONTT if odd else CDIR(0))
        else:
            cpos |= CPOS.HALT | (CPOS.START if odd else CPOS(0))
        speed = count_of(command.speed, self.base_velocity / 100.0, (0, 100), "speed [m/s]")
        position = count_of(command.position, self.position_unit, INT32, "target position [m]")
        return list(struct.unpack(">4H", struct.pack(">BBBBi", ccon, cpos, cdir, speed, position)))

    def decode(self, registers: list[int]) -> AxisStatus:
        expect_count(registers, REGISTERS)
        scon, spos, _, percent, position = struct.unpack(">BBBbi", struct.pack(">4H", *registers))
        return AxisStatus(
            ready=bool(scon & SCON.VLOAD) and not scon & (SCON.FAULT | SCON.FCT),
            enabled=scon & (SCON.ENABLED | SCON.OPEN | SCON.OPM1) == SCON.ENABLED | SCON.OPEN | SCON.OPM1,
            fault=bool(scon & SCON.FAULT),
            fault_code=0,
            warning_code=0,
            homing=bool(spos & SPOS.ACK and spos & SPOS.MOV and not spos & SPOS.REF),
            homed=bool(spos & SPOS.REF),
            position=position * self.position_unit,
            velocity=percent * self.base_velocity / 100.0,
        )

    def set_up(self, link: RegisterLink, node_guard: float) -> Iterator[None]:
        yield from ()

    def fault_text(self, code: int) -> str:
        return fault_text(code, FHPP_FAULTS)
