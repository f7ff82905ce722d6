"""The one definition of what a policy sees and does, shared by the simulator and the robot.

The simulator builds its observation from this module and so does the bridge at the robot; an exported policy
carries it in its manifest and is refused where it differs. NumPy only: this module is imported on the robot.

Observation at one control tick, in this order (11 numbers, SI units):
    0..2   ball position x, y, z [m] in the table frame (origin on the table's top surface at its centre,
           x across, y along the table towards the human, z up)
    3..10  joint positions in ``JOINT_NAMES`` order: two gantry axes [m], six arm joints [rad]
The policy input is the last ``HISTORY`` observations, oldest first: shape (8, 11). At the start of an episode the first
observation fills the whole history.

Action: eight numbers in [-1, 1], in ``JOINT_NAMES`` order; times ``LIMITS.policy_velocity`` they are the requested
joint velocities [m/s], [rad/s]. The request passes ``robot_io.limits`` before anything moves.

The constants are those of the paper's robot. Another robot has a ``Contract`` of its own, with n joints in place of
eight and 3 + n observations in place of eleven; everything else is the same.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robot_io.errors import ContractError
from robot_io.limits import LIMITS, JointLimits

CONTRACT_VERSION = 1

CONTROL_RATE = 75.0  # [Hz], Abeyruwan et al. 2022, section 4
HISTORY = 8  # observations in the policy input, the paper's "past seven" and the current one

JOINT_NAMES = LIMITS.joints
JOINT_UNITS = ("m", "m", "rad", "rad", "rad", "rad", "rad", "rad")
FESTO_JOINTS = (0, 1)  # indices into JOINT_NAMES moved by the two linear axes
ABB_JOINTS = (2, 3, 4, 5, 6, 7)  # indices moved by the arm's controller

_BALL = ("ball_x", "ball_y", "ball_z")
OBSERVATION_NAMES = (*_BALL, *JOINT_NAMES)
OBSERVATION_UNITS = ("m", "m", "m", *JOINT_UNITS)
N_JOINTS = len(JOINT_NAMES)
N_OBSERVATION = len(OBSERVATION_NAMES)


@dataclass(frozen=True)
class Contract:
    """One robot's contract: its joints in order, from the base to the paddle, and what they may do.

    robot     the robot's name
    units     "m" or "rad" of each joint
    carrying  indices of the linear axes that carry the arm; the other joints are the arm's
    limits    with the joints' names
    geometry  capsules and home pose as JSON text, as ``robot_io.safety.clearance`` reads it; None: the shipped file's

    Hashable, so that it may be a static argument of a compiled function.
    """

    robot: str
    units: tuple[str, ...]
    carrying: tuple[int, ...]
    limits: JointLimits
    geometry: str | None = None

    def __post_init__(self) -> None:
        if len(self.units) != self.n_joints or not set(self.units) <= {"m", "rad"}:
            raise ValueError(f"units are {self.units}: m or rad is needed for each of {self.joints}")
        if not set(self.carrying) <= set(range(self.n_joints)):
            raise ValueError(f"carrying is {self.carrying}: indices of the {self.n_joints} joints are needed")

    @property
    def joints(self) -> tuple[str, ...]:
        return self.limits.joints

    @property
    def n_joints(self) -> int:
        return len(self.joints)

    @property
    def arm(self) -> tuple[int, ...]:
        """Indices of the joints that are no carrying axes."""
        return tuple(i for i in range(self.n_joints) if i not in self.carrying)

    @property
    def observation_names(self) -> tuple[str, ...]:
        return (*_BALL, *self.joints)

    @property
    def observation_units(self) -> tuple[str, ...]:
        return ("m", "m", "m", *self.units)

    @property
    def n_observation(self) -> int:
        return len(_BALL) + self.n_joints

    @property
    def filters(self) -> tuple[int, ...]:
        """Outputs of the network's layers: those of the last one are the action."""
        return (*FILTERS[:-1], self.n_joints)


PAPER = Contract("irb120_gantry", JOINT_UNITS, FESTO_JOINTS, LIMITS)

# The 976-parameter policy: three valid 1-D convolutions of kernel 2 over the history; layers 1 and 2 are gated
# (tanh * sigmoid, so the convolution has twice the filters), layer 3 ends in tanh. reference: paper, appendix E.
KERNEL = 2
FILTERS = (8, 12, 8)
DILATIONS = (1, 2, 4)
GATED = (True, True, False)


