"""The robot's geometry without MuJoCo: the shipped file, gaps against the simulation's and MuJoCo's, and what is proven
about whole motions."""

from __future__ import annotations

import json

import jax
import mujoco
import numpy as np
import pytest

from mjx_tt.robot import clearance, geometry_export, mjcf, robots
from mjx_tt.robot.chain import chain_from_model
from mjx_tt.robot.kinematics import PaddleKinematics
from robot_io.limits import LIMITS
from robot_io.safety import clearance as shipped
from robot_io.safety.capsules import bound_bulges, box_distance, segment_distance
from robot_io.safety.clearance import GeometryError, RobotGeometry
from tests.support.clearances import clearances

LOWER, UPPER = np.array(LIMITS.lower)[:, None], np.array(LIMITS.upper)[:, None]
N = 2000


@pytest.fixture(scope="module")
def model():
    return mjcf.load_model()


@pytest.fixture(scope="module")
def ours():
    return RobotGeometry.load()


@pytest.fixture(scope="module")
def poses():
    """Joint positions (8, N) within the limits: half anywhere, half near the table's edge where both signs occur."""
    rng = np.random.default_rng(0)
    q = rng.uniform(LOWER, UPPER, (8, N))
    q[1, ::2] = LIMITS.upper[1]
    q[2, ::2] = rng.uniform(-1.0, 1.0, q[2, ::2].shape)
    return q


def simulated(model, poses):
    """The simulation's clearances in float64, each (N,)."""
    with jax.enable_x64(True):
        kinematics = PaddleKinematics(chain_from_model(model), mjcf.paddle_frame(model))
        gaps = clearance.CapsuleClearance(kinematics, mjcf.capsules(model), robots.paper().file)
        return jax.tree.map(np.asarray, jax.jit(lambda q: gaps(kinematics.links(q), q[0]))(poses))


@pytest.fixture(scope="module")
def mujocos(model, poses, ours):
    """MuJoCo's distances: of watched pairs of capsules and of capsules to the floor, both (rows, N)."""
    data, names = mujoco.MjData(model), [row.split(" to ") for row in ours.rows]
    pairs = [n for n, kind in zip(names, ours.kinds, strict=True) if kind == "self"]
    floor = [(n[0], "floor") for n, kind in zip(names, ours.kinds, strict=True) if kind == "floor"]
    found = np.empty((len(pairs) + len(floor), 300))
    for i in range(found.shape[1]):
        data.qpos[:] = poses[:, i]
        mujoco.mj_kinematics(model, data)
        for row, (a, b) in enumerate([*pairs, *floor]):
            found[row, i] = mujoco.mj_geomDistance(model, data, model.geom(a).id, model.geom(b).id, 5.0, None)
    return found[: len(pairs)], found[len(pairs) :]


def test_the_shipped_file_is_current():
    message = "run python -m mjx_tt.robot.geometry_export"
    assert geometry_export.path().read_text(encoding="utf-8") == geometry_export.text(robots.paper()), message


def test_home_is_the_models(model, ours):
    np.testing.assert_allclose(ours.home, mjcf.home_qpos(model), atol=1e-12)


def test_clearances_equal_the_simulations(model, ours, poses, monkeypatch):
    """Everywhere with the simulation's bisection carried to its end; as it is, at every capsule that does not reach so
    deep into the table that its axis nearly meets it: there it misses the nearest point by up to 0.15 mm."""
    found = clearances(ours, poses)
    shipped = simulated(model, poses)
    np.testing.assert_allclose(found["own"], shipped.own, rtol=0, atol=1e-6)
    for name in ("table", "blade"):
        near = getattr(shipped, name) - found[name]
        assert (near > -1e-12).all() and (near < 0.3 / 2**11).all()
        outside = found[name] > 0.0
        assert 100 < outside.sum() < N - 20 and (near[outside] < 1e-6).all()
    monkeypatch.setattr(clearance, "BISECTIONS", 45)
    converged = simulated(model, poses)
    for name in ("table", "own", "blade"):
        np.testing.assert_allclose(found[name], getattr(converged, name), rtol=0, atol=1e-6)


