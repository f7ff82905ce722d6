"""The hidden-effect generator against closed forms and SciPy's integrator, the scoring, and a small fixed examination.

``make exam`` runs the large one (tests/exam/examination.py).
"""

from __future__ import annotations

import ast
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from tests.exam import baselines, examination
from tests.exam.generator import cases, held_out, human_strokes, robot, scoring
from tests.exam.generator.cases import EFFECTS, Case
from tests.exam.generator.invented_defects import INVENTED
from tests.exam.generator.json_lines import append, read_lines
from tests.exam.generator.sessions import INTERVAL, SIGMA, draw_balls, measure, shift, with_spin
from tests.exam.generator.world import World, camera, fly, seen
from tests.exam.generator.write import write
from tests.support.paths import ROOT

pytestmark = pytest.mark.optimised


def test_the_generator_imports_nothing_that_it_tests():
    sources = sorted((ROOT / "tests" / "exam" / "generator").glob("*.py"))
    assert len(sources) > 6
    for path in sources:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                allowed = ("tests.exam.generator", "tests.support.paths", "numpy", "scipy", "yaml", "mujoco")
                ok = name.split(".")[0] in sys.stdlib_module_names or name.startswith(allowed)
                assert ok, f"{path.name} imports {name}"


# --- the second physics ---------------------------------------------------------------------------------------------


WORLD = World(
    drag_coefficient=0.5,
    magnus_coefficient=0.7,
    spin_decay=0.2,
    buoyancy=0.01,
    gravity_x=0.1,
    wind_x=0.4,
    wind_y=-0.3,
    wind_z=0.2,
    restitution=0.9,
    restitution_slope=0.01,
    friction=0.2,
    height=0.004,
    tilt_x=0.02,
    tilt_y=-0.01,
)
START = np.array([0.1, 1.4, 0.3, -0.2, -5.5, 0.8, 60.0, -20.0, 30.0])


def scipy_path(world, start, times):
    """The same ball by DOP853 with an event: an adaptive method of order 8 and a root on its dense output."""
    k_d = world.drag_coefficient * world.air_density * world.area / (2 * world.mass)
    k_m = world.magnus_coefficient * world.air_density * world.area * world.radius / (2 * world.mass)
    weight = np.array([world.gravity_x, world.gravity_y, world.gravity_z]) * (1 - world.buoyancy)
    wind = np.array([world.wind_x, world.wind_y, world.wind_z])
    normal = np.array([-world.tilt_x, -world.tilt_y, 1.0])
    normal /= np.linalg.norm(normal)

    def f(t, s):
        u = s[3:6] - wind
        return np.r_[s[3:6], weight - k_d * np.linalg.norm(u) * u + k_m * np.cross(s[6:], u), -world.spin_decay * s[6:]]

    def touch(t, s):
        return (s[:3] - [0, 0, world.height]) @ normal - world.radius

    touch.terminal, touch.direction = True, -1
    first = solve_ivp(f, (0, 2), start, "DOP853", events=touch, dense_output=True, rtol=1e-12, atol=1e-13)
    s, contact = first.y[:, -1].copy(), first.t[-1]
    v, spin = s[3:6], s[6:]
    v_n = v @ normal
    slip = v - v_n * normal + np.cross(spin, -world.radius * normal)
    e = world.restitution - world.restitution_slope * abs(v_n)
    impulse = -min(world.friction * (1 + e) * abs(v_n) / np.linalg.norm(slip), 0.4) * slip
    s[3:6] = v - (1 + e) * v_n * normal + impulse
    # Torque of the impulse at -r n about the centre, over the shell's 2/3 m r^2.
    s[6:] = spin + np.cross(-world.radius * normal, impulse) / (2 / 3 * world.radius**2)
    second = solve_ivp(f, (contact, 2), s, "DOP853", dense_output=True, rtol=1e-12, atol=1e-13)
    return np.where(times < contact, first.sol(times)[:3], second.sol(times)[:3]), contact


def test_flight_and_bounce_agree_with_scipy():
    times = np.linspace(0.0, 0.6, 61)
    path, contact = scipy_path(WORLD, START, times)
    flight = fly(WORLD, START[:, None], 0.7)
    assert flight.bounce_time[0] == pytest.approx(contact, abs=1e-9)
    assert 0.2 < contact < 0.5
    np.testing.assert_allclose(flight.at(times[:, None])[..., 0], path, atol=1e-9)


