"""Two linear axes of Festo over Modbus TCP."""

from robot_io.festo.axes import FestoAxes as FestoAxes
from robot_io.festo.cmmt import CmmtProfile as CmmtProfile
from robot_io.festo.fhpp import FhppProfile as FhppProfile
from robot_io.festo.link import AxisLost as AxisLost
from robot_io.festo.link import DirectLink as DirectLink
from robot_io.festo.link import ModbusLink as ModbusLink
from robot_io.festo.link import RegisterLink as RegisterLink
from robot_io.festo.profile import AxisCommand as AxisCommand
from robot_io.festo.profile import AxisProfile as AxisProfile
from robot_io.festo.profile import AxisStatus as AxisStatus
from robot_io.festo.settings import AxesConfig as AxesConfig
from robot_io.festo.settings import AxesFault as AxesFault
from robot_io.festo.settings import AxesState as AxesState
from robot_io.festo.settings import Axis as Axis
from robot_io.festo.thread import AxesThread as AxesThread