def test_gaps_equal_mujocos(ours, poses, mujocos):
    gaps = ours.gaps(poses[:, :300])
    for kind, wanted in zip(("self", "floor"), mujocos, strict=True):
        np.testing.assert_allclose(gaps[ours.kinds == kind], wanted, rtol=0, atol=1e-6)
        assert (wanted < 0).any() and (wanted > 0).any()


def test_the_space_under_the_table_belongs_to_the_table(ours, poses):
    blocked, top = ours.gaps(poses)[ours.kinds == "table"].min(0), clearances(ours, poses)["table"]
    assert (blocked <= top + 1e-12).all() and (blocked < top - 0.05).any()
    np.testing.assert_allclose(ours.gaps(ours.home[:, None])[ours.kinds == "table"].min(), 0.34, atol=1e-9)


def test_box_distance_against_dense_sampling():
    """Segments in all directions, along the axes, of no length, through the box and touching it."""
    rng = np.random.default_rng(1)
    low, high = np.array([-0.5, -1.0, -0.2]), np.array([0.5, 1.0, 0.1])
    p, q = rng.uniform(-2, 2, (2, 3, 1, 1500))
    along = rng.integers(0, 3, 1000)
    q[:, 0, :1000] = p[:, 0, :1000]
    q[along[:900], 0, np.arange(900)] += rng.uniform(-2, 2, 900)  # the last hundred stay points
    p[2, 0, 1000:1200] = q[2, 0, 1000:1200] = 0.1  # in the plane of the top
    s = np.linspace(0, 1, 2001)[:, None]
    points = p[:, 0, None] + s * (q - p)[:, 0, None]
    outside = points - np.clip(points, low[:, None, None], high[:, None, None])
    dense = np.sqrt((outside**2).sum(0).min(0))
    ends = np.ascontiguousarray(np.stack([p, q])[:, :, 0].transpose(0, 2, 1))
    found = np.array([box_distance(low, high, a, b) for a, b in zip(*ends, strict=True)])
    step = np.linalg.norm((q - p)[:, 0], axis=0) / 2000
    assert (found <= dense + 1e-12).all() and (dense - found <= step / 2 + 1e-12).all()
    clear = dense > 0.05  # there the nearest point is found to second order
    np.testing.assert_allclose(found[clear], dense[clear], atol=1e-5)
    assert (found == 0).sum() > 100


def test_segment_distance_by_hand():
    for points, wanted in (
        (([0, 0, 0], [1, 0, 0], [0.5, -1, 2], [0.5, 1, 2]), 2.0),  # crossing above
        (([0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]), 1.0),  # parallel, side by side
        (([0, 0, 0], [1, 0, 0], [2, 1, 0], [4, 3, 0]), np.sqrt(2)),  # end to end
        (([0, 0, 0], [0, 0, 0], [3, 4, 0], [3, 4, 0]), 5.0),  # points
    ):
        found = segment_distance(*(np.array(p, float) for p in points))
        assert found == pytest.approx(wanted, abs=1e-12)


def test_a_cleared_motion_is_clear_between_its_points(ours):
    """Straight ways near the table: whatever is cleared keeps its margin at hundreds of places between the points,
    where looking at the points alone would not have been enough; and what is clear by far is cleared."""
    rng = np.random.default_rng(2)
    margin, slack = np.full(len(ours.rows), 0.02), 5e-4
    start = rng.uniform(LOWER, UPPER, (8, 3000))
    start[1], start[2] = LIMITS.upper[1], rng.uniform(-1, 1, 3000)
    gaps = ours.gaps(start).min(0)
    start = start[:, (gaps > 0.02) & (gaps < 0.1)][:, :600]
    end = start + rng.uniform(-0.6, 0.6, start.shape)
    dips = cleared = missed = 0
    for a, b in zip(start.T, end.T, strict=True):
        way = np.linspace(a, b, 3).T
        if (ours.gaps(way).min(0) < 0.02).any():
            continue
        dense = ours.gaps(a[:, None] + np.linspace(0, 1, 401) * (b - a)[:, None]).min()
        if ours.first_too_close(way, margin, slack) is None:
            cleared += 1
            assert dense > 0.02 - slack
        else:
            missed += dense > 0.035
        dips += dense < 0.02 - slack
    assert dips > 3 and cleared > 80 and missed < 0.05 * cleared


