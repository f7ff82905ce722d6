"""Positions of the robot's capsules and their distances from the table, the floor and each other, in float64.

``robot_geometry.json`` (format 1) is written from the MJCF by ``python -m mjx_tt.robot.geometry_export``:
    joints          in the contract's order: name, type (slide or hinge), unit axis, pos and rot of the joint's frame in
                    the one before it at q = 0 [m]; every frame sits on its joint's anchor, hinges come after slides
    capsules        name, the joint that carries it or "world" where none does, axis end points p0 and p1 in that
                    joint's frame, radius [m]
    table           centre and half sizes of the table top's box [m];   floor: its height [m]
    table_capsules, blade_capsules, self_pairs: names of what is watched;   home: joint positions (n,)

Gaps are signed: negative by how deep a capsule overlaps, at most by its radius (an axis inside the box counts as 0).
"""

from __future__ import annotations

import copy
import json
import math
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from robot_io.calibrated import Frame
from robot_io.contract import JOINT_NAMES, PAPER, Contract
from robot_io.safety.capsules import find_too_close, measure_all, place_ends, place_frames

FORMAT = 1
SHIPPED = "robot_geometry.json"
BLADE = "col_blade_axis"  # the paper's robot's capsule whose middle is the blade's centre
FIXED = "world"  # carrier of a capsule that nothing moves
WORST = 4  # vectors beside a way that are looked at along all of it
LEVELS = 5  # halvings of a stretch before it counts as too close

_KEYS = ("format", "joints", "capsules", "table", "floor", "table_capsules", "blade_capsules", "self_pairs", "home")


class GeometryError(ValueError):
    """The geometry file cannot be used: the message names the file, what was found and what to do."""