def test_a_sticking_bounce_stops_the_contact_point():
    world = World(friction=5.0)
    flight = fly(world, START[:, None], 0.7)
    velocity, spin = flight.second[0, 3:6, 0], flight.second[0, 6:, 0]
    np.testing.assert_allclose((velocity + np.cross(spin, [0, 0, -world.radius]))[:2], 0.0, atol=1e-12)


def test_balls_are_independent_of_each_other():
    both = np.stack([START, START * 0.9], axis=1)
    world = replace(WORLD, restitution=np.array([0.9, 0.8]))
    together = fly(world, both, 0.6).second
    alone = fly(world.take(np.array([1])), both[:, 1:], 0.6).second
    np.testing.assert_array_equal(together[..., 1], alone[..., 0])


def test_camera_is_rotation_scale_and_distortion():
    angles = {"camera_rotation_x": 0.1, "camera_rotation_y": -0.2, "camera_rotation_z": 0.3}
    world = World(camera_scale=1.02, camera_distortion=0.01, **angles)
    points = np.random.default_rng(0).normal(size=(3, 50))
    turn = Rotation.from_euler("xyz", [0.1, -0.2, 0.3])  # extrinsic: about x first, z last
    wanted = 1.02 * turn.apply(points.T) * (1 + 0.01 * np.sum(points.T**2, axis=1, keepdims=True))
    np.testing.assert_allclose(camera(world, points), wanted.T, atol=1e-12)


def test_a_fast_clock_is_stronger_gravity():
    """Time stretched by c: a log of g / c^2, the start's velocity over c."""
    stamps = np.arange(60)[:, None] * INTERVAL
    stretched = seen(World(clock_rate=1.03), fly(World(), START[:, None], 0.6), stamps)
    slower = np.r_[START[:3], START[3:6] / 1.03, np.zeros(3)]
    start = np.r_[START[:6], np.zeros(3)]
    stretched = seen(World(clock_rate=1.03), fly(World(), start[:, None], 0.6), stamps)
    light = World(gravity_z=-9.81 / 1.03**2)
    np.testing.assert_allclose(stretched, seen(light, fly(light, slower[:, None], 0.6), stamps), atol=1e-7)


def test_the_trackers_filter_lags_a_straight_line_by_its_constant():
    still = World(gravity_z=0.0, drag_coefficient=0.0, smoothing=0.02)
    start = np.array([0.0, 1.0, 5.0, 1.0, -4.0, 2.0, 0.0, 0.0, 0.0])
    stamps = np.arange(50)[:, None] * INTERVAL
    path = seen(still, fly(still, start[:, None], 0.5), stamps)[..., 0]
    wanted = start[:3, None] + start[3:6, None] * (stamps[:, 0] - 0.02)
    np.testing.assert_allclose(path, wanted, atol=1e-9)


# --- cases ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cause", ["wind_x", "gravity_scale", "table_friction", "camera_rotation_x", "magnus"])
def test_a_case_has_the_size_that_it_says(cause):
    case = Case("single", (cause,), 10.0, "iid", 3, count=300)
    drawn = cases.build(case)
    assert 1e3 * np.median(shift(drawn.world, drawn.balls, np.random.default_rng(0))) == pytest.approx(10.0, rel=0.15)


def test_a_case_is_the_same_every_time():
    case = Case("pair", ("wind_x", "magnus"), 10.0, "range", 5, count=60)
    once = cases.build(case).log().position
    np.testing.assert_array_equal(cases.build(case).log().position, once)
    assert not np.array_equal(cases.build(replace(case, seed=6)).log().position, once)


