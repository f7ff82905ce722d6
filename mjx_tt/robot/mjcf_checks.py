"""Mistakes in a robot's MJCF, and between it and the YAML beside it: file, element, and what to change."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from mjx_tt.robot.chain import body_frames
from mjx_tt.robot.checks import altered_forces, unsupported
from mjx_tt.robot.mjcf import PADDLE_SITE, capsules
from mjx_tt.sim.actuators import EFFECTS
from robot_io.robot_file import RobotFile

GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2] of the court
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_NEEDED_FILES = re.compile(r"<include\b|<(mesh|hfield|skin|model|texture)\b[^>]*\bfile\s*=")
_REMEDIES = {  # words of ``checks.unsupported``: what to change
    "frictionloss": "remove frictionloss, or say it as drives: {JOINT: {coulomb_friction: ...}} in the YAML",
    "stiffness": "remove stiffness and springref",
    "forcelimited": "remove forcerange: the limits of the YAML keep the drives inside it",
    "ctrllimited": "remove ctrlrange: the limits of the YAML keep the commands",
    "actuatorfrcrange": "remove actuatorfrcrange",
    "ball joints": "build it of three hinges",
    "free joints": "remove the freejoint: the base is mounted by the YAML's mount",
    "branches off": "remove one of the two moving children, a gripper's finger for example, or fix it",
    "equality constraints": "remove the <equality> element",
    "tendons": "remove the <tendon> element",
    "linear damping": "give damping one number",
}


def needs_files(mjcf: str) -> bool:
    """True for an MJCF that reads other files: meshes, textures, includes."""
    return _NEEDED_FILES.search(mjcf) is not None


def find_mistakes(robot: Any, where: str, yaml: str) -> Iterator[str]:
    """One line for every mistake of a ``robots.Robot``. where, yaml: names of its MJCF and its YAML in messages."""
    file = robot.file
    yield from _drives(file, yaml)
    try:
        alone = robot.own_spec().compile()
    except ValueError as error:
        yield f"{where}: MuJoCo cannot compile it: {_one_line(error)}"
        return
    found = [
        *_options(alone, where),
        *_joints(file, alone, where, yaml),
        *_actuators(file, alone, where),
        *_paddle(file, alone, where, yaml),
    ]
    yield from found
    try:
        model = robot.model()
    except ValueError as error:
        yield f"{where}: cannot stand at the table: {_one_line(error)}; rename it, the scene has one of that name"
        return
    carriers = [frame.link for frame in body_frames(model)]
    for line in unsupported(model, carriers):
        remedy = next((f"; {text}" for words, text in _REMEDIES.items() if words in line), "")
        yield f"{where}: {line}{remedy}"
    missing = list(_capsules(file, model, where, yaml))
    yield from missing
    if not found and not missing:
        yield from _home(file, model, yaml)


def _drives(file: RobotFile, yaml: str) -> Iterator[str]:
    for path, value in file.model:
        group, name, *effect = path.split(".")
        if group == "drives" and effect[0] not in EFFECTS:
            yield f"{yaml}: {path}: got {value!r}; allowed effects of {name}: {', '.join(EFFECTS)}"


def _options(model: mujoco.MjModel, where: str) -> Iterator[str]:
    for line in altered_forces(model):
        yield f"{where}: {line}; remove it"
    if not np.allclose(model.opt.gravity, GRAVITY):
        yield f"{where}: option gravity: is {model.opt.gravity.tolist()}; remove it, the court's is {list(GRAVITY)}"


def _joints(file: RobotFile, model: mujoco.MjModel, where: str, yaml: str) -> Iterator[str]:
    wanted = file.contract.joints
    found = [model.joint(i).name for i in range(model.njnt)]
    for i, name in enumerate(found):
        if not name:
            yield f"{where}: joint {i} of body {model.body(model.jnt_bodyid[i]).name!r} has no name; give it one"
    for name in wanted:
        if name not in found:
            yield f"{yaml}: joints.{name}: the MJCF has no such joint; it has {', '.join(map(str, found)) or 'none'}"
    for name in found:
        if name and name not in wanted:
            yield f"{where}: joint {name}: is not listed under joints of {yaml}; list it there or remove the joint"
    if set(found) == set(wanted) and tuple(found) != wanted:
        yield f"{yaml}: joints: the order is {', '.join(wanted)}; from base to paddle it is {', '.join(found)}"
    limits = file.contract.limits
    for i, name in enumerate(wanted):
        if name not in found:
            continue
        joint, axis = model.joint(name), i in file.contract.carrying
        if int(joint.type[0]) == _SLIDE and not axis:
            yield f"{yaml}: carrying: joint {name} is a slide of the MJCF; list it there, or make it a hinge"
        if int(joint.type[0]) != _SLIDE and axis:
            yield f"{yaml}: carrying: joint {name} is no slide of the MJCF; remove it there"
        low, high = (float(end) for end in joint.range)
        if model.jnt_limited[joint.id] and not (low - 1e-3 <= limits.lower[i] and limits.upper[i] <= high + 1e-3):
            given = [limits.lower[i], limits.upper[i]]
            yield f"{yaml}: joints.{name}.range: got {given}; allowed: inside the MJCF's, [{low:g}, {high:g}]"
    slides = [name in [wanted[i] for i in file.contract.carrying] for name in found]
    if slides != sorted(slides, reverse=True):
        yield f"{where}: joint {found[slides.index(True)]}: a linear axis follows a hinge; axes must carry the arm"


def _actuators(file: RobotFile, model: mujoco.MjModel, where: str) -> Iterator[str]:
    wanted = file.contract.joints
    driven: list[str] = []
    for i in range(model.nu):
        name, joint = model.actuator(i).name or f"actuator {i}", model.joint(int(model.actuator_trnid[i, 0])).name
        if model.actuator_trntype[i] != int(mujoco.mjtTrn.mjTRN_JOINT):
            yield f"{where}: actuator {name}: drives no joint; allowed: one <velocity joint=... kv=...> for each joint"
            continue
        driven.append(joint)
        gain, bias = float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i, :3]
        servo = gain > 0.0 and bias[0] == 0.0 and bias[1] == 0.0 and np.isclose(bias[2], -gain)
        if not servo or model.actuator_gear[i, 0] != 1.0:
            yield (
                f"{where}: actuator {name}: is no velocity servo; write "
                f'<velocity name="{joint}" joint="{joint}" kv="..."/> with kv = inertia / time constant'
            )
    for name in wanted:
        if name not in driven and any(model.joint(j).name == name for j in range(model.njnt)):
            yield f'{where}: joint {name}: has no actuator; add <velocity name="{name}" joint="{name}" kv="..."/>'
    if len(driven) == len(set(driven)) and set(driven) == set(wanted) and tuple(driven) != wanted:
        yield f"{where}: <actuator>: the order is {', '.join(driven)}; write them as the joints: {', '.join(wanted)}"


def _paddle(file: RobotFile, model: mujoco.MjModel, where: str, yaml: str) -> Iterator[str]:
    name, sites = file.paddle, [model.site(i).name for i in range(model.nsite)]
    if name not in sites:
        known = ", ".join(filter(None, sites)) or "none"
        yield (
            f'{yaml}: paddle: got {name!r}; the sites of the MJCF: {known}; add <site name="{name}" ...> at the '
            "blade's centre, x along the handle, z out of the striking face"
        )
        return
    if name != PADDLE_SITE and PADDLE_SITE in sites:
        yield f"{where}: site {PADDLE_SITE}: is not the paddle's ({name}); rename it"
    link = body_frames(model)[model.site_bodyid[sites.index(name)]].link
    if link != model.njnt - 1:
        carrier = "nothing" if link < 0 else f"joint {model.joint(link).name}"
        yield f"{where}: site {name}: is moved by {carrier}; put it into a body that the last joint moves"


def _capsules(file: RobotFile, model: mujoco.MjModel, where: str, yaml: str) -> Iterator[str]:
    known = {capsule.name: capsule for capsule in capsules(model)}
    geoms = {model.geom(i).name for i in range(model.ngeom)}
    named = {"table": file.table, "blade": file.blade, "pairs": tuple(dict.fromkeys(n for p in file.pairs for n in p))}
    for key, wanted in named.items():
        for name in wanted:
            if name in known:
                continue
            if name in geoms:
                yield f'{where}: geom {name}: must be a capsule whose name starts with col_; write type="capsule"'
            else:
                yield (
                    f"{yaml}: clearance.{key}: got {name!r}; the MJCF's capsules are {', '.join(known) or 'none'}; add "
                    f'<geom name="{name}" type="capsule" fromto="..." size="..."/> there'
                )
    for name in file.blade:
        if name in known and known[name].link != model.njnt - 1:
            yield f"{where}: geom {name}: a capsule of the blade must be moved by the last joint"


def _home(file: RobotFile, model: mujoco.MjModel, yaml: str) -> Iterator[str]:
    """Contact at home."""
    data = mujoco.MjData(model)
    data.qpos[:] = file.home
    mujoco.mj_kinematics(model, data)
    names = [(name, "col_table") for name in file.table] + list(file.pairs)
    for first, second in names:
        pair = [model.geom(name).id for name in (first, second)]
        gap = mujoco.mj_geomDistance(model, data, pair[0], pair[1], 1.0, None)
        if gap <= 0.0:
            other = "the table" if second == "col_table" else second
            remedy = "change a home, the mount or the capsules"
            yield f"{yaml}: joints: at home {first} touches {other} ({gap:.3f} m); {remedy}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
