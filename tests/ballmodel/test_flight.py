"""Flight of the ball against closed forms, conserved quantities and an adaptive ODE solver."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ballmodel import constants as c
from ballmodel.aerodynamics import SATURATING_LIFT, FlightParams
from ballmodel.contact import PaddleParams, SurfaceParams
from ballmodel.flight import PaddlePose, ball_params, free_step, step
from ballmodel.partial_params import without_nominal
from ballmodel.state import ball_state

VACUUM = FlightParams(drag_coefficient=0.0)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def fly(params, state, dt, n):
    return jax.lax.fori_loop(0, n, lambda _, s: free_step(params, s, dt), state)


def run(params, state, dt, n, paddle=None):
    """States after n steps of the full simulation, and whether table, net and paddle were ever touched."""

    def advance(carry, _):
        state, touched = carry
        new, events = step(params, state, dt, paddle)
        return (new, touched | jnp.stack([events.table, events.net, events.paddle])), None

    touched = jnp.zeros((3, *state.position.shape[1:]), bool)
    return jax.lax.scan(advance, (state, touched), None, length=n)[0]


def reference(p, position, velocity, spin, time):
    """The equation of motion by DOP853 on plain NumPy; place and spin at the end."""
    per_area = 1.29 * 1.256e-3 / (2 * 0.0027)
    weight = np.array([p.gravity_x, p.gravity_y, p.gravity_z]) * (1 - p.buoyancy)

    def derivative(t, y):
        u, omega = y[3:6] - [p.wind_x, p.wind_y, p.wind_z], y[6:]
        speed = np.linalg.norm(u)
        lift = p.magnus_coefficient / (1 + p.lift_saturation * 0.02 * np.linalg.norm(omega) / speed)
        force = per_area * (lift * 0.02 * np.cross(omega, u) - p.drag_coefficient * speed * u)
        return np.concatenate([y[3:6], weight + force, -p.spin_decay * omega])

    start = [*position, *velocity, *spin]
    end = solve_ivp(derivative, (0, time), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return end[:3], end[6:]


def test_converges_to_the_differential_equation_at_the_order_of_its_integrator():
    position, velocity, spin = np.array([0.2, 1.5, 0.3]), np.array([0.8, -7.0, 2.0]), np.array([60.0, 20.0, -40.0])
    air = {"wind_x": 0.7, "wind_y": -0.4, "wind_z": 0.2, "buoyancy": 0.0149, "gravity_x": 0.3, "gravity_y": -0.2}
    for integrator, order in (("paper", 1), ("midpoint", 2)):
        params = FlightParams(**SATURATING_LIFT, **air, spin_decay=0.4, integrator=integrator)
        exact, spun = reference(params, position, velocity, spin, 0.5)
        state = ball_state(position, velocity, spin)
        coarse, fine = (fly(params, state, 0.5 / n, n) for n in (150, 300))
        errors = [np.linalg.norm(end.position - exact) for end in (coarse, fine)]
        assert errors[0] / errors[1] == pytest.approx(2.0**order, rel=0.1) and errors[1] < 0.01
        np.testing.assert_allclose(fine.spin, spun, rtol=1e-9)


def test_lift_saturates_with_the_spin_ratio():
    lift = SATURATING_LIFT["magnus_coefficient"] * 0.4 / (1.0 + SATURATING_LIFT["lift_saturation"] * 0.4)
    assert lift == pytest.approx(0.4 / (0.55 + 3.55 * 0.4))


def test_the_papers_step_is_the_papers_formula():
    v = np.array([0.5, -6.0, 1.0])
    a = np.array([0, 0, -9.81]) - 0.47 * 1.29 * 1.256e-3 / (2 * 0.0027) * np.linalg.norm(v) * v
    dt = 1 / 300
    state = free_step(FlightParams(), ball_state(np.zeros(3), v), dt)
    np.testing.assert_allclose(state.position, dt * (v + dt * a / 2), rtol=1e-14)
    np.testing.assert_allclose(state.velocity, v + dt * a, rtol=1e-14)


def test_ball_dropped_from_30_cm_rebounds_23_cm():
    params = replace(ball_params(), flight=VACUUM, table=SurfaceParams(0.876, 0.0, 0.25, 0.0))
    drop = 0.30
    fall, rise = np.sqrt(2 * drop / 9.81), 0.876 * np.sqrt(2 * drop / 9.81)
    start = ball_state(np.array([0.1, -0.5, c.BALL_RADIUS + drop]), np.zeros(3))
    state, touched = run(params, start, (fall + rise) / 100, 100)
    assert bool(touched[0])
    assert float(state.position[2]) - c.BALL_RADIUS == pytest.approx(drop * 0.876**2, rel=1e-9)
    assert drop * 0.876**2 == pytest.approx(0.23, abs=0.001)


def test_a_bounce_does_not_depend_on_where_in_the_step_it_falls():
    params = replace(ball_params(), flight=VACUUM)
    n = 97
    shift = np.arange(n) / n / 300
    v = np.array([0.3, -4.0, -2.0])[:, None] + np.zeros((3, n))
    start = np.array([0.0, -0.2, 0.3])[:, None]
    # The same flight, joined a fraction of a step later.
    g = np.array([0, 0, -9.81])[:, None]
    state = ball_state(start + v * shift + 0.5 * g * shift**2, v + g * shift)
    end, touched = run(params, state, 1 / 300, 60)
    assert bool(touched[0].all())
    back = -shift
    position = end.position + end.velocity * back[None] + 0.5 * g * back[None] ** 2
    np.testing.assert_allclose(position, position[:, :1] + np.zeros((3, n)), atol=1e-11)


@pytest.mark.parametrize("speed", [3.0, 14.0, 35.0])
def test_no_ball_passes_through_the_net(speed):
    n = 101
    y = 0.2 + np.arange(n) / n * speed / 300
    state = ball_state(np.stack([0 * y, y, 0 * y + 0.10]), np.stack([0 * y, 0 * y - speed, 0 * y]))
    end, touched = run(ball_params(), state, 1 / 300, int(0.2 / speed * 300) + 3)
    assert bool(touched[1].all())
    assert float(end.position[1].min()) > 0.0


def test_the_net_stops_what_its_height_and_overhang_reach():
    radius, top, side = c.BALL_RADIUS, c.NET_HEIGHT, c.TABLE_WIDTH / 2 + c.NET_OVERHANG
    x = np.array([0.0, 0.0, side + radius - 0.002, side + radius + 0.002])
    z = np.array([top + radius - 0.002, top + radius + 0.002, 0.1, 0.1])
    params = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0))
    state = ball_state(np.stack([x, 0 * x + 0.1, z]), np.stack([0 * x, 0 * x - 6.0, 0 * x]))
    _, touched = run(params, state, 1 / 300, 15)
    assert touched[1].tolist() == [True, False, True, False]


def test_ball_on_the_table_edge_is_reflected_about_the_line_to_the_edge():
    frictionless = SurfaceParams(1.0, 0.0, 0.0, 0.0)
    params = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0), table=frictionless)
    beyond = 0.012  # [m] of the ball's centre past the end line
    n = 50
    z = 0.05 + np.arange(n) / n * 3.0 / 300
    state = ball_state(np.stack([0 * z, 0 * z - c.TABLE_LENGTH / 2 - beyond, z]), np.stack([0 * z, 0 * z, 0 * z - 3.0]))
    end, touched = run(params, state, 1 / 300, 10)
    normal = np.array([0.0, -beyond, np.sqrt(c.BALL_RADIUS**2 - beyond**2)]) / c.BALL_RADIUS
    expected = np.array([0, 0, -3.0]) - 2 * normal * (-3.0 * normal[2])
    assert bool(touched[0].all())
    assert np.abs(np.asarray(end.velocity) - expected[:, None]).max() < 0.02 * 3.0


def still_pose(position, normal, velocity=(0.0, 0.0, 0.0), dt=0.01):
    start = PaddlePose(*(jnp.asarray(v, float) for v in (position, normal, velocity, (0.0, 0.0, 0.0))))
    return start, replace(start, position=start.position + dt * start.velocity)


def test_paddle_impact_happens_when_the_gap_closes():
    params = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0))
    gap = 0.03
    reach = c.BALL_RADIUS + c.PADDLE_THICKNESS / 2
    state = ball_state(np.array([0.0, gap + reach, 0.5]), np.array([0, -5.0, 0]))
    _, events = step(params, state, 0.01, still_pose([0, 0, 0.5], [0, 1, 0], [0, 2.0, 0]))
    assert bool(events.paddle)
    assert float(events.time) == pytest.approx(gap / 7.0, rel=1e-9)


def test_paddle_misses_beyond_its_radius():
    params = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0), paddle=PaddleParams(radius=0.07))
    x = np.array([0.069, 0.071])
    state = ball_state(np.stack([x, 0 * x + 0.04, 0 * x + 0.5]), np.stack([0 * x, 0 * x - 5.0, 0 * x]))
    pose = jax.tree.map(lambda a: a[:, None], still_pose([0, 0, 0.5], [0, 1, 0]))
    _, events = step(params, state, 0.01, pose)
    assert events.paddle.tolist() == [True, False]


def test_paddle_impact_is_the_same_seen_from_a_moving_frame():
    params = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0))
    rng = np.random.default_rng(2)
    boost = np.array([0.8, -1.3, 0.6])
    for _ in range(20):
        normal = rng.normal(size=3) * 0.3 + [0, 1, 0]
        normal /= np.linalg.norm(normal)
        paddle_velocity = rng.normal(size=3)
        position = np.array([0, 0, 0.5]) + normal * 0.05
        velocity, spin = np.array([0, -6.0, 0]) + rng.normal(size=3), rng.normal(size=3) * 50
        rest, e1 = step(
            params, ball_state(position, velocity, spin), 0.01, still_pose([0, 0, 0.5], normal, paddle_velocity)
        )
        moving, e2 = step(
            params,
            ball_state(position, velocity + boost, spin),
            0.01,
            still_pose([0, 0, 0.5], normal, paddle_velocity + boost),
        )
        assert bool(e1.paddle) and bool(e2.paddle)
        np.testing.assert_allclose(moving.velocity, rest.velocity + boost, atol=1e-10)
        np.testing.assert_allclose(moving.spin, rest.spin, atol=1e-9)


TILT = (0.04, -0.07)  # dz/dx, dz/dy


def tilted_and_level(n=300):
    """Balls over and beside a tilted, raised table with its net; the same turned until they are level; the rotation."""
    a, b = TILT
    normal = np.array([-a, -b, 1.0]) / np.sqrt(1 + a * a + b * b)
    axis = np.cross([0, 0, 1.0], normal)
    angle = np.arctan2(np.linalg.norm(axis), normal[2])
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()
    rng = np.random.default_rng(7)
    position = np.stack([rng.uniform(-0.8, 0.8, n), rng.uniform(-1.42, 0.3, n), rng.uniform(0.15, 0.4, n)])
    velocity = np.stack([rng.normal(0, 1, n), rng.normal(0, 1, n), rng.uniform(-4, 1, n)])
    spin = rng.normal(0, 60, (3, n))
    flight = FlightParams(magnus_coefficient=0.5, integrator="midpoint")
    nominal = replace(ball_params(), flight=flight)
    table, net = (replace(surface, height=0.03, tilt_x=a, tilt_y=b) for surface in (nominal.table, nominal.net))
    tilted = replace(nominal, table=table, net=net)
    g = turn.T @ [0.0, 0.0, -9.81]
    level = replace(nominal, flight=replace(flight, gravity_x=g[0], gravity_y=g[1], gravity_z=g[2]))
    raised = np.array([0.0, 0.0, 0.03])[:, None]
    turned = ball_state(turn.T @ (position - raised), turn.T @ velocity, turn.T @ spin)
    return tilted, ball_state(position, velocity, spin), level, turned, turn, raised


def test_a_tilted_table_is_a_level_one_in_a_turned_world():
    tilted, state, level, turned, turn, raised = tilted_and_level()
    end, touched = run(tilted, state, 1 / 300, 90)
    other, touched_too = run(level, turned, 1 / 300, 90)
    np.testing.assert_array_equal(touched, touched_too)
    assert 100 < int(touched[0].sum()) < 300 and int(touched[1].sum()) > 5  # tops, edges, misses; the net
    np.testing.assert_allclose(end.position, turn @ np.array(other.position) + raised, atol=1e-9)
    np.testing.assert_allclose(end.velocity, turn @ np.array(other.velocity), atol=1e-7)
    np.testing.assert_allclose(end.spin, turn @ np.array(other.spin), atol=1e-5)
    flat = run(replace(tilted, table=replace(tilted.table, tilt_x=0.0, tilt_y=0.0)), state, 1 / 300, 90)[0]
    assert np.abs(np.asarray(end.position - flat.position)).max() > 0.05


def test_tilts_of_zero_change_nothing_and_can_be_differentiated():
    nominal = replace(ball_params(), flight=FlightParams(integrator="midpoint"))
    state = ball_state(np.array([0.2, -0.3, 0.2]), np.array([0.5, -2.0, -1.0]))

    @jax.jit
    def end(tilts):
        table = replace(nominal.table, tilt_x=tilts[0], tilt_y=tilts[1])
        return run(replace(nominal, table=table), state, 1 / 300, 60)[0].position

    def left_out():
        return run(without_nominal(nominal), state, 1 / 300, 60)[0].position

    np.testing.assert_allclose(end(jnp.zeros(2)), left_out(), atol=1e-14)
    slope_along = jax.jit(lambda direction: jax.jvp(end, (jnp.zeros(2),), (direction,))[1])
    for direction in jnp.eye(2):
        slope = slope_along(direction)
        difference = (end(1e-6 * direction) - end(-1e-6 * direction)) / 2e-6
        assert np.abs(difference).max() > 0.1
        np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-6)


def test_a_blade_gives_back_less_towards_its_rim():
    """Of restitution e = 0.9 and a loss of 40 % at the rim, the square of the distance decides."""
    bare = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0))
    blade = PaddleParams(restitution=0.9, restitution_slope=0.0, tangential_gain=0.0, rim_loss=0.4)
    x = blade.radius * np.array([0.0, 0.5, 0.99])
    state = ball_state(np.stack([x, 0 * x + 0.04, 0 * x + 0.5]), np.stack([0 * x, 0 * x - 5.0, 0 * x]))
    pose = jax.tree.map(lambda a: a[:, None], still_pose([0, 0, 0.5], [0, 1, 0]))
    new, events = step(replace(bare, paddle=blade), state, 0.01, pose)
    assert events.paddle.all()
    np.testing.assert_allclose(new.velocity[1], 5.0 * 0.9 * (1.0 - 0.4 * np.array([0.0, 0.25, 0.99**2])), rtol=1e-6)
    # Without the loss the program never knew of it.
    left_out = without_nominal(replace(bare, paddle=PaddleParams()))
    assert left_out.paddle.rim_loss is None


def test_a_turned_and_shifted_blade_reflects_from_where_it_is():
    """An elastic blade without friction, whose normal SciPy turns about the horizontal line in it."""
    tilt, offset, normal = 0.1, 0.008, np.array([0.3, 0.9, 0.2])
    normal /= np.linalg.norm(normal)
    elastic = PaddleParams(restitution=1.0, restitution_slope=0.0, tangential_gain=0.0, tilt=tilt, offset=offset)
    params = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0), paddle=elastic)
    axis = np.cross([0, 0, 1.0], normal)
    turned = Rotation.from_rotvec(tilt * axis / np.linalg.norm(axis)).apply(normal)
    assert turned[2] < normal[2] - 0.09  # closed
    assert turned[2] == pytest.approx(np.sin(np.arcsin(normal[2]) - tilt))
    velocity = np.array([-1.0, -5.0, 0.5])
    reach = c.BALL_RADIUS + c.PADDLE_THICKNESS / 2 + offset
    time = 0.006
    start = np.array([0, 0, 0.5]) + turned * reach - velocity * time
    new, events = step(params, ball_state(start, velocity), 0.01, still_pose([0, 0, 0.5], normal))
    assert bool(events.paddle)
    assert float(events.time) == pytest.approx(time, rel=1e-9)
    np.testing.assert_allclose(new.velocity, velocity - 2 * turned * (velocity @ turned), atol=1e-9)


def test_a_shifted_blade_turns_about_the_unshifted_centre():
    """Rubber that stops the slip leaves the ball's contact point with the speed of the blade's."""
    sticking = PaddleParams(restitution=0.0, restitution_slope=0.0, tangential_gain=0.4, offset=0.03)
    params = replace(ball_params(), flight=replace(VACUUM, gravity_z=0.0), paddle=sticking)
    spin = jnp.array([0.0, 0.0, 6.0])
    pose = tuple(replace(p, angular_velocity=spin) for p in still_pose([0, 0, 0.5], [0, 1, 0]))
    new, events = step(params, ball_state(np.array([0.02, 0.07, 0.5]), np.array([0, -5.0, 0])), 0.01, pose)
    assert bool(events.paddle)
    contact_point = np.array([0.02, 0.03 + c.PADDLE_THICKNESS / 2, 0.0])
    ball_point = np.array(new.velocity) + np.cross(new.spin, [0, -c.BALL_RADIUS, 0])
    np.testing.assert_allclose(ball_point, np.cross(spin, contact_point), atol=1e-9)
