"""The reference engine: the same step by MuJoCo MJX on the model itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx


class MjxEngine:
    """``step(qpos, qvel, ctrl) -> (qpos, qvel)`` for arrays (n, ...) of any batch shape, over ``timestep`` seconds."""

    name = "mjx"

    def __init__(self, model: mujoco.MjModel, timestep: float | None = None) -> None:
        model = _copy(model)
        if timestep is not None:
            model.opt.timestep = timestep
        self.timestep = float(model.opt.timestep)
        self._model = mjx.put_model(model)
        self._data = mjx.make_data(model)

    def step(self, qpos, qvel, ctrl):
        """One step. qpos [m]/[rad], qvel [m/s]/[rad/s], ctrl in the actuators' units: each (n, ...)."""
        batch = qpos.shape[1:]

        def one(q, v, u):
            data = mjx.step(self._model, self._data.replace(qpos=q, qvel=v, ctrl=u))
            return data.qpos, data.qvel

        flat = (jnp.moveaxis(x.reshape(x.shape[0], -1), 0, -1) for x in (qpos, qvel, ctrl))
        q, v = jax.vmap(one)(*flat)
        return tuple(jnp.moveaxis(x, -1, 0).reshape((-1, *batch)).astype(qpos.dtype) for x in (q, v))


def _copy(model: mujoco.MjModel) -> mujoco.MjModel:
    import copy

    return copy.deepcopy(model)
