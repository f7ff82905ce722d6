"""ABB EGM on the wire: the message schema and the codec between its degrees and our radians.

The schema is ABB's egm.proto (proto2; field numbers as in abb_libegm, the newer fields as in ABBRobotEGM 1.0.7), built
here in a private descriptor pool: another library that registers its own egm.proto in the process-wide pool does not
clash with it.

proto2 parses an empty datagram into a valid message in which everything is absent, so the codec requires every field it
reads. What it cannot accept raises ``EgmError`` and nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from numpy.typing import ArrayLike

# Fields of a message made from descriptors are known at run time only, to the type checker not at all.
Message = Any

N_ARM_JOINTS = 6  # in a message's ``joints``; a seventh joint of an arm is the first of its ``externalJoints``
MAX_DATAGRAM = 1472  # [bytes], what fits one Ethernet frame; ABB's messages are a few hundred
UINT32 = 1 << 32

# Enumeration values count from 0.
_ENUMS = {
    "EgmHeader": (
        "MessageType",
        "MSGTYPE_UNDEFINED MSGTYPE_COMMAND MSGTYPE_DATA MSGTYPE_CORRECTION MSGTYPE_PATH_CORRECTION",
    ),
    "EgmMotorState": ("MotorStateType", "MOTORS_UNDEFINED MOTORS_ON MOTORS_OFF"),
    "EgmMCIState": ("MCIStateType", "MCI_UNDEFINED MCI_ERROR MCI_STOPPED MCI_RUNNING"),
    "EgmRapidCtrlExecState": ("RapidCtrlExecStateType", "RAPID_UNDEFINED RAPID_STOPPED RAPID_RUNNING"),
}
# Fields count from 1 in the order given; ! required, * repeated, else optional.
_FIELDS = {
    "EgmHeader": "seqno:uint32 tm:uint32 mtype:MessageType",
    "EgmCartesian": "x:double! y:double! z:double!",
    "EgmQuaternion": "u0:double! u1:double! u2:double! u3:double!",
    "EgmEuler": "x:double! y:double! z:double!",
    "EgmClock": "sec:uint64! usec:uint64!",
    "EgmTimestamp": "sec:uint64 nsec:uint64",
    "EgmPose": "pos:EgmCartesian orient:EgmQuaternion euler:EgmEuler",
    "EgmCartesianSpeed": "value:double*",
    "EgmJoints": "joints:double*",
    "EgmPlanned": "joints:EgmJoints cartesian:EgmPose externalJoints:EgmJoints time:EgmClock timeStamp:EgmTimestamp",
    "EgmFeedBack": "joints:EgmJoints cartesian:EgmPose externalJoints:EgmJoints time:EgmClock timeStamp:EgmTimestamp",
    "EgmSpeedRef": "joints:EgmJoints cartesians:EgmCartesianSpeed externalJoints:EgmJoints",
    "EgmPathCorr": "pos:EgmCartesian! age:uint32!",
    "EgmMotorState": "state:MotorStateType!",
    "EgmMCIState": "state:MCIStateType!",
    "EgmRapidCtrlExecState": "state:RapidCtrlExecStateType!",
    "EgmTestSignals": "signals:double*",
    "EgmMeasuredForce": "fcActive:bool force:double*",
    "EgmCollisionInfo": "collsionTriggered:bool collDetQuota:double*",
    "EgmRAPIDdata": "digVal:bool dnum:double*",
    "EgmRobot": (
        "header:EgmHeader feedBack:EgmFeedBack planned:EgmPlanned motorState:EgmMotorState mciState:EgmMCIState "
        "mciConvergenceMet:bool testSignals:EgmTestSignals rapidExecState:EgmRapidCtrlExecState "
        "measuredForce:EgmMeasuredForce utilizationRate:double moveIndex:uint32 CollisionInfo:EgmCollisionInfo "
        "RAPIDfromRobot:EgmRAPIDdata torqueRef:EgmJoints"
    ),
    "EgmSensor": "header:EgmHeader planned:EgmPlanned speedRef:EgmSpeedRef RAPIDtoRobot:EgmRAPIDdata",
    "EgmSensorPathCorr": "header:EgmHeader pathCorr:EgmPathCorr",
}


def _schema() -> descriptor_pb2.FileDescriptorProto:
    field_proto = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="egm.proto", package="abb.egm", syntax="proto2")
    for message_name, fields in _FIELDS.items():
        message = file.message_type.add(name=message_name)
        enum_name, values = _ENUMS.get(message_name, ("", ""))
        if enum_name:
            enum = message.enum_type.add(name=enum_name)
            for number, value in enumerate(values.split()):
                enum.value.add(name=value, number=number)
        for number, text in enumerate(fields.split(), start=1):
            name, kind = text.rstrip("!*").split(":")
            labels = {"!": field_proto.LABEL_REQUIRED, "*": field_proto.LABEL_REPEATED}
            label = labels.get(text[-1], field_proto.LABEL_OPTIONAL)
            field = message.field.add(name=name, number=number, label=label)
            if kind == enum_name:
                field.type, field.type_name = field_proto.TYPE_ENUM, f".abb.egm.{message_name}.{kind}"
            elif kind in _FIELDS:
                field.type, field.type_name = field_proto.TYPE_MESSAGE, f".abb.egm.{kind}"
            else:
                field.type = field_proto.Type.Value(f"TYPE_{kind.upper()}")
    return file


_pool = descriptor_pool.DescriptorPool()
_pool.AddSerializedFile(_schema().SerializeToString())


def message_class(name: str) -> type[Message]:
    """The protobuf class of an EGM message, e.g. ``EgmRobot``."""
    if name not in _FIELDS:
        raise ValueError(f"no EGM message {name!r}; there are {', '.join(_FIELDS)}")
    return message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"abb.egm.{name}"))


EgmRobot = message_class("EgmRobot")
EgmSensor = message_class("EgmSensor")
_HEADER = message_class("EgmHeader")
_MOTORS = message_class("EgmMotorState")
_MCI = message_class("EgmMCIState")
_RAPID = message_class("EgmRapidCtrlExecState")


class EgmError(ValueError):
    """An EGM datagram or endpoint cannot be used. ``reason`` is a short name for counting, the message a sentence."""

    def __init__(self, reason: str, message: str):
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True, eq=False)
class ArmFeedback:
    """State that the controller reports (EgmRobot).

    sequence         header.seqno, modulo 2**32
    time             header.tm, the controller's clock [s]; starts again at 0 every 49.7 days
    position         (6,) measured joint positions [rad], read-only
    motors_on        MOTORS_ON; undefined counts as off
    egm_running      MCI_RUNNING
    rapid_running    RAPID_RUNNING, or RAPID_UNDEFINED: some controllers report that after a restart while RAPID runs
    received         [s] on the receiver's clock, when a session has accepted it
    """

    sequence: int
    time: float
    position: np.ndarray
    motors_on: bool
    egm_running: bool
    rapid_running: bool
    received: float = math.nan


@dataclass(frozen=True, eq=False)
class SensorMessage:
    """Reference for the controller (EgmSensor): position (6,) [rad] and velocity (6,) [rad/s], read-only."""

    sequence: int
    position: np.ndarray
    velocity: np.ndarray


def decode_robot(datagram: bytes, joints: int = N_ARM_JOINTS) -> ArmFeedback:
    """Reads an EgmRobot of an arm. Raises EgmError where it is not one, or not a complete one."""
    needed = "header.tm", "feedBack.joints", "motorState", "mciState", "rapidExecState"
    message = _parse(EgmRobot, datagram, _HEADER.MSGTYPE_DATA, *needed)
    return ArmFeedback(
        sequence=message.header.seqno,
        time=message.header.tm / 1000.0,
        position=_radians(message.feedBack, "EgmRobot.feedBack", joints),
        motors_on=message.motorState.state == _MOTORS.MOTORS_ON,
        egm_running=message.mciState.state == _MCI.MCI_RUNNING,
        rapid_running=message.rapidExecState.state in (_RAPID.RAPID_RUNNING, _RAPID.RAPID_UNDEFINED),
    )


def encode_robot(
    sequence: int,
    time_ms: int,
    position: ArrayLike,
    planned: ArrayLike,
    motors_on: bool,
    egm_running: bool,
    rapid_running: bool,
) -> bytes:
    """An EgmRobot with measured and planned joint positions, both (6,) [rad]."""
    message = EgmRobot()
    message.header.seqno, message.header.tm = sequence % UINT32, time_ms % UINT32
    message.header.mtype = _HEADER.MSGTYPE_DATA
    _fill(message.feedBack, position, "position")
    _fill(message.planned, planned, "planned")
    message.motorState.state = _MOTORS.MOTORS_ON if motors_on else _MOTORS.MOTORS_OFF
    message.mciState.state = _MCI.MCI_RUNNING if egm_running else _MCI.MCI_STOPPED
    message.mciConvergenceMet = False
    message.rapidExecState.state = _RAPID.RAPID_RUNNING if rapid_running else _RAPID.RAPID_STOPPED
    return message.SerializeToString()


def decode_sensor(datagram: bytes, joints: int = N_ARM_JOINTS) -> SensorMessage:
    """Reads an EgmSensor that has joint positions and joint speeds. Raises EgmError where it has not."""
    # header.tm is left out by several clients
    message = _parse(EgmSensor, datagram, _HEADER.MSGTYPE_CORRECTION, "planned.joints", "speedRef.joints")
    return SensorMessage(
        sequence=message.header.seqno,
        position=_radians(message.planned, "EgmSensor.planned", joints),
        velocity=_radians(message.speedRef, "EgmSensor.speedRef", joints),
    )


def encode_sensor(sequence: int, time_ms: int, position: ArrayLike, velocity: ArrayLike) -> bytes:
    """An EgmSensor: position (6,) [rad], velocity (6,) [rad/s]. Raises ValueError where one is not six finite ones."""
    message = EgmSensor()
    message.header.seqno, message.header.tm = sequence % UINT32, time_ms % UINT32
    message.header.mtype = _HEADER.MSGTYPE_CORRECTION
    _fill(message.planned, position, "position")
    _fill(message.speedRef, velocity, "velocity")
    return message.SerializeToString()


def _parse(kind: type[Message], datagram: bytes, message_type: int, *needed: str) -> Message:
    """The message, whose header has this type, with all fields of these dotted names."""
    name = kind.DESCRIPTOR.name
    if len(datagram) > MAX_DATAGRAM:
        raise EgmError("oversized", f"a datagram of more than {MAX_DATAGRAM} bytes is no {name}")
    message = kind()
    try:
        message.ParseFromString(datagram)
    except DecodeError as error:
        raise EgmError("malformed", f"{len(datagram)} bytes do not parse as {name}: {error}") from error
    if not message.IsInitialized():
        missing = ", ".join(message.FindInitializationErrors())
        raise EgmError("incomplete", f"{name} without its required {missing}")
    needed = "header.seqno", "header.mtype", *needed
    for path in needed:
        part = message
        for field in path.split("."):
            if not part.HasField(field):
                raise EgmError("incomplete", f"{name} without {path}; it needs {', '.join(needed)}")
            part = getattr(part, field)
    if message.header.mtype != message_type:
        found, wanted = map(_HEADER.MessageType.Name, (message.header.mtype, message_type))
        raise EgmError("wrong_type", f"message type {found}, expected {wanted}")
    return message


def _radians(holder: Message, name: str, joints: int) -> np.ndarray:
    degrees, own = list(holder.joints.joints), min(joints, N_ARM_JOINTS)
    if len(degrees) != own:
        raise EgmError("joint_count", f"{name}.joints has {len(degrees)} numbers, the arm has {own} joints")
    degrees += holder.externalJoints.joints[: joints - own]
    if len(degrees) != joints:
        count = len(degrees) - own
        wanted = f"{name}.externalJoints has {count} numbers, joints 7 to {joints} of the arm are wanted there"
        raise EgmError("joint_count", wanted)
    radians = np.deg2rad(degrees)
    if not np.isfinite(radians).all():
        raise EgmError("not_finite", f"{name} has a non-finite number: {list(degrees)}")
    radians.setflags(write=False)
    return radians


def _fill(holder: Message, radians: ArrayLike, name: str) -> None:
    """Write the joints [rad], the first six as such and others as external ones."""
    values = np.asarray(radians, np.float64)
    if values.ndim != 1 or not N_ARM_JOINTS <= values.size <= 2 * N_ARM_JOINTS:
        raise ValueError(f"{name} has shape {values.shape}, the arm needs ({N_ARM_JOINTS},)")
    with np.errstate(over="ignore"):  # a finite number may leave the range of float64 here
        degrees = np.rad2deg(values)
    if not np.isfinite(degrees).all():
        raise ValueError(f"{name} has a non-finite number: {values.tolist()}; nothing is sent")
    holder.joints.joints.extend(degrees[:N_ARM_JOINTS].tolist())
    if len(degrees) > N_ARM_JOINTS:
        holder.externalJoints.joints.extend(degrees[N_ARM_JOINTS:].tolist())
