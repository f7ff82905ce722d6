"""The rig's world against closed forms, the independent calculation in ``ball_flight`` and MuJoCo's own model."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_io.contract import JOINT_NAMES
from robot_io.emulator.opponent import Thrower, Throws
from robot_io.emulator.world import BALL_RADIUS, PARKED, World, WorldParams
from robot_io.limits import LIMITS
from tests.oracles import ball_flight
from tests.oracles.ball_flight import Touch
from tests.support.paths import SCENE

STILL = np.zeros(8)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def shared():
    return World(SCENE)


@pytest.fixture
def world(shared):
    shared.reset()
    return shared


def spin_of(world):
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, world.data.qpos[world._ball_q + 3 : world._ball_q + 7])
    return rotation.reshape(3, 3) @ world.data.qvel[world._ball_v + 3 : world._ball_v + 6]


def impact(world, setpoint=STILL):
    """The ball's velocity (3,) [m/s] before its first touch, which is over then."""
    before = world.ball_velocity
    while not world.touches:
        before = world.ball_velocity
        world.advance(setpoint, 0.0005)
    while world._touching:
        world.advance(setpoint, 0.0005)
    return before


def fly(world, seconds, step=0.001):
    """(n, 7): time, position and velocity after each step."""
    rows = []
    for _ in range(round(seconds / step)):
        world.advance(STILL, step)
        rows.append([world.time, *world.ball, *world.ball_velocity])
    return np.array(rows)


@pytest.mark.parametrize("velocity", [(0.3, -6.0, 2.0), (-1.0, -15.0, 3.0), (0.0, -1.0, 4.0)])
def test_free_flight_equals_an_adaptive_integration(world, velocity):
    start = Touch(0.0, np.array([0.1, 3.0, 1.5]), np.array(velocity), np.zeros(3))
    world.throw(start.position, start.velocity)
    rows = fly(world, 0.3)
    expected = ball_flight.path(start, rows[:, 0])
    # The integrator is of first order: half a step of gravity and drag.
    deceleration = 9.81 + 0.141 * np.dot(velocity, velocity)
    np.testing.assert_allclose(rows[:, 1:4], expected.T, rtol=0, atol=0.6 * 0.001 * deceleration * 0.3)


def test_drag_slows_down_as_in_the_closed_form(world):
    """Against drag alone, v = v0 / (1 + K v0 t); gravity is left out of the model for it."""
    world.model.opt.gravity[:] = 0.0
    try:
        world.throw([0.0, 3.0, 2.0], [0.0, -20.0, 0.0])
        rows = fly(world, 0.25)
    finally:
        world.model.opt.gravity[2] = -9.81
    np.testing.assert_allclose(rows[:, 5], -20.0 / (1 + 0.141 * 20.0 * rows[:, 0]), rtol=1e-3)


def test_magnus_pushes_across_spin_and_velocity():
    world = World(SCENE, WorldParams(magnus=0.005))
    world.throw([0.0, 3.0, 2.0], [0.0, -10.0, 0.0], [100.0, 0.0, 0.0])
    world.advance(STILL, 0.02)
    # spin x velocity of a ball with backspin points down: (100, 0, 0) x (0, -10, 0) = (0, 0, -1000).
    lift = (world.ball_velocity[2] + 9.81 * 0.02) / 0.02
    assert lift == pytest.approx(0.005 * -1000.0, rel=0.06)  # drag has taken 3 % of the speed
    world.throw([0.0, 3.0, 2.0], [0.0, -10.0, 0.0], [0.0, 0.0, 100.0])
    for _ in range(20):  # a quarter turn and more
        world.advance(STILL, 0.001)
    assert world.ball_velocity[0] / 0.02 == pytest.approx(0.005 * 1000.0, rel=0.06)
    np.testing.assert_allclose(spin_of(world), [0.0, 0.0, 100.0], atol=1e-6)


