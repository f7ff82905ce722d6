"""Elements that a serial chain of hinges and slides cannot represent: the refusals behind ``mjx_tt.robot.chain``.

Everything that changes how MuJoCo C moves the model is either carried by a ``Chain`` or named here.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

_DISABLE, _OBJ = mujoco.mjtDisableBit, mujoco.mjtObj

# As int: an enumerator of MuJoCo does not equal the NumPy integers that the model's arrays hold.
_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
_JOINT_TRANSMISSIONS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_JOINT_FIELDS = {  # that must be zero, and why
    "jnt_stiffness": "joint stiffness is not supported",
    "jnt_stiffnesspoly": "polynomial joint stiffness is not supported",
    "dof_dampingpoly": "only linear damping is supported",
    "dof_frictionloss": "frictionloss is not supported",
    "jnt_actfrclimited": "actuatorfrcrange is not supported",
}
_ACTUATOR_TYPES = (  # field, type, accepted values
    ("dyntype", mujoco.mjtDyn, (int(mujoco.mjtDyn.mjDYN_NONE),)),
    ("gaintype", mujoco.mjtGain, (int(mujoco.mjtGain.mjGAIN_FIXED),)),
    ("biastype", mujoco.mjtBias, (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))),
)


def unsupported(model: mujoco.MjModel, carriers: list[int]) -> Iterator[str]:
    """One sentence, starting with the element's name, for everything in the model that a ``Chain`` cannot represent.

    carriers: for every body the link that carries it, -1 where nothing moves it.
    """
    yield from _unsupported_options(model)
    yield from _unsupported_joints(model)
    yield from _unsupported_bodies(model, carriers)
    yield from _unsupported_actuators(model)
    for obj, count, what in (
        (_OBJ.mjOBJ_TENDON, model.ntendon, "tendons"),
        (_OBJ.mjOBJ_EQUALITY, model.neq, "equality constraints"),
        (_OBJ.mjOBJ_FLEX, model.nflex, "flexes"),
        (_OBJ.mjOBJ_PLUGIN, model.nplugin, "plugins"),
    ):
        for i in range(count):
            yield f"{object_name(model, obj, i)}: {what} are not supported"
    if _disabled(model, _DISABLE.mjDSBL_CONTACT) or _disabled(model, _DISABLE.mjDSBL_CONSTRAINT):
        return
    for geom in range(model.ngeom):
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            name = object_name(model, _OBJ.mjOBJ_GEOM, geom)
            yield f"{name}: geom can collide; set its contype and conaffinity to 0 or disable contacts"
    for pair in range(model.npair):
        yield f"{object_name(model, _OBJ.mjOBJ_PAIR, pair)}: contact pairs need contacts to be disabled"


def _unsupported_options(model: mujoco.MjModel) -> Iterator[str]:
    integrator = mujoco.mjtIntegrator(model.opt.integrator)
    if integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        yield f"option integrator: only implicitfast is supported, got {integrator.name}"
    yield from altered_forces(model)
    if model.opt.disableactuator:
        yield "option actuatorgroupdisable: disabled actuator groups are not supported"
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        yield "option flag sleep: must stay disabled"


def altered_forces(model: mujoco.MjModel) -> Iterator[str]:
    """One sentence for every option that adds forces to the model or takes some away."""
    for option in ("density", "viscosity"):
        if value := getattr(model.opt, option):
            yield f"option {option}: must be 0 (no fluid forces), got {value:g}"
    for flag in ("ACTUATION", "GRAVITY", "DAMPER"):
        if _disabled(model, getattr(_DISABLE, f"mjDSBL_{flag}")):
            yield f"option flag {flag.lower()}: must stay enabled"


def _unsupported_joints(model: mujoco.MjModel) -> Iterator[str]:
    if not model.njnt:
        yield "the model has no joints"
    limits_act = not (_disabled(model, _DISABLE.mjDSBL_LIMIT) or _disabled(model, _DISABLE.mjDSBL_CONSTRAINT))
    for joint in range(model.njnt):
        name = object_name(model, _OBJ.mjOBJ_JOINT, joint)
        if model.jnt_type[joint] not in (_SLIDE, _HINGE):
            kind = mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower()
            yield f"{name}: {kind} joints are not supported, only hinge and slide"
            continue
        for field, reason in _JOINT_FIELDS.items():
            if _any(model, field, model.jnt_dofadr[joint] if field.startswith("dof") else joint):
                yield f"{name}: {reason}"
        if model.jnt_limited[joint] and limits_act:
            yield f'{name}: joint limits need constraints to be disabled (<flag constraint="disable"/>)'


def _unsupported_bodies(model: mujoco.MjModel, carriers: list[int]) -> Iterator[str]:
    moved_by: dict[int, int] = {}  # link index -> the moving body that it carries
    heavy: dict[int, int] = {}  # link index -> its first body with mass
    for body in range(1, model.nbody):
        name = object_name(model, _OBJ.mjOBJ_BODY, body)
        parent = model.body_parentid[body]
        if model.body_jntnum[body]:
            if carriers[parent] < 0 and model.body_mocapid[model.body_rootid[body]] >= 0:
                yield f"{name}: a chain on a mocap body is not supported"
            sibling = moved_by.setdefault(carriers[parent], body)
            if sibling != body:
                other = object_name(model, _OBJ.mjOBJ_BODY, sibling)
                yield f"{name}: branches off beside {other}; only one moving child is supported"
        link = carriers[body]
        if link >= 0 and model.body_mass[body]:
            first = heavy.setdefault(link, body)
            if model.body_gravcomp[body] != model.body_gravcomp[first]:
                other = object_name(model, _OBJ.mjOBJ_BODY, first)
                yield f"{name}: gravcomp must equal that of {other}, to which it is fixed"


def _unsupported_actuators(model: mujoco.MjModel) -> Iterator[str]:
    used: dict[int, int] = {}  # joint -> its first actuator
    for actuator in range(getattr(model, "nactuator", model.nu)):
        name = object_name(model, _OBJ.mjOBJ_ACTUATOR, actuator)
        if model.actuator_trntype[actuator] not in _JOINT_TRANSMISSIONS:
            transmission = mujoco.mjtTrn(model.actuator_trntype[actuator]).name
            yield f"{name}: only joint transmissions are supported, got {transmission}"
            continue
        for field, kind, accepted in _ACTUATOR_TYPES:
            value = int(getattr(model, f"actuator_{field}")[actuator])
            if value not in accepted:
                yield f"{name}: {field} {kind(value).name} is not supported, only {[kind(v).name for v in accepted]}"
        for limit in ("ctrllimited", "forcelimited"):
            if getattr(model, f"actuator_{limit}")[actuator]:
                yield f"{name}: {limit} is not supported"
        for field in ("delay", "armature", "damping", "dampingpoly"):
            if _any(model, f"actuator_{field}", actuator):
                yield f"{name}: actuator {field} is not supported"
        joint = int(model.actuator_trnid[actuator, 0])
        first = used.setdefault(joint, actuator)
        if first != actuator:
            joint_name = object_name(model, _OBJ.mjOBJ_JOINT, joint)
            yield f"{name}: joint {joint_name} already has actuator {object_name(model, _OBJ.mjOBJ_ACTUATOR, first)}"


def _any(model: mujoco.MjModel, field: str, index: int | np.integer) -> bool:
    """True where the field has a non-zero entry at index; False where this MuJoCo release does not have the field."""
    values = getattr(model, field, None)
    return values is not None and bool(np.any(values[index]))


def _disabled(model: mujoco.MjModel, flag: mujoco.mjtDisableBit) -> bool:
    return bool(model.opt.disableflags & flag)


def object_name(model: mujoco.MjModel, obj: mujoco.mjtObj, index: int) -> str:
    """The object's name in the model, or words that identify it when it has none."""
    return mujoco.mj_id2name(model, obj, index) or f"unnamed {obj.name.removeprefix('mjOBJ_').lower()} {index}"