def test_logs_are_what_a_camera_sees_of_a_days_play():
    rng = np.random.default_rng(1)
    balls = draw_balls(rng, 250)
    log = measure(World(), balls, "iid", rng)
    samples = np.isfinite(log.position[0]).sum(axis=0)
    assert samples.min() >= 50 and samples.max() <= 75
    assert 4 <= np.unique(balls.session).size <= 8
    assert balls.human.mean() == pytest.approx(0.7, abs=0.01)
    y = log.clean[1]
    assert np.nanmax(np.abs(y)) < 1.85
    ends = np.array([y[n - 1, i] for i, n in enumerate(samples)])
    assert np.all(ends[balls.human] < 0.0) and np.all(ends[~balls.human] > 0.0)
    for session in np.unique(balls.session):
        starts = log.time[0, balls.session == session]
        assert np.all(np.diff(starts) > 1.0)


@pytest.mark.parametrize("noise", ["iid", "ar1", "range", "causal", "tails", "along", "levels"])
def test_noise_has_its_spread_and_correlation(noise):
    rng = np.random.default_rng(2)
    balls = draw_balls(rng, 400)
    log = measure(World(), balls, noise, rng)
    error = log.position - log.clean
    inner = error[:, 10:45]
    good = np.abs(inner) < 0.02  # outliers aside
    spread = np.sqrt(np.nanmean(inner[good] ** 2))
    wanted = {"along": SIGMA * math.sqrt(2.0), "levels": SIGMA * math.sqrt(1.75)}.get(noise, SIGMA)
    assert spread == pytest.approx(wanted, rel=0.25)
    a, b = inner[:, 1:].ravel(), inner[:, :-1].ravel()
    both = np.isfinite(a) & np.isfinite(b) & (np.abs(a) < 0.02) & (np.abs(b) < 0.02)
    correlation = np.corrcoef(a[both], b[both])[0, 1]
    wanted = {"ar1": 0.7, "causal": math.exp(-INTERVAL / 0.02)}.get(noise, 0.0)
    assert correlation == pytest.approx(wanted, abs=0.04)
    lost = 1.0 - np.isfinite(log.position[0, :40]).mean()
    assert (0.05 < lost < 0.15) if noise == "range" else lost == 0.0


def test_every_effect_and_every_invention_can_be_drawn():
    assert len(INVENTED) >= 8
    for kind, names in (("single", EFFECTS), ("invented", INVENTED)):
        drawn = cases.draw(kind, len(names), 0, 10.0)
        assert {c.causes[0] for c in drawn} == set(names)
    for kind in ("invisible", "rare"):
        assert cases.build(replace(cases.draw(kind, 1, 0)[0], count=60)).amounts
    table = cases.build(replace(cases.draw("scattered", 1, 0)[0], count=60)).world
    assert table.restitution.std() > 0.005 and table.friction.std() > 0.01
    for case in cases.draw("triple", 30, 0):
        assert len(set(case.causes)) == 3
    with pytest.raises(ValueError, match="unknown kind 'doubles'; known are none"):
        cases.draw("doubles", 1, 0)


def test_the_truth_lies_apart_from_the_log(tmp_path):
    files, sealed, drawn = write(Case("single", ("wind_x",), 10.0, "iid", 3, count=40), tmp_path)
    assert [f.parent for f in files] == [tmp_path / "log"] and sealed.parent == tmp_path / "sealed"
    assert sorted(p.name for p in (tmp_path / "log").iterdir()) == ["ball.csv"]
    assert "wind" not in files[0].read_text()
    truth = json.loads(sealed.read_text())
    assert truth["parameters"] == {"ball.flight.wind_x": pytest.approx(drawn.world.wind_x)}
    rows = np.loadtxt(files[0], delimiter=",", skiprows=1, usecols=(1, 2, 3, 4, 5))
    log = drawn.log()
    first = rows[rows[:, 0] == 0]
    np.testing.assert_allclose(first[:, 2:], log.position[:, : len(first), 0].T, atol=1e-6)
    np.testing.assert_allclose(np.diff(first[:, 1]), INTERVAL, atol=2e-6)


# --- the robot's joints ---------------------------------------------------------------------------------------------


def steps(values, seconds=1.0):
    """A command that changes every second."""
    return np.arange(len(values)) * seconds, np.array(values, float)


