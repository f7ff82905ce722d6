"""PROFIdrive telegram 111 (MDI positioning) of Festo's CMMT drives in Modbus registers.

Each word is one register; double words come low word first. Order and bits are those of festo-edcon 1.0.3
(``profidrive/telegram111.py``, ``words.py``), which agrees with telegram 111 of the PROFIdrive basic positioner:
    out  STW1, POS_STW1, POS_STW2, STW2, OVERRIDE, MDI_TARPOS (2), MDI_VELOCITY (2), MDI_ACC, MDI_DEC
    in   ZSW1, POS_ZSW1, POS_ZSW2, ZSW2, MELDW, XIST_A (2), NIST_B (2), FAULT_CODE, WARN_CODE
Positions and speeds are in user units of the drive's set-up; OVERRIDE, MDI_ACC and MDI_DEC are N2 (0x4000 is 100 % of a
base value), NIST_B is N4 (0x40000000 is 100 %). festo-edcon moves the whole 28-register block each time; so does this.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag

from robot_io.devices.festo.modbus_link import RegisterLink
from robot_io.devices.festo.profile import INT32, AxisCommand, AxisProfile, AxisStatus, SetUpError, count_of

OUTPUT_ADDRESS, INPUT_ADDRESS, BLOCK = 0, 100, 28
TIMEOUT_ADDRESS = 400  # 32 bits, low word first [ms]
# Parameter number, subindex, elements, request or answer, bytes of data, which begins at 510.
MAILBOX_ADDRESS, MAILBOX_DATA = 500, 510
READ, DONE, FAILED = 0x01, 0x10, 0x03
PATIENCE = 20  # cycles to wait for a parameter
# Number, format and what of CmmtProfile it must agree with, as in festo-edcon's pnu_map.csv; units as powers of ten.
PARAMETERS = (
    (11724, "<b", "position_unit"),
    (11725, "<b", "velocity_unit"),
    (12345, "<f", "base_velocity"),
    (12346, "<f", "base_acceleration"),
    (12347, "<f", "base_acceleration"),  # of braking
)
SAME = 1e-3  # share by which the drive's number may differ: it is a float32
WORDS = 11  # of the 28 that telegram 111 uses, each way
N2, N4 = 0x4000, 0x40000000  # 100 %
ALL_N2 = (0, 0x7FFF)


# Diagnostic numbers as in festo-edcon's ``icp_map.csv``.
CMMT_FAULTS = {
    10: "short circuit in the motor's phases or the braking resistor: check the wiring",
    11: "overcurrent: check the motor's phases and the braking resistor for a short circuit",
    13: "motor overloaded (I2t): is the axis blocked or stiff?",
    15: "output stage overloaded (I2t): is the axis blocked or stiff?",
    20: "braking resistor overloaded: brake less hard or fit a larger one",
    30: "overvoltage in the DC link: check the braking resistor",
    31: "undervoltage in the DC link: check the power supply",
    36: "no load voltage: release the emergency stop and check the power supply",
    37: "load voltage was interrupted: check the power supply",
    47: "drive too hot",
    51: "power unit too hot",
    55: "motor too hot",
    57: "homing took too long",
    58: "homing found no reference on its way",
    109: "negative software limit reached",
    110: "positive software limit reached",
    114: "negative limit switch reached",
    115: "positive limit switch reached",
    126: "following error of the position: is the axis blocked or asked for too much?",
    127: "following error of the velocity: is the axis blocked or asked for too much?",
    148: "the two STO inputs disagreed: check the emergency stop's wiring",
    282: "encoder not ready",
    391: "process data stayed away (node guard): was the computer or the network stopped?",
    394: "process data invalid: does the drive's set-up select telegram 111?",
}


# Bits in their order from 0 on.
STW1 = IntFlag(  # control word 1 in position mode; without NO_REJECT_TASK the drive brakes and drops its task
    "STW1",
    "ON NO_COAST_STOP NO_QUICK_STOP ENABLE_OPERATION NO_REJECT_TASK NO_INTERMEDIATE_STOP ACTIVATE_TASK "
    "FAULT_ACKNOWLEDGE JOG_1 JOG_2 CONTROL_BY_PLC START_HOMING",
)
ZSW1 = IntFlag(  # status word 1 in position mode; FOLLOWING: the following error is within its tolerance
    "ZSW1",
    "READY_TO_SWITCH_ON READY_TO_OPERATE OPERATION_ENABLED FAULT NO_COAST_STOP NO_QUICK_STOP INHIBITED WARNING "
    "FOLLOWING CONTROL_REQUESTED TARGET_REACHED HOME_SET TASK_ACKNOWLEDGED STOPPED ACCELERATES DECELERATES",
)
# Positioning control words 1 and 2 and status word 1. CONTINUOUS_UPDATE: new MDI values count at once, without a new
# edge of ACTIVATE_TASK.
PosSTW1 = IntFlag("PosSTW1", {"ABSOLUTE": 1 << 8, "CONTINUOUS_UPDATE": 1 << 12, "MDI": 1 << 15})
PosSTW2 = IntFlag("PosSTW2", {"SOFTWARE_LIMITS": 1 << 14, "HARDWARE_LIMITS": 1 << 15})
PosZSW1 = IntFlag("PosZSW1", {"HOMING": 1 << 11, "MDI": 1 << 15})

POWERED = (
    STW1.NO_COAST_STOP | STW1.NO_QUICK_STOP | STW1.ENABLE_OPERATION | STW1.CONTROL_BY_PLC | STW1.NO_INTERMEDIATE_STOP
)


@dataclass(frozen=True)
class CmmtProfile(AxisProfile):
    """Telegram 111 with the units of the drive's set-up.

    position_unit      [m] a count of MDI_TARPOS and XIST_A
    velocity_unit      [m/s] a count of MDI_VELOCITY
    base_velocity      [m/s] that NIST_B's 100 % stand for ("base value velocity")
    base_acceleration  [m/s^2] that 100 % of MDI_ACC and MDI_DEC stand for
    software_limits, hardware_limits  limit switches that the drive shall heed
    """

    position_unit: float = 1e-6
    velocity_unit: float = 1e-3
    base_velocity: float = 2.0
    base_acceleration: float = 15.0
    software_limits: bool = True
    hardware_limits: bool = False

    write_address = OUTPUT_ADDRESS
    read_address = INPUT_ADDRESS
    read_count = BLOCK
    faults = CMMT_FAULTS

    def encode(self, command: AxisCommand) -> list[int]:
        stw1 = POWERED
        if command.enable:
            stw1 |= STW1.ON
        if command.acknowledge:
            stw1 |= STW1.FAULT_ACKNOWLEDGE
        if command.home:
            stw1 |= STW1.START_HOMING | STW1.NO_REJECT_TASK
        if command.move:
            stw1 |= STW1.ACTIVATE_TASK | STW1.NO_REJECT_TASK
        pos_stw2 = PosSTW2.SOFTWARE_LIMITS * self.software_limits | PosSTW2.HARDWARE_LIMITS * self.hardware_limits
        position = count_of(command.position, self.position_unit, INT32, "target position [m]")
        velocity = count_of(command.speed, self.velocity_unit, (0, INT32[1]), "speed [m/s]")
        acceleration = count_of(command.acceleration, self.base_acceleration / N2, ALL_N2, "acceleration [m/s^2]")
        words = struct.pack(
            "<HHHHHiiHH",
            stw1,
            PosSTW1.MDI | PosSTW1.ABSOLUTE | PosSTW1.CONTINUOUS_UPDATE,
            pos_stw2,
            0,
            N2,
            position,
            velocity,
            acceleration,
            acceleration,
        )
        return [*struct.unpack(f"<{WORDS}H", words), *[0] * (BLOCK - WORDS)]

    def decode(self, registers: list[int]) -> AxisStatus:
        self.expect_count(registers)
        zsw1, pos_zsw1, *_, fault_code, warning_code = registers[:WORDS]
        position, velocity = struct.unpack("<ii", struct.pack("<4H", *registers[5:9]))
        return AxisStatus(
            ready=bool(zsw1 & ZSW1.READY_TO_SWITCH_ON and zsw1 & ZSW1.CONTROL_REQUESTED),
            enabled=bool(zsw1 & ZSW1.OPERATION_ENABLED),
            fault=bool(zsw1 & ZSW1.FAULT),
            fault_code=fault_code,
            warning_code=warning_code,
            homing=bool(pos_zsw1 & PosZSW1.HOMING),
            homed=bool(zsw1 & ZSW1.HOME_SET),
            position=position * self.position_unit,
            velocity=velocity * self.base_velocity / N4,
        )

    def set_up(self, link: RegisterLink, node_guard: float) -> Iterator[None]:
        """As ``AxisProfile.set_up``. What is read goes with an image that asks for nothing, so it is no echo."""
        image = self.encode(AxisCommand())
        milliseconds = count_of(node_guard, 1e-3, (1, INT32[1]), "node guard [s]")
        wanted = [milliseconds & 0xFFFF, milliseconds >> 16]
        before = link.exchange(OUTPUT_ADDRESS, image, TIMEOUT_ADDRESS, 2)
        if before[1]:
            raise SetUpError("node_guard", f"its time-out reads as {before}, over a minute: are its words swapped?")
        link.exchange(TIMEOUT_ADDRESS, wanted, TIMEOUT_ADDRESS, 2)
        answer = link.exchange(OUTPUT_ADDRESS, image, TIMEOUT_ADDRESS, 2)
        if answer != wanted:
            words = f"it took the time-out {wanted} as {answer}: without it, it would not stop when the computer dies"
            raise SetUpError("node_guard", words)
        for number, form, key in PARAMETERS:
            link.exchange(MAILBOX_ADDRESS, [number, 0, 1, READ], MAILBOX_ADDRESS, 4)
            for _ in range(PATIENCE):
                yield
                status, length, *_, low, high = link.exchange(
                    OUTPUT_ADDRESS, image, MAILBOX_ADDRESS + 3, MAILBOX_DATA - MAILBOX_ADDRESS - 1
                )
                if status in (DONE, FAILED):
                    break
            size = struct.calcsize(form)
            if status != DONE or length != size:
                raise SetUpError("units", f"it does not tell parameter {number}, its {key}: is it a CMMT?")
            value = struct.unpack(form, struct.pack("<HH", low, high)[:size])[0]
            found, given = 10.0**value if key.endswith("unit") else value, getattr(self, key)
            if not abs(found - given) <= SAME * given:
                raise SetUpError("units", f"its {key} is {found:g} (parameter {number}), robot.yaml has {given:g}")