def never_cleared(ours, a, b):
    """Number of gaps that are smaller on the straight way from a to b (8,) than at its ends. Each by itself, with a
    margin just above its smallest value, must be found too close."""
    gaps = ours.gaps(a[:, None] + np.linspace(0, 1, 1001) * (b - a)[:, None])
    rows = np.flatnonzero((gaps.min(1) < np.minimum(gaps[:, 0], gaps[:, -1]) - 0.01) & (gaps.min(1) > 0))
    for row in rows:
        margin = np.full(len(ours.rows), -1e3)
        margin[row] = gaps[row].min() + 1e-5
        assert ours.first_too_close(np.stack([a, b], axis=1), margin, 0.0) == row
    return len(rows)


@pytest.mark.parametrize("levels", [0, 5])
def test_a_whole_turn_is_not_taken_for_standing_still(ours, monkeypatch, levels):
    """Every point is where it was: its way is all curvature."""
    monkeypatch.setattr(shipped, "LEVELS", levels)
    rng = np.random.default_rng(4)
    turns = [(rng.uniform(LOWER, UPPER)[:, 0], joint) for joint in range(2, 8) for _ in range(10)]
    assert sum(never_cleared(ours, a, a + 2 * np.pi * np.eye(8)[joint]) for a, joint in turns) > 50


def test_no_point_leaves_its_chord_farther_than_allowed_for(ours):
    """Half way between two poses, where small motions leave it the farthest; the stretched arm folding up comes near
    the bound."""
    rng = np.random.default_rng(5)
    a = rng.uniform(LOWER, UPPER, (8, 3000))
    d = rng.uniform(-0.3, 0.3, a.shape) * rng.integers(0, 2, a.shape)
    a[:, 0], d[:, 0] = [0, 0, 0, 0, np.arctan(0.302 / 0.07), 0, 0, 0], [0, 0, 0, 0.1, 0.1, 0, 0, 0]
    away = ours.ends(a + d / 2) - 0.5 * (ours.ends(a) + ours.ends(a + d))
    away = np.linalg.norm(away, axis=-1).max(-1).T  # the farther end of each capsule
    allowed = np.array([bound_bulges(each, *ours._bounds) for each in np.ascontiguousarray(d.T)]).T
    assert (away <= allowed + 1e-12).all()
    assert (away / np.maximum(allowed, 1e-9))[:, 0].max() > 0.8


def test_passing_the_tables_corner_is_seen(ours, monkeypatch):
    """The gantry slides the arm past the corner at 45 degrees: nothing near a box dips more sharply."""
    monkeypatch.setattr(shipped, "LEVELS", 0)
    slide = np.array([1.0, 1.0, 0, 0, 0, 0, 0, 0])
    for bend in (1.8, 2.1, 2.4):
        low, high = 0.0, 3.0  # of x, where it touches and where it does not
        for _ in range(30):
            q = np.array([0.5 * (low + high), 0.0, 0.0, bend, 0.0, 0.0, 0.0, 0.0])
            gaps = ours.gaps(q[:, None] + np.linspace(-1, 1, 2001) * slide[:, None])[ours.kinds == "table"]
            low, high = (low, q[0]) if gaps.min() > 0.01 else (q[0], high)
        assert 0.0 < gaps.min() < 0.02
        closest = np.linspace(-1, 1, 2001)[gaps.min(0).argmin()]
        assert never_cleared(ours, q + (closest - 0.5) * slide, q + (closest + 0.5) * slide)


