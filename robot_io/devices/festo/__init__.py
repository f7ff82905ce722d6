"""Two linear axes of Festo over Modbus TCP."""

from robot_io.devices.festo.axes import FestoAxes as FestoAxes
from robot_io.devices.festo.cmmt import CmmtProfile as CmmtProfile
from robot_io.devices.festo.config import AxesConfig as AxesConfig
from robot_io.devices.festo.config import AxesFault as AxesFault
from robot_io.devices.festo.config import AxesState as AxesState
from robot_io.devices.festo.config import Axis as Axis
from robot_io.devices.festo.fhpp import FhppProfile as FhppProfile
from robot_io.devices.festo.modbus_link import AxisLost as AxisLost
from robot_io.devices.festo.modbus_link import DirectLink as DirectLink
from robot_io.devices.festo.modbus_link import ModbusLink as ModbusLink
from robot_io.devices.festo.modbus_link import RegisterLink as RegisterLink
from robot_io.devices.festo.profile import AxisCommand as AxisCommand
from robot_io.devices.festo.profile import AxisProfile as AxisProfile
from robot_io.devices.festo.profile import AxisStatus as AxisStatus
from robot_io.devices.festo.thread import AxesThread as AxesThread