@pytest.mark.parametrize("down", [0.7, 2.0, 5.0, 8.0])
@pytest.mark.parametrize("along", [0.0, -1.0, -6.0, -14.0])
@pytest.mark.parametrize("spin", [0.0, 150.0, -150.0])
def test_bounce_on_the_table(world, down, along, spin):
    velocity, omega = np.array([0.2 * along, along, -down]), np.array([spin, 0.3 * spin, 20.0])
    world.throw([0.1, -0.3, BALL_RADIUS + 0.012 * down], velocity, omega)
    before = impact(world)
    expected, turned = ball_flight.bounce(
        before, omega, UP, 0.93, lambda v, s: min(0.25 * 1.93 * v / s, 0.4) if s > 1e-9 else 0.0
    )
    assert world.touches[0][1] == "col_table" and len(world.touches) == 1
    # A contact of 2 ms, in which gravity and drag go on.
    np.testing.assert_allclose(world.ball_velocity[2], expected[2], rtol=0.015, atol=0.03)
    np.testing.assert_allclose(world.ball_velocity[:2], expected[:2], rtol=0.02, atol=0.06)
    np.testing.assert_allclose(spin_of(world), turned, rtol=0.02, atol=4.0)


def blade(world):
    site = world.data.site("paddle")
    return site.xpos.copy(), site.xmat.reshape(3, 3)[:, 2].copy()


@pytest.mark.parametrize("speed, tolerance", [(3.0, 0.08), (5.0, 0.035), (9.0, 0.15)])
@pytest.mark.parametrize("across", [0.0, 1.5])
def test_impact_on_the_resting_paddle(world, speed, tolerance, across):
    """The world's restitution is constant, the rubber's falls with the speed: they agree at 5 m/s.

    Where within a time step the contact begins changes a single bounce by up to 3 %.
    """
    centre, normal = blade(world)
    side = np.cross(normal, [1.0, 0.0, 0.0])
    velocity, spin = -speed * normal + across * side, np.array([30.0, 0.0, 0.0])
    world.throw(centre + 0.08 * normal - across / speed * 0.054 * side, velocity, spin)
    before = impact(world)
    assert world.touches[0][1] == "rig_paddle"
    e = ball_flight.RUBBER_E - ball_flight.RUBBER_SLOPE * abs(before @ normal)
    expected, turned = ball_flight.bounce(before, spin, normal, e, lambda v, s: ball_flight.RUBBER_GAIN)
    assert world.ball_velocity @ normal == pytest.approx(expected @ normal, rel=tolerance, abs=0.03)
    tangential = world.ball_velocity - (world.ball_velocity @ normal) * normal
    np.testing.assert_allclose(tangential, expected - (expected @ normal) * normal, atol=0.08)
    np.testing.assert_allclose(spin_of(world), turned, atol=5.0)


def test_restitution_does_not_depend_on_the_rhythm_of_the_calls(world):
    """Mean over several beginnings of the contact, at three lengths of a call."""
    centre, normal = blade(world)
    for call in (0.004, 4 / 3000, 8 / 3000):
        speeds = []
        for phase in range(8):
            world.reset()
            world.throw(centre + (0.04 + 0.005 * phase / 8) * normal, -5.0 * normal)
            while not world.touches or world._touching:
                world.advance(STILL, call)
            speeds.append(world.ball_velocity @ normal / 5.0)
        assert np.mean(speeds) == pytest.approx(0.81, abs=0.015) and np.ptp(speeds) < 0.07


def test_a_moving_paddle_adds_its_speed(world):
    """Seen from the blade the impact is that of a resting one."""
    setpoint = np.zeros(8)
    setpoint[1] = 1.0  # the carriage along y
    world.advance(setpoint, 0.2)
    centre, normal = blade(world)
    moving = np.array([0.0, world.qvel[1], 0.0])
    world.throw(centre + 0.08 * normal + moving * 0.01, -4.0 * normal + moving)
    before = impact(world, setpoint)
    expected, _ = ball_flight.bounce(before - moving, np.zeros(3), normal, 0.81, lambda v, s: ball_flight.RUBBER_GAIN)
    np.testing.assert_allclose(world.ball_velocity - moving, expected, atol=0.12)


def test_fast_balls_do_not_pass_through(world):
    world.throw([0.0, -0.3, 0.5], [0.0, -3.0, -25.0])
    fly(world, 0.1)
    assert [name for _, name, _ in world.touches] == ["col_table"] and world.ball_velocity[2] > 10
    centre, normal = blade(world)
    world.throw(centre + 0.5 * normal, -25.0 * normal)
    fly(world, 0.05)
    assert "rig_paddle" in [name for _, name, _ in world.touches]
    world.throw([0.0, 0.6, 0.08], [0.0, -25.0, 0.0])
    fly(world, 0.1)
    assert [name for _, name, _ in world.touches][0] == "net" and world.ball[1] > 0