def test_joint_responses_have_their_closed_forms():
    query = np.linspace(0.0, 2.9, 291)
    none = robot.Joint(0.0, 0.0)
    ramp = np.clip(query, 0.0, None)
    cases_ = {
        "pure": (none, [1, 1, 1], ramp),
        "delays": (robot.Joint(0.1, 0.05), [1, 1, 1], np.clip(query - 0.15, 0.0, None)),
        "gain, offset": (replace(none, velocity_gain=1.1, joint_offset=0.2), [1, 1, 1], 1.1 * ramp + 0.2),
        "lag": (replace(none, lag=0.2), [1, 1, 1], ramp - 0.2 * (1 - np.exp(-query / 0.2))),
        "limit": (replace(none, velocity_limit=0.4), [1, 1, 1], 0.4 * ramp),
        "acceleration": (
            replace(none, acceleration_limit=2.0),
            [1, 1, 1],
            np.where(query < 0.5, query**2, query - 0.25),
        ),
        "deadband": (replace(none, deadband=0.5), [0.4, 1, -1], np.clip(query - 1, 0, 1) - np.clip(query - 2, 0, 1)),
        "friction": (
            replace(none, coulomb_friction=0.3),
            [1, 0.2, -1],
            0.7 * np.clip(query, 0, 1) - 0.7 * np.clip(query - 2, 0, 1),
        ),
        "backlash": (
            replace(none, backlash=0.2),
            [1, -1, 0],
            np.where(query < 1.2, np.clip(query - 0.1, 0.0, 0.9), np.maximum(2.1 - query, 0.1)),
        ),
    }
    for name, (joint, values, wanted) in cases_.items():
        position = robot.respond(joint, *steps(values), query)
        np.testing.assert_allclose(position, wanted, atol=2e-3 if name != "pure" else 1e-9, err_msg=name)


def test_a_robot_case_changes_one_joint_only():
    case = Case("robot", ("joint_2.lag",), 0.0, "iid", 4)
    drawn = cases.build_robot(case)
    assert {n for n, j in drawn.joints.items() if j != robot.nominal(n)} == {"joint_2"}
    command, state = drawn.rows()
    assert {r[1] for r in command} == {r[1] for r in state} == set(robot.JOINTS)
    speeds = np.array([v for _, n, v in command if n == "joint_3"])
    assert 1.0 < np.abs(speeds).max() < 4.0
    gentle = cases.build_robot(Case("unexcited", ("joint_2.backlash",), 0.0, "iid", 4)).rows()[0]
    assert min(v for _, n, v in gentle if n == "joint_2") >= 0.0  # it never reverses


# --- held-out prediction, baselines, scoring --------------------------------------------------------------------------


def test_the_true_model_predicts_down_to_the_noise():
    case = Case("single", ("drag_coefficient",), 20.0, "iid", 3, count=80)
    drawn = cases.build(case)
    log = drawn.log()
    clean = replace(log, position=log.clean)
    true = held_out.Model(drawn.world, drawn.spin_mean, drawn.spin_std)
    assert np.nanmax(held_out.errors(true, clean, drawn.balls.human)) < 1e-5
    assert np.nanmedian(held_out.errors(held_out.nominal(), clean, drawn.balls.human)) > 5e-3


def test_known_spins_help_as_far_as_their_prior_does():
    rng = np.random.default_rng(4)
    balls = draw_balls(rng, 60)
    topspin = np.where(balls.human, 60.0, -60.0) * np.array([[1.0], [0.0], [0.0]])
    world = World(magnus_coefficient=0.6)
    log = measure(world, with_spin(balls, topspin), "iid", rng)
    clean = replace(log, position=log.clean)
    mean = np.array([60.0, 0.0, 0.0])
    assert np.nanmax(held_out.errors(held_out.Model(world, mean, np.zeros(3)), clean, balls.human)) < 1e-5
    fitted = held_out.errors(held_out.Model(world, 0 * mean, np.full(3, 1e4)), clean, balls.human)
    assert np.nanmedian(fitted) < 1e-3  # without noise even the early part tells the spin


def test_an_extended_model_is_read_by_its_paths(tmp_path):
    path = tmp_path / "extended.yaml"
    path.write_text(
        "ball: {flight: {wind_x: 0.2, integrator: midpoint}, table: {restitution: 0.9, tilt_x: 0.01}}\n"
        "sensing: {clock_rate: 1.01, ball_noise: 0.04}\nball_spin: {mean_x: 5.0, std_y: 2.0}\n"
        "latency: {abb_action: 0.1}\n"
    )
    model = held_out.load(path)
    assert model.world == World(wind_x=0.2, restitution=0.9, tilt_x=0.01, clock_rate=1.01)
    assert model.spin_mean.tolist() == [5, 0, 0] and model.spin_std.tolist() == [0, 2, 0]


