"""Positions of the robot's capsules and their distances from the table, the floor and each other. NumPy, float64.

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
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from robot_io.calibrated import Frame
from robot_io.contract import JOINT_NAMES, PAPER, Contract

Array = TypeVar("Array", bound=Any)  # of NumPy or JAX

FORMAT = 1
SHIPPED = "robot_geometry.json"
BLADE = "col_blade_axis"  # the paper's robot's capsule whose middle is the blade's centre
FIXED = "world"  # carrier of a capsule that nothing moves
WORST = 4  # vectors beside a way that are looked at along all of it
LEVELS = 5  # halvings of a stretch before it counts as too close

_KEYS = ("format", "joints", "capsules", "table", "floor", "table_capsules", "blade_capsules", "self_pairs", "home")
_TINY = 1e-12  # as in the simulation: segments more parallel than this are taken as parallel
_NO_WAY = 1e-30  # stands for a direction component of 0 in quotients


class GeometryError(ValueError):
    """The geometry file cannot be used: the message names the file, what was found and what to do."""


class Clearances(NamedTuple):
    """Smallest gaps [m], each (B,), as the simulation's reward knows them."""

    table: np.ndarray  # any watched capsule to the table top
    own: np.ndarray  # any watched pair of capsules
    blade: np.ndarray  # the blade to the table top