class RobotGeometry:
    """The robot's capsules and what is watched about them.

    rows    what each watched gap is between, for messages: "col_wrist to the table", ...
    kinds   (R,) what kind of gap a row is: "table", "self" or "floor"
    home    (n,) joint positions of the home pose
    joints  names of the joints, in the contract's order, and their units, "m" or "rad"
    tip     the capsule whose middle is the blade's centre
    """

    def __init__(self, data: dict[str, Any], where: str = "geometry", joints: tuple[str, ...] = JOINT_NAMES) -> None:
        """From parsed JSON of a robot with these joints; ``where`` names its origin in errors. Raises GeometryError."""
        self.joints = _check(data, where, joints)
        self.units = tuple("m" if joint["type"] == "slide" else "rad" for joint in data["joints"])
        self.home = np.array(data["home"], float)
        hinge = np.array([joint["type"] == "hinge" for joint in data["joints"]], float)
        capsules = {c["name"]: c for c in data["capsules"]}
        watched, pairs, self.tip = data["table_capsules"], data["self_pairs"], data["blade_capsules"][0]
        unknown = sorted({*watched, *data["blade_capsules"], *(n for pair in pairs for n in pair)} - capsules.keys())
        if unknown:
            raise GeometryError(f"{where}: no capsules named {unknown}; it has {sorted(capsules)}")
        order = self._names = list(capsules)
        joint = np.array([(*self.joints, FIXED).index(capsules[n]["joint"]) for n in order])
        local = np.array([[capsules[n][end] for end in ("p0", "p1")] for n in order], float)
        self._chain = (_transform_basis(data["joints"]), np.eye(4), joint, local)
        radius = np.array([capsules[n]["radius"] for n in order], float)
        self._table_rows = np.array([order.index(n) for n in watched])
        self._blade_rows = np.array([watched.index(n) for n in data["blade_capsules"]])
        first, second = (np.array([order.index(pair[i]) for pair in pairs], int) for i in (0, 1))
        centre, half = (np.array(data["table"][key], float) for key in ("centre", "half"))
        floor = float(data["floor"])
        # Frame and legs are not modelled one by one: nothing of the arm belongs under the table.
        block = np.stack([np.append((centre - half)[:2], floor), centre + half])
        self._watch = (self._table_rows, first, second, radius, block, floor)
        self.rows = (
            *(f"{n} to the table" for n in watched),
            *(f"{a} to {b}" for a, b in pairs),
            *(f"{n} to the floor" for n in watched),
        )
        self.kinds = np.array(["table"] * len(watched) + ["self"] * len(pairs) + ["floor"] * len(watched))
        last = [-1 if capsules[n]["joint"] == FIXED else self.joints.index(capsules[n]["joint"]) for n in order]
        levers = _levers(data["joints"], [(i, capsules[n]) for i, n in zip(last, order, strict=True)])
        self._bounds = (hinge, levers)

    @classmethod
    def of(cls, contract: Contract) -> RobotGeometry:
        """The geometry of a contract's robot. Raises GeometryError where the contract has none or another's."""
        if contract == PAPER:
            return cls.load()
        if contract.geometry is None:
            raise GeometryError(f"{contract.robot}: its contract has no geometry; export its policy again")
        return cls(json.loads(contract.geometry), f"geometry of {contract.robot}", contract.joints)

    @classmethod
    def load(cls, path: str | Path | None = None) -> RobotGeometry:
        """The paper's robot's geometry, or another file of it. Raises GeometryError."""
        source = resources.files("robot_io.safety") / SHIPPED if path is None else Path(path)
        try:
            data = json.loads(source.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            remedy = "write it with python -m mjx_tt.robot.geometry_export"
            raise GeometryError(f"{source}: cannot be read ({error}); {remedy}") from error
        return cls(data, str(source))

    def moved(self, base: Frame) -> RobotGeometry:
        """The same robot on a base that stands elsewhere; table and floor stay."""
        if base.neutral:
            return self
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = base.matrix, base.position
        other = copy.copy(self)
        other._chain = (self._chain[0], place, *self._chain[2:])
        return other

    def hand(self, q: np.ndarray) -> np.ndarray:
        """Transforms (B, 4, 4) from the last joint's frame to the world at joint positions q (n, B)."""
        return place_frames(np.array(q, float, order="C"), *self._chain[:2])[:, -2]

    def ends(self, q: np.ndarray) -> np.ndarray:
        """World end points (B, capsules, 2, 3) of every capsule's axis at joint positions q (n, B)."""
        return place_ends(np.array(q, float, order="C"), *self._chain)

    @property
    def blade(self) -> np.ndarray:
        """The blade's centre (3,) [m] in the last joint's frame."""
        return self._chain[3][self._names.index(self.tip)].mean(axis=0)

    @property
    def normal(self) -> np.ndarray:
        """The blade's normal (3,) in the last joint's frame, either way; almost 0 where its capsules are parallel."""
        a, b = np.diff(self._chain[3][self._table_rows[self._blade_rows[[0, -1]]]], axis=1)[:, 0]
        return np.cross(a, b) / max(float(np.linalg.norm(np.cross(a, b))), 1e-12)

    def blade_points(self, q: np.ndarray) -> np.ndarray:
        """World end points (3, 4, B) [m] of the blade's capsules at joint positions q (n, B)."""
        ends = self.ends(q)[:, self._table_rows[self._blade_rows]]
        return ends.transpose(3, 2, 1, 0).reshape(3, -1, q.shape[1])

    def middles(self, capsule: str, q: np.ndarray) -> np.ndarray:
        """World positions (3, B) [m] of the middle of a capsule's axis at joint positions q (n, B)."""
        return self.ends(q)[:, self._names.index(capsule)].mean(axis=1).T

    def middle(self, capsule: str, q: np.ndarray) -> np.ndarray:
        """As ``middles`` at joint positions q (n,): (3,)."""
        return self.middles(capsule, q[:, None])[:, 0]

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Every watched gap (R, B) [m] in the order of ``rows`` at q (n, B).

        The table reaches down to the floor here, so a gap to it is never larger than the simulation's.
        """
        return measure_all(self.ends(q), self._watch)

    def first_too_close(self, q: np.ndarray, margin: np.ndarray, slack: float) -> int | None:
        """Row of a gap that may come too close on the way q (n, N), straight between its points; None: proven clear.

        margin  (R,) [m] wanted gaps; where a row starts with less, it must not lose anything
        slack   [m] by which gaps may be smaller between the points than at them

        Between two points a capsule leaves the straight chord by at most its curvature / 8, and along the chords a gap
        stays above (g_0 + g_1 - chord) / 2. Stretches that this does not clear are halved up to ``LEVELS`` times; what
        is unclear then counts as too close.
        """
        way = np.array(q, float, order="C")
        row = find_too_close(way, margin, slack, LEVELS, self._chain, self._watch, self._bounds)
        return None if row < 0 else int(row)

    def clear_beside(self, way: np.ndarray, beside: np.ndarray, margin: np.ndarray) -> bool:
        """True when a robot that goes beside the way (n, N) by any of the vectors (n, K) keeps gaps of ``margin`` (R,).

        A gap that starts with less must not become smaller. Of the vectors the worst where the way ends are examined,
        at the way's points.
        """
        there = (self.gaps(way[:, -1:] + beside) - margin[:, None]).min(axis=0)
        worst = beside[:, there.argsort()[:WORST]]
        q = way[:, None] + worst[:, :, None]
        gaps = self.gaps(q.reshape(len(self.joints), -1)).reshape(-1, *q.shape[1:])
        return bool((gaps >= np.minimum(margin[:, None], gaps[..., 0])[..., None]).all())


def _transform_basis(joints: list[dict]) -> np.ndarray:
    """(n, 4, 4, 4): every joint's 4 x 4 transform is the sum of these times 1, sin q, 1 - cos q and q (Rodrigues)."""
    basis = np.zeros((len(joints), 4, 4, 4))
    for i, joint in enumerate(joints):
        rot, axis = np.array(joint["rot"], float), np.array(joint["axis"], float)
        basis[i, 0, :3, :3], basis[i, 0, :3, 3], basis[i, 0, 3, 3] = rot, joint["pos"], 1.0
        if joint["type"] == "slide":
            basis[i, 3, :3, 3] = rot @ axis
        else:
            x, y, z = axis
            skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            basis[i, 1, :3, :3], basis[i, 2, :3, :3] = rot @ skew, rot @ skew @ skew
    return basis


def _levers(joints: list[dict], capsules: list[tuple[int, dict]]) -> np.ndarray:
    """(capsules, n) [m]: bound on the distance of a capsule's axis from each hinge that moves it, in any pose."""
    levers = np.zeros((len(capsules), len(joints)))
    for row, (last, capsule) in enumerate(capsules):
        length = max(math.hypot(*capsule["p0"]), math.hypot(*capsule["p1"]))
        for i in range(last, -1, -1):
            if joints[i]["type"] == "hinge":
                levers[row, i] = length
                length += math.hypot(*joints[i]["pos"])
    return levers


def _check(data: Any, where: str, joints: tuple[str, ...]) -> tuple[str, ...]:
    """The joints' names. Raises GeometryError."""
    rewrite = "write it again with python -m mjx_tt.robot.geometry_export"
    if not isinstance(data, dict) or set(data) != set(_KEYS):
        found = sorted(data) if isinstance(data, dict) else type(data).__name__
        raise GeometryError(f"{where}: keys are {found}, expected {sorted(_KEYS)}; {rewrite}")
    if data["format"] != FORMAT:
        raise GeometryError(f"{where}: format is {data['format']!r}, this program reads {FORMAT}; {rewrite}")
    try:
        names = tuple(joint["name"] for joint in data["joints"])
        if names != joints:
            raise GeometryError(f"{where}: joints are {names}, the contract's are {joints}; {rewrite}")
        types = [joint["type"] for joint in data["joints"]]
        if types != sorted(types, key=("slide", "hinge").index):
            raise GeometryError(f"{where}: joint types are {types}; slides must come before hinges")
        numbers = [
            *(
                np.array(joint[key], float).reshape(shape)
                for joint in data["joints"]
                for key, shape in (("axis", 3), ("pos", 3), ("rot", (3, 3)))
            ),
            *(
                np.array(c[key], float).reshape(shape)
                for c in data["capsules"]
                for key, shape in (("p0", 3), ("p1", 3), ("radius", ()))
            ),
            *(np.array(data["table"][key], float).reshape(3) for key in ("centre", "half")),
            np.array(data["home"], float).reshape(len(names)),
            np.array(data["floor"], float).reshape(()),
        ]
        if any(c["joint"] not in (*names, FIXED) for c in data["capsules"]):
            raise GeometryError(f"{where}: a capsule is on a joint that is none of {names}; {rewrite}")
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, GeometryError):
            raise
        raise GeometryError(f"{where}: malformed ({error!r}); {rewrite}") from error
    if not all(np.isfinite(n).all() for n in numbers):
        raise GeometryError(f"{where}: holds a non-finite number; {rewrite}")
    return names