def test_baselines_find_a_plain_effect_in_plain_noise():
    drawn = cases.build(Case("single", ("wind_x",), 20.0, "iid", 3, count=60))
    linear = baselines.linearise(drawn.log(), drawn.balls.human)
    assert baselines.best_single(linear) == baselines.bic(linear) == ("wind_x",)
    assert "wind_x" in baselines.lasso(linear) and "wind_x" in baselines.sindy(linear)
    assert "wind_x" in baselines.sysid(linear)
    drawn = cases.build(Case("none", (), 0.0, "iid", 3, count=60))
    linear = baselines.linearise(drawn.log(), drawn.balls.human)
    # Nothing but noise is left: 6 of about 186 directions of each ball are projected out.
    assert linear.residual.std() == pytest.approx(SIGMA * math.sqrt(1 - 6 / 186), rel=0.02)
    assert baselines.best_single(linear) == baselines.bic(linear) == ()


def test_nonlinear_baselines_fly_what_the_columns_say():
    drawn = cases.build(Case("single", ("wind_x",), 20.0, "iid", 3, count=60))
    linear, flights = baselines.both(drawn.log(), drawn.balls.human)
    np.testing.assert_allclose(flights.residual(("wind_x",), np.zeros(1)), linear.residual, atol=1e-12)
    little = 1e-4  # [m] of shift
    moved = flights.residual(("wind_x",), np.array([little])) - linear.residual
    column = -little * linear.columns[:, linear.names.index("wind_x")]
    assert np.corrcoef(moved, column)[0, 1] > 0.999 and moved.std() == pytest.approx(column.std(), rel=0.02)


def test_baselines_are_scored_as_the_diagnosis_is(monkeypatch):
    monkeypatch.setattr(baselines, "NONLINEAR", {"nobody": lambda linear, flights: ()})
    found = baselines.examine(Case("single", ("wind_x",), 20.0, "iid", 3, count=60))["outcomes"]
    assert found["best single"] == "right" and found["nobody"] == "missed"


@pytest.mark.slow
def test_nonlinear_baselines_find_a_plain_effect(monkeypatch):
    monkeypatch.setattr(baselines, "ITERATIONS", 4)
    monkeypatch.setattr(baselines, "NAMES", ("wind_x", "drag_coefficient", "table_height"))
    drawn = cases.build(Case("single", ("wind_x",), 20.0, "iid", 3, count=60))
    linear, flights = baselines.both(drawn.log(), drawn.balls.human)
    assert "wind_x" in baselines.mujoco(linear, flights)
    monkeypatch.setattr(baselines, "EVALUATIONS", 120)
    assert "wind_x" in baselines.cma_es(linear, flights)


def test_lookalikes_look_alike():
    drawn = cases.build(Case("none", (), 0.0, "iid", 1, count=60))
    linear = baselines.linearise(drawn.log(), drawn.balls.human)
    unit = linear.columns / np.linalg.norm(linear.columns, axis=0)
    for pair in cases.LOOKALIKES:
        a, b = (unit[:, linear.names.index(name)] for name in pair)
        assert abs(a @ b) > 0.97, pair
    a, b = (unit[:, linear.names.index(name)] for name in ("drag_coefficient", "wind_x"))
    assert abs(a @ b) < 0.5


def verdict(*groups, **rest):
    causes = [{"name": g[0], "group": list(g), "parameters": {}, "confidence": 0.9} for g in groups]
    return {"verdict": "named" if groups else "none", "causes": causes} | rest


def outcome(kind, causes, answer, twins=None):
    twins = {c: () for c in causes} if twins is None else twins
    truth = {"case": {"kind": kind, "causes": list(causes)}, "twins": twins, "parameters": {}, "spin": None}
    truth["lookalikes"] = {"wind_x": ["gravity_tilt_x"]}
    return scoring.score(truth, answer)["outcome"]


