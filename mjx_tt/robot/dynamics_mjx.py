"""The reference engine: the same step by MuJoCo MJX on the model itself."""

from __future__ import annotations

import contextlib
import copy
import io

import jax
import jax.numpy as jnp
import mujoco

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, an optional engine, is not installed
    from mujoco import mjx

from mjx_tt.robot.kinematics import Joints


class MjxEngine:
    """``step(qpos, qvel, ctrl) -> (qpos, qvel)`` for arrays (n, ...) of any batch shape, over ``timestep`` seconds.

    Raises ValueError for a model with fluid forces: MJX computes some of them and drops the others without a word.
    """

    name = "mjx"

    def __init__(self, model: mujoco.MjModel, timestep: float | None = None) -> None:
        for option in ("density", "viscosity"):
            if getattr(model.opt, option):
                raise ValueError(f"option {option}: must be 0 (no fluid forces), got {getattr(model.opt, option)}")
        model = copy.deepcopy(model)
        if timestep is not None:
            model.opt.timestep = timestep
        self.timestep = float(model.opt.timestep)
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(model)

    def step(self, qpos: Joints, qvel: Joints, ctrl: Joints) -> tuple[Joints, Joints]:
        """One step. qpos [m]/[rad], qvel [m/s]/[rad/s], ctrl in the actuators' units: each (n, ...)."""
        batch = qpos.shape[1:]

        def one(q: jax.Array, v: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
            # MJX mixes dtypes and ranks as JAX allows by default.
            with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
                data = mjx.step(self._model, self._data.replace(qpos=q, qvel=v, ctrl=u))
            return data.qpos, data.qvel

        flat = (jnp.moveaxis(x.reshape(x.shape[0], -1), 0, -1) for x in (qpos, qvel, ctrl))
        q, v = jax.vmap(one)(*flat)
        q, v = (jnp.moveaxis(x, -1, 0).reshape((-1, *batch)).astype(qpos.dtype) for x in (q, v))
        return q, v