def test_the_robot_moves_as_mujocos_own_model_does(world):
    model = mujoco.MjModel.from_xml_path(str(SCENE))
    model.opt.timestep = 0.001
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    rows = [model.joint(name).qposadr[0] for name in JOINT_NAMES]
    drives = [model.actuator(name).id for name in JOINT_NAMES]
    random = np.random.default_rng(2)
    for _ in range(40):
        setpoint = 0.15 * np.array(LIMITS.velocity) * random.uniform(-1, 1, 8)
        data.ctrl[drives] = setpoint
        world.advance(setpoint, 0.02)
        for _ in range(20):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(world.qpos, data.qpos[rows], rtol=0, atol=1e-9)
    assert np.abs(world.qpos - world.home).max() > 0.05 and world.collisions == 0


def test_drives_reach_their_set_points(world):
    for joint, top in enumerate(LIMITS.velocity):
        world.reset()
        setpoint = np.zeros(8)
        setpoint[joint] = 0.1 * top
        world.advance(setpoint, 0.25)
        np.testing.assert_allclose(world.qvel, setpoint, atol=0.006 * 0.1 * top + 1e-3)


def test_reset_is_exact_and_everything_is_deterministic(world):
    def play():
        world.reset()
        random, rows = np.random.default_rng(5), []
        world.throw([0.2, 1.2, 0.5], [0.1, -6.0, 0.5], [50.0, -20.0, 10.0])
        for _ in range(250):
            world.advance(0.3 * random.uniform(-1, 1, 8), 0.004)
            rows.append(world.data.qpos.tobytes() + world.data.qvel.tobytes())
        return rows, [(t, name, p.tobytes()) for t, name, p in world.touches], world.number, world.time

    first = play()
    world.advance(np.full(8, 0.2), 0.1)
    assert play() == first
    assert World(SCENE).data.qpos.tobytes() == (world.reset() or world.data.qpos.tobytes())
    assert first[2] == 1 and first[3] == pytest.approx(1.0)


def test_a_ball_waits_out_of_sight_until_it_is_thrown_and_after_it_has_fallen(world):
    world.advance(STILL, 0.5)
    assert not world.in_play
    np.testing.assert_allclose(world.ball, PARKED, atol=1e-4)
    world.throw([1.2, -0.5, 0.3], [0.0, 0.0, 0.0])
    fly(world, 0.6, 0.01)
    assert not world.in_play and np.abs(world.ball_velocity).max() < 0.02
    np.testing.assert_allclose(world.ball, PARKED, atol=1e-4)
    np.testing.assert_allclose(world.qpos, world.home, atol=1e-4)


def test_a_robot_in_the_table_is_counted(world):
    """By MuJoCo's own distances of the capsules to the table."""
    capsules = [i for i in range(world.model.ngeom) if world.model.geom(i).conaffinity[0]]
    table, random, found = world.model.geom("col_table").id, np.random.default_rng(0), []
    for _ in range(60):
        world.reset()
        world.data.qpos[world._q] = random.uniform(LIMITS.lower, LIMITS.upper)
        mujoco.mj_forward(world.model, world.data)
        gaps = [mujoco.mj_geomDistance(world.model, world.data, i, table, 1.0, None) for i in capsules]
        if abs(min(gaps)) > 1e-3:
            world.advance(STILL, 1e-5)
            found.append((min(gaps) < 0, world.collisions > 0))
    assert len(capsules) >= 3 and {(True, True), (False, False)} == set(found)


def test_thrower_waits_for_robot_and_ball(world):
    throws = Throws(*[np.array([[0.1, 0.2], [1.2, 1.3], [0.5, 0.6]])] * 2, np.zeros((3, 2)))
    thrower, thrown = Thrower(throws, pause=0.1, first=1), []
    for i in range(300):
        world.advance(STILL, 0.004)
        thrower.update(world, world.time)
        if thrower.thrown > len(thrown):
            thrown.append((i, world.ball))
            np.testing.assert_array_equal(world.ball_velocity, world.ball)
        if i == 100:
            world.park()
        if i == 200:
            world.park()
            world.data.qpos[world._q[0]] += 0.06  # not at home
    assert [i for i, _ in thrown] == [25, 126]
    np.testing.assert_array_equal([x for _, x in thrown], [[0.2, 1.3, 0.6], [0.1, 1.2, 0.5]])
    with pytest.raises(ValueError, match=r"throws: position \(3,\)"):
        Throws(np.zeros(3), np.zeros(3), np.zeros(3))
