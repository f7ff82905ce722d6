"""Two linear axes of Festo over Modbus TCP."""

from robot_io.devices.festo.axes import FestoAxes
from robot_io.devices.festo.axis import AxesConfig, Axis
from robot_io.devices.festo.cmmt import CmmtProfile
from robot_io.devices.festo.fhpp import FhppProfile
from robot_io.devices.festo.modbus_link import AxisLost, ModbusLink
from robot_io.devices.festo.profile import AxisCommand, AxisProfile
from robot_io.devices.festo.thread import AxesThread

__all__ = ["AxesConfig", "AxesThread", "Axis", "AxisCommand", "AxisLost", "AxisProfile", "CmmtProfile", "FestoAxes"]
__all__ += ["FhppProfile", "ModbusLink"]
