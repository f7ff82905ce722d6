"""Commands to a positioning axis and its answers, whatever registers carry it.

Positions are in the drive's own coordinate, in metres; only the codecs (``cmmt``, ``fhpp``) know bits and counts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from robot_io.devices.festo.modbus_link import RegisterLink

INT32 = (-(2**31), 2**31 - 1)
UNKNOWN_FAULT = "look the number up in the drive's manual"


class SetUpError(ValueError):
    """A drive is not set up as robot.yaml says; ``cause`` is the name of the fault."""

    def __init__(self, cause: str, sentence: str) -> None:
        super().__init__(sentence)
        self.cause = cause


@dataclass(frozen=True)
class AxisCommand:
    """One cycle's command.

    enable        power the drive; without, the drive ramps to a stop and switches off
    acknowledge   a rising edge clears a fault
    home          a rising edge starts homing, held until the axis is homed
    move          go to ``position`` at up to ``speed``; without, the drive brakes, drops the task and holds: its own
                  set-point or the place where it is measured, as the make has it
    position      target [m]
    speed         highest speed on the way [m/s], not negative
    acceleration  of speeding up and braking [m/s^2]
    sequence      grows with every cycle: profiles that mark new targets with an alternating bit take its parity
    """

    enable: bool = False
    acknowledge: bool = False
    home: bool = False
    move: bool = False
    position: float = 0.0
    speed: float = 0.0
    acceleration: float = 0.0
    sequence: int = 0


@dataclass(frozen=True)
class AxisStatus:
    """One cycle's answer.

    ready         may be enabled now
    enabled       powered and following commands
    fault         the drive has stopped for a reason of its own; ``fault_code`` is 0 where the profile carries no number
    warning_code  0 for none
    homing, homed
    position      actual position [m]; means nothing before ``homed``
    velocity      actual velocity [m/s], as fine as the profile carries it
    """

    ready: bool
    enabled: bool
    fault: bool
    fault_code: int
    warning_code: int
    homing: bool
    homed: bool
    position: float
    velocity: float


@dataclass(frozen=True)
class AxisProfile(ABC):
    """Registers of one kind of drive; its fields are the units of the drive's set-up.

    write_address  first register of the process data that the drive takes
    read_address   first register of the process data that it gives
    read_count     how many of those
    faults         the drive's fault numbers in words: those that an axis on a gantry can meet
    """

    write_address: ClassVar[int]
    read_address: ClassVar[int]
    read_count: ClassVar[int]
    faults: ClassVar[dict[int, str]]

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, bool) and not 0 < value < 1e6:
                raise ValueError(
                    f"{type(self).__name__}.{name} is {value}, it must be positive, as in the drive's set-up"
                )

    @abstractmethod
    def encode(self, command: AxisCommand) -> list[int]:
        """Registers to write; ValueError when a number does not fit."""

    @abstractmethod
    def decode(self, registers: list[int]) -> AxisStatus:
        """Status from ``read_count`` registers; ValueError on another length."""

    def set_up(self, link: RegisterLink, node_guard: float) -> Iterator[None]:
        """Set the drive's own time-out [s] and compare its units with the profile's, a few exchanges at a time.

        Raises SetUpError where the drive would not stop by itself or counts otherwise. Nothing where its set-up tool
        alone sets and shows these.
        """
        yield from ()

    def expect_count(self, registers: list[int]) -> None:
        if len(registers) != self.read_count:
            raise ValueError(f"{len(registers)} registers arrived, the profile has {self.read_count}")

    def fault_text(self, code: int) -> str:
        """The drive's fault number and its words."""
        return f"{code}: {self.faults.get(code, UNKNOWN_FAULT)}"


def count_of(value: float, unit: float, bounds: tuple[int, int], what: str) -> int:
    """``value`` in whole units of ``unit``; ValueError when not within ``bounds``."""
    scaled = value / unit
    if not bounds[0] <= scaled <= bounds[1]:
        low, high = (b * unit for b in bounds)
        raise ValueError(f"{what} {value} does not fit its register, allowed is {low:g} to {high:g} at {unit:g} a unit")
    return round(scaled)