def test_scoring_of_answers():
    unexplained = {"verdict": "unexplained", "causes": []}
    assert outcome("single", ("wind_x",), verdict(("wind_x",))) == "right"
    assert outcome("single", ("air_density",), verdict(("drag_coefficient", "air_density"))) == "right"
    assert outcome("single", ("wind_x",), verdict(("wind_y",))) == "wrong"
    assert outcome("single", ("wind_x",), verdict(("wind_x",), ("wind_y",))) == "wrong"
    assert outcome("single", ("wind_x",), verdict(("wind_x", "a"), ("wind_x", "b"))) == "wrong"
    assert outcome("single", ("wind_x",), verdict()) == "missed"
    assert outcome("single", ("wind_x",), unexplained) == "flagged"
    assert outcome("pair", ("wind_x", "magnus"), verdict(("magnus",))) == "partly"
    assert outcome("pair", ("wind_x", "magnus"), verdict(("magnus",), ("wind_x",))) == "right"
    assert outcome("none", (), verdict()) == "right" and outcome("none", (), unexplained) == "flagged"
    assert outcome("none", (), verdict(("wind_x",))) == "wrong"
    assert outcome("invented", ("air_jet",), verdict(("wind_x",))) == "wrong"
    assert outcome("invented", ("air_jet",), unexplained) == "flagged"
    twins = {"ball_mass": ("drag_coefficient",)}
    assert outcome("deleted", ("ball_mass",), verdict(("drag_coefficient",)), twins) == "right"
    assert outcome("deleted", ("ball_mass",), verdict(("wind_y",)), twins) == "wrong"
    assert outcome("deleted", ("wind_x",), verdict(("gravity_tilt_x",))) == "right"
    assert outcome("single", ("wind_x",), verdict(("gravity_tilt_x",))) == "wrong"
    # A verdict that abstains names nothing, whatever it lists besides.
    assert outcome("single", ("wind_x",), verdict(("wind_y",)) | {"verdict": "undetermined"}) == "flagged"


def test_reliability_counts_names_by_their_confidence(tmp_path):
    def record(*confidences):
        case = {"kind": "single", "causes": ["wind_x"], "size_mm": 10.0}
        said = {"outcome": "right", "verdict": "named", "answer": "x", "twins": {}, "confidences": confidences}
        return {"case": case, "seconds": 1.0} | said

    records = [record([1.0, True])] * 9 + [record([0.9, True], [0.86, False]), record([1.0, False]), record()]
    middle, sure = scoring.reliability(records)
    assert (middle.confidence, middle.count, middle.true) == (pytest.approx(0.88), 2, 0.5)
    assert (sure.count, sure.true) == (10, 0.9) and sure.low < 0.9 < sure.high
    assert "| 1.000 | 10 | 0.900 |" in examination.summarise(records, {}, [], tmp_path)
    assert (tmp_path / "reliability.png").read_bytes().startswith(b"\x89PNG")
    truth = {"case": {"kind": "pair", "causes": ["wind_x", "magnus"]}, "twins": {}, "lookalikes": {}, "parameters": {}}
    scored = scoring.score(truth | {"spin": None}, verdict(("wind_x",), ("wind_y",)))
    assert scored["confidences"] == [[0.9, True], [0.9, False]]


def test_scoring_of_parameters():
    truth = {"parameters": {"ball.flight.wind_x": 0.2, "ball.flight.mass": 0.003}, "spin": None}
    wind = {"nominal": 0.0, "estimate": 0.19, "low": 0.17, "high": 0.21, "unit": "m/s"}
    mass = {"nominal": 0.0027, "estimate": 0.0029, "low": 0.0028, "high": 0.00295, "unit": "kg"}
    answer = {"causes": [{"parameters": {"ball.flight.wind_x": wind, "mass": mass}}]}
    found = scoring.parameter_errors(truth, answer)
    assert found["ball.flight.wind_x"]["error"] == pytest.approx(0.05) and found["ball.flight.wind_x"]["covered"]
    assert found["ball.flight.mass"]["error"] == pytest.approx(1 / 3) and not found["ball.flight.mass"]["covered"]


