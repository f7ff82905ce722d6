"""Loops as accelerators' kernels: one lane at a time on this processor, against the same loop by XLA and by vectors."""

from __future__ import annotations

import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.flight import ball_params
from ballmodel.sampling import sample_pool
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.lanes import cuda, frame, kernel, machine
from mjx_tt.lanes.loop import while_any
from mjx_tt.sim.model import SimModel
from robot_io.contract import N_OBSERVATION


def threads_in_turn(operands, lanes):
    """A handler for this processor in place of an accelerator's threads."""
    states = [f"ptr %r{i}" for i, o in enumerate(operands) if o.kind == "state"]
    arguments = ", ".join([*(f"ptr %a{i}" for i in range(len(operands))), *states, "i64 %lane"])
    lines = [
        *frame.opened(operands),
        "br label %next",
        "next:",
        "%lane = phi i64 [0, %execute], [%after, %next]",
        f"call void @lane({arguments})",
        "%after = add i64 %lane, 1",
        f"%more = icmp slt i64 %after, {lanes}",
        "br i1 %more, label %next, label %end",
        "end:",
        "ret ptr null",
    ]
    return "\n".join(["define ptr @handler(ptr %frame) nounwind {", *lines, "}", ""])


@pytest.fixture
def as_kernels(monkeypatch):
    """While it is on, loops are compiled as kernels; each one's text, operands and number of lanes."""
    made = []

    def module(traced, operands, lanes, *rest):
        made.append((text_of(traced, operands, lanes, *rest), operands, lanes))
        return made[-1][0]

    def compiled(text, operands, lanes, folder):
        return machine.compiled(text + threads_in_turn(operands, lanes), "handler", None)

    text_of = kernel.module
    monkeypatch.setattr(kernel, "module", module)
    monkeypatch.setattr(cuda, "compiled", compiled)
    monkeypatch.setattr(cuda, "PLATFORM", "cpu")
    monkeypatch.setattr(cuda, "present", lambda: True)
    return made


def decay(lanes, columns, by_lanes):
    """Kinds of operands: flags, whole numbers, shared scalars and vectors, by lane, by column, a ring, a scan."""

    def step(tick, s, by_lane, by_column):
        live, x, n, ring = s
        rate, least = by_lane
        w, shared = by_column
        ring = jax.lax.dynamic_update_index_in_dim(ring, x, jnp.mod(tick, 3), 0)
        ring = jnp.where(live, ring, s[3])
        oldest = jax.lax.dynamic_index_in_dim(ring, jnp.mod(tick + 1, 3), 0, keepdims=False)
        total = jax.lax.fori_loop(
            0, 3, lambda i, t: 0.5 * t + w[None, 1:] * shared[1], oldest.reshape(1, -1, w.shape[-1])
        )
        total = total.reshape(x.shape)
        x = jnp.where(live, x - rate * x + 1e-3 * total, x)
        return live & (x > least), x, n + live.astype(jnp.int32), ring

    x = jnp.asarray(np.random.default_rng(0).uniform(1.0, 3.0, lanes), jnp.float32)
    start = (x > 0, x, jnp.zeros(lanes, jnp.int32), jnp.zeros((3, lanes)))
    lane = (jnp.linspace(0.02, 0.2, lanes), jnp.float32(0.3))
    column = (jnp.linspace(3.0, 1.0, 2 * columns).reshape(2, columns), jnp.asarray([5.0, 0.7]))
    run = jax.jit(lambda *a: while_any(lambda s: s[0], step, *a, limit=60, lanes=by_lanes))
    return jax.tree.map(np.asarray, run(start, lane, column))


@pytest.mark.parametrize("lanes, columns", [(1, 1), (12, 4), (70, 35)])
def test_a_lane_alone_is_what_xla_makes_of_it(as_kernels, lanes, columns):
    live, x, n, ring = decay(lanes, columns, by_lanes=True)
    assert len(as_kernels) == 1
    wanted = decay(lanes, columns, by_lanes=False)
    np.testing.assert_array_equal(n, wanted[2])
    np.testing.assert_array_equal(live, wanted[0])
    np.testing.assert_allclose(x, wanted[1], rtol=1e-5)
    np.testing.assert_allclose(ring, wanted[3], rtol=1e-5)
    assert n.min() < n.max() or lanes == 1  # lanes end one by one


def test_episodes_are_those_of_vectors(as_kernels, monkeypatch):
    simulator = Simulator(TaskConfig())
    pool = sample_pool(jax.random.key(0), registry.resolve("player3/M0"), ball_params(), 256)
    episodes = simulator.draw(jax.random.key(1), pool, SimModel(), (), 2, 12)
    theta = jnp.stack([initial_theta(key) for key in jax.random.split(jax.random.key(2), 12)], axis=-1)
    policy = Policy(theta, jnp.zeros(N_OBSERVATION), jnp.ones(N_OBSERVATION))

    def played():
        return jax.tree.map(np.asarray, jax.jit(lambda *a: simulator.rollout(*a))(policy, episodes))

    one = played()
    assert len(as_kernels) == 2  # of control steps, and of the flight after a hit
    monkeypatch.setattr(cuda, "present", lambda: False)
    other = played()
    np.testing.assert_array_equal(one.outcome, other.outcome)
    np.testing.assert_array_equal(one.steps, other.steps)
    np.testing.assert_allclose(one.returns, other.returns, rtol=1e-4, atol=1e-4)


def test_the_assembly_is_valid(as_kernels, tmp_path):
    """By NVIDIA's own assembler, where it is installed."""
    assembler = shutil.which("ptxas")
    if assembler is None:
        pytest.skip("ptxas, of NVIDIA's CUDA tools, is not installed")
    decay(12, 4, by_lanes=True)
    (tmp_path / "kernel.ptx").write_bytes(cuda.ptx(*as_kernels[0], "sm_90"))
    subprocess.run([assembler, "-arch=sm_90", tmp_path / "kernel.ptx", "-o", tmp_path / "kernel"], check=True)
