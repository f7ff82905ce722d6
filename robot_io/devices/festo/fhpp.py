"""Festo Handling and Positioning Profile, direct mode: eight bytes each way in four Modbus registers.

    out  CCON, CPOS, CDIR, speed [% of a base value], position (4)
    in   SCON, SPOS, SDIR, velocity [%, signed], position (4)
Modbus sends the high byte of a register first, so the first register is CCON * 256 + CPOS and the position comes high
word first. Bits: Festo's manuals of CMMP-AS (P.BE-CMMP-CAM-SW-EN, 6.4), CPX-CMAX and SFC-LACI (continuous setpoints);
registers and function code 0x17: GDCP-CMMO-ST-LK-C-HP-EN, 4.3. One per cent of the speed is the finest step.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntFlag

from robot_io.devices.festo.profile import INT32, AxisCommand, AxisProfile, AxisStatus, count_of

ADDRESS, REGISTERS = 0, 4


# Numbers: GDCP-CMMO-ST-LK-C-HP-EN and EMCA-EC-C-HP-EN.
FHPP_FAULTS = {
    0: "the number is in the drive's diagnostic memory, read it with Festo's Configuration Tool",
    0x47: "Modbus connection timed out (node guard)",
    0x48: "Modbus connection timed out (node guard)",
}


# Control bytes 1 to 3 and status bytes 1 and 2, bits in their order from 0 on. Without STOP the drive brakes by its
# emergency ramp, without HALT it brakes; a rising edge of CLEAR drops the rest of a halted task; LOCK keeps the set-up
# tool from taking over, FCT says that it has; OPM1 is direct mode; a CDIR of 0 is an absolute position; OPEN: operation
# enabled; MC: motion complete; DEV: following error.
CCON = IntFlag("CCON", "ENABLE STOP BRAKE RESET RESERVED LOCK OPM1")
CPOS = IntFlag("CPOS", "HALT START HOM JOGP JOGN TEACH CLEAR")
CDIR = IntFlag("CDIR", "RELATIVE COM1 COM2 CONT CONTT")
SCON = IntFlag("SCON", "ENABLED OPEN WARN FAULT VLOAD FCT OPM1")
SPOS = IntFlag("SPOS", "HALT ACK MC TEACH MOV DEV STILL REF")


@dataclass(frozen=True)
class FhppProfile(AxisProfile):
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
    faults = FHPP_FAULTS

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
        self.expect_count(registers)
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