@pytest.mark.parametrize("hits, total", [(0, 10), (3, 10), (10, 10), (95, 100)])
def test_clopper_pearson_is_scipys(hits, total):
    wanted = binomtest(hits, total).proportion_ci(0.95, "exact")
    np.testing.assert_allclose(scoring.clopper_pearson(hits, total), (wanted.low, wanted.high), atol=1e-9)


def test_the_table_counts_against_the_bars():
    def record(kind, outcome, size=10.0, **more):
        case = {"kind": kind, "causes": ["wind_x"], "size_mm": size}
        return {"case": case, "outcome": outcome, "verdict": "named", "answer": "x", "twins": {}, "seconds": 1.0} | more

    records = [record("single", "right")] * 19 + [record("single", "missed")] + [record("single", "wrong", 5.0)]
    rows = {row.test: row for row in scoring.table(records)}
    at_ten, at_five = rows["one effect, 10 mm: right group"], rows["one effect, 5 mm: right group"]
    assert (at_ten.cases, at_ten.figure, at_ten.met) == (20, 0.95, True)
    assert (at_five.cases, at_five.figure, at_five.met) == (1, 0.0, False)
    assert rows["pairs: exact set"].met is None
    assert scoring.confusion(records) == {"wind_x": {"x": 21}}


def test_an_examination_goes_on_where_it_was(tmp_path):
    path = tmp_path / "cases.jsonl"
    path.write_text('{"key": "a"}\n{"key": "b"}\n{"key": "c", "ca')
    assert [r["key"] for r in read_lines(path)] == ["a", "b"]
    append(path, {"key": "d"})
    assert [r["key"] for r in read_lines(path)] == ["a", "b", "d"]
    plan = examination.plan(["1", "2", "8"], 20, 0)
    assert plan == examination.plan(["1", "2", "8"], 20, 0)
    assert {c.kind for c in plan[:8]} == {"none", "noise", "single", "invented"}  # the kinds take turns
    assert len({c.name for c in plan}) == len(plan) == 70
    with pytest.raises(SystemExit):
        examination.main(["--bars", "99", "--out", str(tmp_path)])
    assert examination.by_itself(lambda: {"a": 1}) == {"a": 1}
    assert "not there" in examination.by_itself(lambda: Path("/not there").read_text())["error"]
    with pytest.raises(SystemExit):
        examination.main(["--part", "3/2", "--out", str(tmp_path)])


PEOPLE = pytest.mark.skipif(not human_strokes.DATA.exists(), reason=f"strokes are absent: {human_strokes.DATA}")


@PEOPLE
def test_people_play_as_they_were_measured():
    drawn = cases.build(Case("human_none", (), 0.0, "iid", 3, count=120))
    assert drawn.world.magnus_coefficient == cases.MAGNUS and len(drawn.balls) == 120
    flight = fly(drawn.world, drawn.balls.start, 0.7)
    assert np.all(np.isfinite(flight.bounce_time)) and np.all(flight.bounce_state[1] < 0.0)
    median = np.median(np.linalg.norm(drawn.balls.start[6:], axis=0))
    assert 40.0 < median < 70.0, "of all strokes in the data it is 54 rad/s"
    many = cases.draw("many", 20, 5)
    assert {len(c.causes) for c in many} <= set(range(2, 9)) and all(len(set(c.causes)) == len(c.causes) for c in many)
    assert all("magnus" not in c.causes for c in cases.draw("human_single", 40, 1, 10.0))


def test_bounces_far_off_stay_in_their_ranges():
    worlds = [cases.build(case).world for case in cases.draw("bounce", 40, 5)]
    restitution, friction = (np.array([getattr(w, name) for w in worlds]) for name in ("restitution", "friction"))
    assert 0.75 <= restitution.min() < 0.78 and 0.88 < restitution.max() <= 0.91
    assert 0.08 <= friction.min() < 0.13 and 0.37 < friction.max() <= 0.42 and np.all(abs(friction - 0.25) >= 0.03)


# --- a small examination, fixed in time: the command line answers, then the seal is opened ----------------------------


SLOW = pytest.mark.slow
MORE = (SLOW,)


def unmet(today: str):
    """Marks a case that the diagnosis does not solve; once it does, the test fails until this is removed."""
    return (SLOW, pytest.mark.xfail(strict=True, reason=f"open: today the diagnosis answers {today}"))


