"""Clearances from capsules against MuJoCo's own distances, over the robot's whole joint range."""

from __future__ import annotations

from itertools import combinations

import jax
import mujoco
import numpy as np
import pytest

from mjx_tt.robot import mjcf, robots
from mjx_tt.robot.chain import chain_from_model
from mjx_tt.robot.clearance import BISECTIONS, CapsuleClearance
from mjx_tt.robot.kinematics import PaddleKinematics
from robot_io.limits import LIMITS

N = 4000
MODEL = mjcf.load_model()
RADIUS = {c.name: c.radius for c in mjcf.capsules(MODEL)}
WATCHED = robots.paper().file
PAIRS = {frozenset(pair) for pair in WATCHED.pairs}

# Pairs that are left out, with the reason.
LEFT_OUT = {
    frozenset(pair): reason
    for reason, pairs in {
        "neighbours: they share a joint and always overlap or nearly so": [
            ("col_beam", "col_base"),
            ("col_base", "col_upper_arm"),
            ("col_upper_arm", "col_forearm"),
            ("col_forearm", "col_wrist"),
        ],
        "one rigid body": [
            ("col_wrist", "col_blade_axis"),
            ("col_wrist", "col_blade_cross"),
            ("col_blade_axis", "col_blade_cross"),
        ],
    }.items()
    for pair in pairs
}


@pytest.fixture(scope="module")
def poses():
    """Joint positions (8, N) within the limits: half anywhere, half near the table's edge where both signs occur."""
    rng = np.random.default_rng(0)
    q = rng.uniform(np.array(LIMITS.lower)[:, None], np.array(LIMITS.upper)[:, None], (8, N))
    q[1, ::2] = LIMITS.upper[1]  # close to the table
    q[2, ::2] = rng.uniform(-1.0, 1.0, q[2, ::2].shape)  # facing it
    return q


@pytest.fixture(scope="module")
def mujocos(poses):
    """MuJoCo's signed distance (N,) of every pair of collision geoms by the set of their names, and whether the axis of
    a capsule passes through the table, by its name."""
    names = [*RADIUS, "col_table"]
    geoms = {name: MODEL.geom(name).id for name in names}
    distances = {frozenset(pair): np.empty(N) for pair in combinations(names, 2)}
    pierced = {name: np.empty(N, bool) for name in WATCHED.table}
    data = mujoco.MjData(MODEL)
    for i in range(N):
        data.qpos[:] = poses[:, i]
        mujoco.mj_kinematics(MODEL, data)
        for (a, b), values in distances.items():
            values[i] = mujoco.mj_geomDistance(MODEL, data, geoms[a], geoms[b], 5.0, None)
        for name, values in pierced.items():
            geom = data.geom(name)
            half = geom.xmat.reshape(3, 3)[:, 2] * MODEL.geom(name).size[1]
            values[i] = meets_box(geom.xpos - half, 2 * half, data.geom("col_table").xpos, MODEL.geom("col_table").size)
    return distances, pierced


def meets_box(start, way, centre, half):
    """True where the segment meets the box: the intervals inside the three slabs overlap."""
    with np.errstate(divide="ignore"):
        a, b = (centre - half - start) / way, (centre + half - start) / way
    return max(np.minimum(a, b).max(), 0.0) <= min(np.maximum(a, b).min(), 1.0)


@pytest.fixture(scope="module")
def distances(mujocos):
    return mujocos[0]


@pytest.fixture(scope="module")
def clearances(poses):
    kinematics = PaddleKinematics(chain_from_model(MODEL), mjcf.paddle_frame(MODEL))
    clearance = CapsuleClearance(kinematics, mjcf.capsules(MODEL), WATCHED)
    q = poses.astype(np.float32)
    return jax.tree.map(np.asarray, jax.jit(lambda q: clearance(kinematics.links(q), q[0]))(q))


def smallest(distances, pairs):
    return np.min([distances[frozenset(pair)] for pair in pairs], axis=0)


def agree(ours, mujocos):
    """Equal to 0.1 mm, in contact and out of it; the same sign where a gap is not too small to tell."""
    np.testing.assert_allclose(ours, mujocos, rtol=0, atol=1e-4)
    clear = np.abs(mujocos) > 1e-4
    np.testing.assert_array_equal((ours <= 0)[clear], (mujocos <= 0)[clear])
    assert 20 < (mujocos < 0).sum() and 20 < (mujocos > 0).sum()


@pytest.mark.parametrize(("quantity", "capsules"), [("table", WATCHED.table), ("blade", WATCHED.blade)])
def test_clearance_of_the_table(clearances, mujocos, quantity, capsules):
    """MuJoCo's capsule-box distance is wrong, at times even positive, where the capsule's axis itself passes through
    the box (version 4.0.0); such poses are in contact by at least the capsule's radius."""
    distances, pierced = mujocos
    ours = getattr(clearances, quantity)
    through = np.any([pierced[name] for name in capsules], axis=0)
    agree(ours[~through], smallest(distances, [(name, "col_table") for name in capsules])[~through])
    assert 20 < through.sum()
    for name in capsules:
        assert (ours[pierced[name]] <= -RADIUS[name] + 0.3 / 2 ** (BISECTIONS + 1)).all()


def test_clearance_of_itself(clearances, distances):
    agree(clearances.own, smallest(distances, PAIRS))


def test_every_pair_that_can_touch_is_watched(distances):
    """Every pair of the arm's capsules is listed, or left out for a reason, or never touches."""
    pairs = {pair for pair in distances if "col_table" not in pair}
    assert not PAIRS & LEFT_OUT.keys() and PAIRS | LEFT_OUT.keys() <= pairs
    for pair in pairs - PAIRS - LEFT_OUT.keys():
        assert distances[pair].min() > 0.02, sorted(pair)
    for pair in PAIRS:
        assert distances[pair].min() < 0.0, f"{sorted(pair)} never touch and need not be watched"


def test_what_is_not_watched_against_the_table_never_reaches_it(distances):
    for name in ("col_beam", "col_base"):
        assert distances[frozenset((name, "col_table"))].min() > 0.03