def test_what_is_inside_its_margin_must_not_lose_anything(ours):
    """Down to the table from 1 cm above it, and back up, with a margin of 2 cm."""
    margin = np.full(len(ours.rows), 0.02)
    q = above_the_table(ours, 0.010)
    row = int(ours.gaps(q[:, None])[:, 0].argmin())
    assert ours.first_too_close(np.stack([q, q], axis=1), margin, 5e-4) is None
    way = {sign: np.stack([q, q + sign * steepest(ours, q) * 0.002], axis=1) for sign in (1, -1)}
    assert ours.first_too_close(way[1], margin, 5e-4) is None
    assert ours.first_too_close(way[-1], margin, 5e-4) == row


def test_numbers_that_are_none_are_too_close(ours):
    way = np.stack([ours.home, np.where(np.arange(8) == 3, np.nan, ours.home)], axis=1)
    with np.errstate(invalid="ignore"):
        for part in (way, way[:, 1:]):
            assert ours.first_too_close(part, np.full(len(ours.rows), 0.02), 5e-4) is not None


def steepest(ours, q):
    """Direction (8,) of joint motion along which the smallest gap grows the fastest."""
    gaps = ours.gaps(q[:, None] + 1e-6 * np.concatenate([np.eye(8), -np.eye(8)], axis=1)).min(0)
    gradient = gaps[:8] - gaps[8:]
    return gradient / np.linalg.norm(gradient)


def above_the_table(ours, gap):
    """A pose (8,) whose smallest gap, to the table, is ``gap``: facing it, the shoulder bent as far as needed."""
    low, high = 0.0, 1.5
    for _ in range(50):
        q = np.array([0.0, 0.45, 0.0, 0.5 * (low + high), 0.0, 0.0, 0.1, 0.0])
        gaps = ours.gaps(q[:, None])[:, 0]
        low, high = (q[3], high) if gaps.min() > gap else (low, q[3])
    assert abs(gaps.min() - gap) < 1e-9 and ours.kinds[gaps.argmin()] == "table"
    return q


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("floor"), "keys are"),
        (lambda d: d.update(format=2), "format is 2, this program reads 1"),
        (lambda d: d["joints"].reverse(), "joints are .*the contract's are"),
        (lambda d: d["joints"][7].update(type="slide"), "slides must come before hinges"),
        (lambda d: d["joints"][2].update(type="ball"), "malformed"),
        (lambda d: d["capsules"][0].update(radius=float("nan")), "non-finite"),
        (lambda d: d["capsules"][0].update(p0=[1.0]), "malformed"),
        (lambda d: d["capsules"][0].update(joint="elbow"), "capsule is on a joint that is none of"),
        (lambda d: d["self_pairs"].append(["col_base", "col_nose"]), r"no capsules named \['col_nose'\]; it has"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, change, message):
    data = json.loads(geometry_export.path().read_text(encoding="utf-8"))
    change(data)
    file = tmp_path / "geometry.json"
    file.write_text(json.dumps(data))
    with pytest.raises(GeometryError, match=message):
        RobotGeometry.load(file)


def test_a_missing_or_broken_file_is_refused(tmp_path):
    with pytest.raises(GeometryError, match="cannot be read .* write it with python -m mjx_tt.robot.geometry_export"):
        RobotGeometry.load(tmp_path / "none.json")
    (tmp_path / "cut.json").write_text('{"format": 1, ')
    with pytest.raises(GeometryError, match="cut.json: cannot be read"):
        RobotGeometry.load(tmp_path / "cut.json")


def test_the_entry_point_compares(capsys, monkeypatch, tmp_path):
    assert geometry_export.main(["--check"]) == 0 and "is current" in capsys.readouterr().out
    monkeypatch.setattr(geometry_export, "path", lambda: tmp_path / "robot_geometry.json")
    assert geometry_export.main(["--check"]) == 1 and "not current" in capsys.readouterr().out
    assert geometry_export.main([]) == 0 and geometry_export.main(["--check"]) == 0
    assert geometry_export.main(["--chek"]) == 2