PEOPLE = pytest.mark.skipif(
    not human_strokes.DATA.exists(), reason=f"measured strokes are absent: {human_strokes.DATA}"
)
FIXED = [
    pytest.param(Case("none", (), 0.0, "ar1", 11, count=200), ("right",), marks=SLOW),
    pytest.param(Case("single", ("wind_x",), 20.0, "range", 13, count=200), ("right",), marks=MORE),
    pytest.param(Case("single", ("drag_coefficient",), 20.0, "ar1", 14, count=200), ("right",), marks=SLOW),
    pytest.param(Case("single", ("table_friction",), 20.0, "causal", 15, count=200), ("right",), marks=MORE),
    pytest.param(Case("invented", ("air_jet",), 20.0, "iid", 17, count=200), ("flagged",), marks=SLOW),
    pytest.param(
        Case("deleted", ("table_friction",), 20.0, "iid", 18, without=("table_friction",), count=100),
        ("flagged",),
        marks=SLOW,
    ),
    # Its exact twins were cleared by an instrument.
    pytest.param(
        Case("single", ("air_density",), 20.0, "iid", 21, ("drag_coefficient", "ball_mass", "ball_radius"), 200),
        ("right",),
        marks=SLOW,
    ),
    pytest.param(Case("human_none", (), 0.0, "ar1", 31, count=200), ("right",), marks=[SLOW, PEOPLE]),
    pytest.param(
        Case("human_single", ("table_height",), 10.0, "iid", 32, count=100), ("right",), marks=[*MORE, PEOPLE]
    ),
    pytest.param(Case("human_single", ("wind_z",), 20.0, "range", 33, count=200), ("right",), marks=[*MORE, PEOPLE]),
    pytest.param(
        Case("human_pair", ("drag_coefficient", "table_tilt_x"), 20.0, "ar1", 34, count=200),
        ("right",),
        marks=[SLOW, PEOPLE],
    ),
    # It changes drag and lift alike: one cause, not two.
    pytest.param(
        Case("human_single", ("ball_mass",), 20.0, "iid", 35, count=200),
        ("right",),
        marks=[*unmet("another name"), PEOPLE],
    ),
    pytest.param(Case("kalman", (), 0.0, "iid", 41, count=200), ("right",), marks=MORE),
    # What its filter leaves along a flight is no finding; a wind beside it still is.
    pytest.param(Case("kalman", (), 0.0, "iid", 1792730053), ("right",), marks=MORE),
    pytest.param(Case("kalman", ("wind_x",), 10.0, "ar1", 9001), ("right",), marks=unmet("unexplained")),
    # Balls that spin fast would explain more of what it did behind the bounce than a filter of the catalogue.
    pytest.param(Case("kalman", (), 0.0, "causal", 1212613227), ("right",), marks=unmet("unexplained")),
    # Three causes that undo each other were named for a filter, each larger than the error on unseen balls.
    pytest.param(Case("kalman", (), 0.0, "causal", 424983216), ("right", "flagged"), marks=SLOW),
    # A filter blurs a bounce as balls would that spin a little, by a lift that no ball has.
    pytest.param(
        Case("bounce", ("table_restitution", "table_friction"), 0.0, "causal", 1232228224, count=60),
        ("right",),
        marks=SLOW,
    ),
    # Four ordinary causes, one of them of a millimetre or two: too small for a name, and no pattern without one.
    pytest.param(
        Case(
            "many", ("table_friction", "table_height", "tracker_smoothing", "drag_coefficient"), 0.0, "range", 279622570
        ),
        ("partly", "right"),
        marks=SLOW,
    ),
    (Case("robot", ("joint_2.lag",), 0.0, "iid", 19), ("right",)),
    pytest.param(Case("unexcited", ("joint_3.acceleration_limit",), 0.0, "iid", 22), ("right",), marks=SLOW),
    (Case("robot_none", (), 0.0, "iid", 20), ("right",)),
]


@pytest.mark.parametrize("case, accepted", FIXED, ids=lambda v: v.name if isinstance(v, Case) else "")
def test_hidden_cases(case, accepted, tmp_path):
    record = examination.examine(case, tmp_path)
    assert record["outcome"] in accepted, record
    assert record.get("declared", True), "what the log does not show is said"
