"""Drives' fault numbers in words: those that an axis on a gantry can meet.

CMMT: diagnostic numbers as in festo-edcon's ``icp_map.csv``. FHPP: GDCP-CMMO-ST-LK-C-HP-EN and EMCA-EC-C-HP-EN.
"""

from __future__ import annotations

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

FHPP_FAULTS = {
    0: "the number is in the drive's diagnostic memory, read it with Festo's Configuration Tool",
    0x47: "Modbus connection timed out (node guard)",
    0x48: "Modbus connection timed out (node guard)",
}


def fault_text(code: int, faults: dict[int, str]) -> str:
    """The number and its words."""
    return f"{code}: {faults[code]}" if code in faults else f"{code}: look the number up in the drive's manual"