@dataclass(frozen=True)
class Box:
    """An axis-aligned box: low and high corners (3, 1, 1) [m]."""

    low: np.ndarray
    high: np.ndarray

    def distance(self, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Distance [m], (n, B), of segments p-q, ends (3, n, B); 0 where they meet. Exact.

        The simulation's ``mjx_tt.robot.clearance.segment_box_distance`` bisects instead, in a form without sorting and
        indexing that the compiler turns into vector loops; a test compares the two.

        Along a segment the squared distance is convex and its derivative linear between the points where a coordinate
        enters or leaves its slab: interpolating between the two such points around the zero finds the minimum.
        """
        d = q - p
        inverse = 1.0 / np.where(np.abs(d) < _NO_WAY, _NO_WAY, d)
        kinks = np.concatenate([(self.low - p) * inverse, (self.high - p) * inverse])
        t = np.empty((8, *p.shape[1:]))
        t[0], t[1] = 0.0, 1.0
        np.clip(kinks, 0.0, 1.0, out=t[2:])
        slope = np.einsum("xknb,xnb->knb", self._gap(p[:, None] + t * d[:, None]), d)
        falling = slope <= 0.0
        t_low, t_high = np.where(falling, t, 0.0).max(0), np.where(falling, 1.0, t).min(0)
        s_low, s_high = np.where(falling, slope, -np.inf).max(0), np.where(falling, np.inf, slope).min(0)
        inside = np.isfinite(s_low) & np.isfinite(s_high)
        share = -np.where(inside, s_low, 0.0) / np.where(inside, s_high - s_low, 1.0)
        best = np.where(np.isfinite(s_low), np.where(inside, t_low + share * (t_high - t_low), 1.0), 0.0)
        gap = self._gap(p + best * d)
        return np.sqrt(np.einsum("xnb,xnb->nb", gap, gap))

    def _gap(self, point: np.ndarray) -> np.ndarray:
        """From the nearest point of the box to ``point`` (3, ..., n, B)."""
        extra = (1,) * (point.ndim - 3)
        low, high = (corner.reshape(3, *extra, 1, 1) for corner in (self.low, self.high))
        return point - np.minimum(np.maximum(point, low), high)


def segment_distance(p1: Array, q1: Array, p2: Array, q2: Array, xp: ModuleType = np) -> Array:
    """Distance [m], (...), of segments p1-q1 and p2-q2, each end (3, ...); ``xp``: numpy or jax.numpy.

    Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e, b = _dot(d1, d1), _dot(d2, d2), _dot(d1, d2)
    f, c = _dot(d2, r), _dot(d1, r)
    denominator = a * e - b * b
    s = xp.where(denominator > _TINY, (b * f - c * e) / xp.maximum(denominator, _TINY), 0.0)
    t = xp.clip((b * xp.clip(s, 0.0, 1.0) + f) / xp.maximum(e, _TINY), 0.0, 1.0)
    s = xp.clip((b * t - c) / xp.maximum(a, _TINY), 0.0, 1.0)
    gap = r + s[None] * d1 - t[None] * d2
    return xp.sqrt(_dot(gap, gap))


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


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
        self._basis = _transform_basis(data["joints"])
        self._hinge = np.array([[joint["type"] == "hinge"] for joint in data["joints"]], float)
        capsules = {c["name"]: c for c in data["capsules"]}
        watched, pairs, self.tip = data["table_capsules"], data["self_pairs"], data["blade_capsules"][0]
        unknown = sorted({*watched, *data["blade_capsules"], *(n for pair in pairs for n in pair)} - capsules.keys())
        if unknown:
            raise GeometryError(f"{where}: no capsules named {unknown}; it has {sorted(capsules)}")
        order = self._names = list(capsules)
        self._fixed = any(capsules[n]["joint"] == FIXED for n in order)
        self._base = np.eye(4)  # of what nothing moves
        self._joint = np.array([(*self.joints, FIXED).index(capsules[n]["joint"]) for n in order])
        local = np.array([[[*capsules[n][end], 1.0] for end in ("p0", "p1")] for n in order])
        self._local = local.swapaxes(1, 2)[:, None]  # (capsules, 1, 4, 2)
        self._radius = np.array([capsules[n]["radius"] for n in order], float)[:, None]
        self._table_rows = np.array([order.index(n) for n in watched])
        self._blade_rows = np.array([watched.index(n) for n in data["blade_capsules"]])
        self._first = np.array([order.index(a) for a, _ in pairs], int)
        self._second = np.array([order.index(b) for _, b in pairs], int)
        centre, half = (np.array(data["table"][key], float).reshape(3, 1, 1) for key in ("centre", "half"))
        self._floor = float(data["floor"])
        self._top = Box(centre - half, centre + half)
        # Frame and legs are not modelled one by one: nothing of the arm belongs under the table.
        self._block = Box(np.concatenate([self._top.low[:2], [[[self._floor]]]]), self._top.high)
        self.rows = (
            *(f"{n} to the table" for n in watched),
            *(f"{a} to {b}" for a, b in pairs),
            *(f"{n} to the floor" for n in watched),
        )
        self.kinds = np.array(["table"] * len(watched) + ["self"] * len(pairs) + ["floor"] * len(watched))
        last = [-1 if capsules[n]["joint"] == FIXED else self.joints.index(capsules[n]["joint"]) for n in order]
        self._levers = _levers(data["joints"], [(i, capsules[n]) for i, n in zip(last, order, strict=True)])

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
        other._base = place
        other._basis = self._basis.copy()
        other._basis[0] = (place @ self._basis[0].reshape(4, 4, 4)).reshape(4, 16)
        return other

    def hand(self, q: np.ndarray) -> np.ndarray:
        """Transforms (B, 4, 4) from the last joint's frame to the world at joint positions q (n, B)."""
        return self._frames(q)[-1]

    def _frames(self, q: np.ndarray) -> np.ndarray:
        """Transforms (n, B, 4, 4) from every joint's frame to the world."""
        n, joints = q.shape[1], len(self.joints)
        values = np.stack([np.ones_like(q), np.sin(q), 1.0 - np.cos(q), q], axis=-1)  # (8, B, 4)
        local = np.matmul(values, self._basis).reshape(joints, n, 4, 4)
        world = np.empty_like(local)
        world[0] = local[0]
        for i in range(1, joints):
            np.matmul(world[i - 1], local[i], out=world[i])
        return world

    def ends(self, q: np.ndarray) -> np.ndarray:
        """World end points (2, 3, capsules, B) of every capsule's axis at joint positions q (n, B)."""
        world = self._frames(q)
        if self._fixed:
            world = np.concatenate([world, np.broadcast_to(self._base, (1, *world.shape[1:]))])
        points = np.matmul(world[self._joint, :, :3], self._local)  # (capsules, B, 3, 2)
        return np.ascontiguousarray(points.transpose(3, 2, 0, 1))

    @property
    def blade(self) -> np.ndarray:
        """The blade's centre (3,) [m] in the last joint's frame."""
        return self._local[self._names.index(self.tip), 0, :3].mean(axis=1)

    @property
    def normal(self) -> np.ndarray:
        """The blade's normal (3,) in the last joint's frame, either way; almost 0 where its capsules are parallel."""
        a, b = np.diff(self._local[self._table_rows[self._blade_rows[[0, -1]]], 0, :3])[..., 0]
        return np.cross(a, b) / max(float(np.linalg.norm(np.cross(a, b))), _TINY)

    def blade_points(self, q: np.ndarray) -> np.ndarray:
        """World end points (3, 4, B) [m] of the blade's capsules at joint positions q (n, B)."""
        ends = self.ends(q)[:, :, self._table_rows[self._blade_rows]]
        return ends.swapaxes(0, 1).reshape(3, -1, q.shape[1])

    def middles(self, capsule: str, q: np.ndarray) -> np.ndarray:
        """World positions (3, B) [m] of the middle of a capsule's axis at joint positions q (n, B)."""
        return self.ends(q)[:, :, self._names.index(capsule)].mean(axis=0)

    def middle(self, capsule: str, q: np.ndarray) -> np.ndarray:
        """As ``middles`` at joint positions q (n,): (3,)."""
        return self.middles(capsule, q[:, None])[:, 0]

    def clearances(self, q: np.ndarray) -> Clearances:
        """The simulation's clearances at joint positions q (n, B)."""
        ends = self.ends(np.asarray(q, float))
        table = self._to_box(self._top, ends)
        return Clearances(table.min(0), self._own(ends).min(0, initial=np.inf), table[self._blade_rows].min(0))

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Every watched gap (R, B) [m] in the order of ``rows`` at q (n, B).

        Here the table reaches down to the floor, so a gap to it is never larger than ``clearances`` says.
        """
        return self._gaps(self.ends(q))

    def first_too_close(self, q: np.ndarray, margin: np.ndarray, slack: float) -> int | None:
        """Row of a gap that may come too close on the way q (n, N), straight between its points; None: proven clear.

        margin  (R,) [m] wanted gaps; where a row starts with less, it must not lose anything
        slack   [m] by which gaps may be smaller between the points than at them

        Between two points a capsule leaves the straight chord by at most its curvature / 8, and along the chords a gap
        stays above (g_0 + g_1 - chord) / 2. Stretches that this does not clear are halved up to ``LEVELS`` times; what
        is unclear then counts as too close.
        """
        ends = self.ends(q)
        gaps = self._gaps(ends)
        least = np.minimum(margin, gaps[:, 0])[:, None]
        low = ~(gaps >= least).all(1)  # so that NaN is too close
        if low.any():
            return int(low.argmax())
        least = least - slack
        a, b = slice(None, -1), slice(1, None)
        q0, q1, e0, e1, g0, g1 = q[:, a], q[:, b], ends[..., a], ends[..., b], gaps[:, a], gaps[:, b]
        for level in range(LEVELS + 1):
            unclear = ~(0.5 * (g0 + g1 - self._chord(e1 - e0)) - self._bulge(q1 - q0) >= least)
            some = unclear.any(0)
            if not some.any():
                return None
            if level == LEVELS:
                break
            q0, q1, e0, e1, g0, g1 = (x[..., some] for x in (q0, q1, e0, e1, g0, g1))
            middle = 0.5 * (q0 + q1)
            ends = self.ends(middle)
            gaps = self._gaps(ends)
            low = ~(gaps >= least).all(1)
            if low.any():
                return int(low.argmax())
            q0, q1 = np.concatenate([q0, middle], -1), np.concatenate([middle, q1], -1)
            e0, e1 = np.concatenate([e0, ends], -1), np.concatenate([ends, e1], -1)
            g0, g1 = np.concatenate([g0, gaps], -1), np.concatenate([gaps, g1], -1)
        return int(unclear.any(1).argmax())

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

    def _to_box(self, box: Box, ends: np.ndarray) -> np.ndarray:
        some = ends[:, :, self._table_rows]
        return box.distance(some[0], some[1]) - self._radius[self._table_rows]

    def _own(self, ends: np.ndarray) -> np.ndarray:
        if not self._first.size:
            return np.zeros((0, ends.shape[-1]))
        first, second = ends[:, :, self._first], ends[:, :, self._second]
        distance = segment_distance(first[0], first[1], second[0], second[1])
        return distance - self._radius[self._first] - self._radius[self._second]

    def _gaps(self, ends: np.ndarray) -> np.ndarray:
        floor = ends[:, 2, self._table_rows].min(0) - self._radius[self._table_rows] - self._floor
        return np.concatenate([self._to_box(self._block, ends), self._own(ends), floor])

    def _chord(self, moved: np.ndarray) -> np.ndarray:
        """Longest chord (R, B) of any point of what a row is between, from the ends' ways (2, 3, n, B)."""
        alone = np.sqrt(np.einsum("exnb,exnb->enb", moved, moved).max(0))[self._table_rows]
        relative = moved[:, None, :, self._first] - moved[None, :, :, self._second]
        pairs = np.sqrt(np.einsum("efxnb,efxnb->efnb", relative, relative).max((0, 1)))
        return np.concatenate([alone, pairs, alone])

    def _bulge(self, dq: np.ndarray) -> np.ndarray:
        """Bounds (R, B) of a row's gap against that along the chords, for joints moving straight by dq (n, B)."""
        size = np.abs(dq) * self._hinge
        inner = np.cumsum(size, axis=0) - size
        bulge = self._levers @ (size * (size + 2.0 * inner)) / 8.0  # (capsules, B)
        alone = bulge[self._table_rows]
        return np.concatenate([alone, bulge[self._first] + bulge[self._second], alone])


def _transform_basis(joints: list[dict]) -> np.ndarray:
    """(n, 4, 16): every joint's 4 x 4 transform is the sum of these times 1, sin q, 1 - cos q and q (Rodrigues)."""
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
    return basis.reshape(len(joints), 4, 16)


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