def parameter_shapes(n_joints: int = N_JOINTS) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the policy's parameters in the order of the flat vector theta, (976,) for eight joints.

    ``conv<i>/kernel`` is (KERNEL, inputs, outputs) with kernel tap 0 the OLDER observation; the outputs of a gated
    layer are the tanh half first, then the sigmoid half. ``conv<i>/bias`` is (outputs,). Arrays are
    flattened in C order.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = len(_BALL) + n_joints
    for i, (filters, gated) in enumerate(zip((*FILTERS[:-1], n_joints), GATED, strict=True), start=1):
        outputs = filters * (2 if gated else 1)
        shapes[f"conv{i}/kernel"] = (KERNEL, inputs, outputs)
        shapes[f"conv{i}/bias"] = (outputs,)
        inputs = filters
    return shapes


def n_parameters(n_joints: int = N_JOINTS) -> int:
    """Number of policy parameters: 976 for eight joints."""
    return sum(int(np.prod(shape)) for shape in parameter_shapes(n_joints).values())


def unflatten(theta: Any, shapes: Mapping[str, tuple[int, ...]] | None = None) -> dict[str, Any]:
    """Splits theta (size, ...batch) into arrays by name of these shapes, in this order, with the batch axes last.

    Works on NumPy and JAX arrays. Without ``shapes``: ``parameter_shapes()``. Raises ValueError for another size.
    """
    shapes = parameter_shapes() if shapes is None else shapes
    sizes = [int(np.prod(shape)) for shape in shapes.values()]
    if theta.shape[0] != sum(sizes):
        raise ValueError(f"theta has {theta.shape[0]} parameters, expected {sum(sizes)}")
    parts, start = {}, 0
    for (name, shape), size in zip(shapes.items(), sizes, strict=True):
        parts[name] = theta[start : start + size].reshape(shape + theta.shape[1:])
        start += size
    return parts


def describe(robot: Contract = PAPER) -> dict[str, Any]:
    """The contract as plain data for manifests and error messages.

    Another robot's has the keys ``robot``, ``carrying`` and ``geometry`` besides: all that its safety gate needs.
    """
    names, units, limits = robot.joints, robot.units, robot.limits
    data = {
        "version": CONTRACT_VERSION,
        "control_rate_hz": CONTROL_RATE,
        "history": HISTORY,
        "observation": [
            {"name": n, "unit": u} for n, u in zip(robot.observation_names, robot.observation_units, strict=True)
        ],
        "action": [
            {"name": n, "unit": f"{u}/s", "scale": v}
            for n, u, v in zip(names, units, limits.policy_velocity, strict=True)
        ],
        "limits": {name: list(values) for name, values in limits.numbers().items()},
        "parameters": {name: list(shape) for name, shape in parameter_shapes(robot.n_joints).items()},
        "frame": "origin at the table's centre on its top surface; x across, y along the table (human y > 0), z up; "
        "SI units",
    }
    if robot == PAPER:
        return data
    geometry = None if robot.geometry is None else json.loads(robot.geometry)
    return data | {"robot": robot.robot, "carrying": [names[i] for i in robot.carrying], "geometry": geometry}


def from_description(data: Any) -> Contract:
    """The contract that ``describe`` wrote; without the key ``robot`` it is the paper's robot's.

    Raises ContractError where such data cannot be made a contract of. That the rest of the data agrees with this
    program is for the caller to see, by comparing it with ``describe``.
    """
    if not isinstance(data, dict) or "robot" not in data:
        return PAPER
    try:
        names = tuple(str(action["name"]) for action in data["action"])
        units = tuple(str(action["unit"]).removesuffix("/s") for action in data["action"])
        limits = {name: tuple(float(v) for v in values) for name, values in data["limits"].items()}
        carrying = tuple(names.index(name) for name in data["carrying"])
        geometry = None if data["geometry"] is None else json.dumps(data["geometry"])
        return Contract(str(data["robot"]), units, carrying, JointLimits(**limits, joints=names), geometry)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ContractError(f"no contract of a robot: {type(error).__name__}: {error}") from error
