"""Delays against dense time: what is read and what is applied, by interpolation and by integration."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_tt.sim import latency
from mjx_tt.sim.model import LATENCIES
from robot_io.contract import FESTO_JOINTS, N_JOINTS
from tests.support.scripted_episodes import TICKS as PERIODS
from tests.support.scripted_episodes import P, episodes, model, mujoco_path, play, script, task

T, SUBSTEPS = 1 / 75, 4
H = T / SUBSTEPS
TICKS = 40
DRAG = 0.47 * 1.29 * 1.256e-3 / (2 * 0.0027)  # [1/m], the paper's ball
DELAYS = np.concatenate(
    [np.random.default_rng(0).uniform(0, 0.1, 200), [0.0, H, 2 * H, T, T + H, 2 * T, 5 * T, 0.1, T - 1e-9, T + 1e-9]]
)


@pytest.fixture(params=[True, False], ids=["float64", "float32"])
def x64(request):
    with jax.enable_x64(request.param):
        yield request.param


def test_observation_is_the_interpolated_past(x64):
    """Read through rings the way the task does, from a rough path known at the substeps."""
    rng = np.random.default_rng(1)
    path = rng.normal(size=TICKS * SUBSTEPS + 1)
    path[0] = 0.3
    depth = latency.count_slots(0.1, T)

    @jax.jit
    def run(delays, path):
        delay = latency.split_observation_delay(delays, T)

        def period(ring, n):
            read = latency.read_ring(ring, n - delay.periods)[0]
            captured = sum(latency.weigh_capture(delay, s, H) * path[n * SUBSTEPS + s] for s in range(SUBSTEPS + 1))
            return latency.write_ring(ring, n, captured[None]), read

        start = jnp.full((depth, 1, delays.shape[0]), path[0])
        return jax.lax.scan(period, start, jnp.arange(TICKS, dtype=jnp.int32))[1]

    read = run(jnp.asarray(DELAYS), jnp.asarray(path))
    moments = np.arange(TICKS)[:, None] * T - DELAYS
    wanted = np.interp(moments, np.arange(path.size) * H, path)
    steepest = np.abs(np.diff(path)).max() / H
    # A delay of zero reads SMALLEST seconds into the past; float32 places the moment to about a tenth of that.
    late = latency.SMALLEST if x64 else 1.1 * latency.SMALLEST
    np.testing.assert_allclose(read, wanted, atol=steepest * late)
    plain = DELAYS > latency.SMALLEST
    if x64:
        np.testing.assert_allclose(read[:, plain], wanted[:, plain], atol=1e-9)


def delayed_mean(commands, delay, edges):
    """Mean over each interval between ``edges`` of the commands (ticks,), held for a period each and delayed."""
    knots, impulse = np.arange(len(commands) + 1) * T, np.concatenate([[0.0], np.cumsum(commands) * T])
    return np.diff(np.interp(edges - delay, knots, impulse)) / np.diff(edges)


def test_command_keeps_its_impulse_and_its_substep(x64):
    """The command of each substep is the mean over it of the ideally delayed zero-order hold, so every impulse is."""
    rng = np.random.default_rng(2)
    commands = rng.normal(size=TICKS)
    depth = latency.count_slots(0.13, T)

    @jax.jit
    def run(delays, commands):
        delay = latency.split_action_delay(delays, T)

        def period(ring, n):
            ring = latency.write_ring(ring, n, jnp.full((1, delays.shape[0]), commands[n]))
            old = latency.read_ring(ring, n - delay.periods - 1)[0]
            new = latency.read_ring(ring, n - delay.periods)[0]
            share = [latency.share_old_command(delay, s, H) for s in range(SUBSTEPS)]
            return ring, jnp.stack([new + a * (old - new) for a in share])

        start = jnp.zeros((depth, 1, delays.shape[0]))
        return jax.lax.scan(period, start, jnp.arange(TICKS, dtype=jnp.int32))[1]

    applied = np.asarray(run(jnp.asarray(DELAYS), jnp.asarray(commands)))
    applied = applied.reshape(TICKS * SUBSTEPS, -1)
    edges = np.arange(TICKS * SUBSTEPS + 1) * H
    wanted = np.transpose([delayed_mean(commands, delay, edges) for delay in DELAYS])
    np.testing.assert_allclose(applied, wanted, atol=1e-9 if x64 else 5e-4)
    np.testing.assert_allclose(applied.sum(axis=0), wanted.sum(axis=0), atol=1e-9 if x64 else 2e-3)


def test_the_task_delays_every_device_by_its_own_time():
    """Episodes with random latencies. The robot's path is MuJoCo C's under the ideally delayed commands; the ball
    flies straight, without gravity, so that its path under drag has a closed form."""
    rng = np.random.default_rng(3)
    delays = {name: rng.uniform(0.0, 0.1, P) for name in LATENCIES}
    actions = np.repeat(rng.uniform(-0.3, 0.3, (PERIODS // 10, N_JOINTS, 1)), 10, axis=0)
    start, velocity = np.array([0.2, 1.0, 0.4]), np.array([0.1, -1.5, 0.05])
    with jax.enable_x64(True):
        record = play(task(), episodes(start, velocity, delays, model(gravity=0.0)), script(actions))
    assert record.live.all()
    ticked, times = np.arange(PERIODS) * T, np.arange(PERIODS * SUBSTEPS + 1) * H
    speed = np.linalg.norm(velocity)
    for i in range(P):
        moments = np.maximum(ticked - delays["ball_observation"][i], 0.0)
        way = np.log1p(DRAG * speed * moments) / DRAG
        np.testing.assert_allclose(
            record.controller[:, :3, i], start + way[:, None] * velocity / speed, atol=1e-6, err_msg="ball"
        )
        device = ["festo" if joint in FESTO_JOINTS else "abb" for joint in range(N_JOINTS)]
        ctrl = [
            delayed_mean(record.command[:, joint, i], delays[f"{device[joint]}_action"][i], times)
            for joint in range(N_JOINTS)
        ]
        path = mujoco_path(np.transpose(ctrl))
        np.testing.assert_allclose(record.qpos[..., i], path[SUBSTEPS::SUBSTEPS], atol=1e-8)
        assert np.ptp(path, axis=0).min() > 0.01
        for joint in range(N_JOINTS):
            moments = ticked - delays[f"{device[joint]}_observation"][i]
            wanted = np.interp(moments, times, path[:, joint])
            np.testing.assert_allclose(record.controller[:, 3 + joint, i], wanted, atol=1e-8, err_msg=device[joint])
