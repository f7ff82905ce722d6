"""Episodes from their first to their last control step: the loop over time."""

from __future__ import annotations

import logging

import jax
import jax.numpy as jnp
from jax import Array

from mjx_tt.env.task import Controller, Episodes, EpisodeState, Task
from mjx_tt.lanes.loop import while_live
from mjx_tt.lanes.emitter import Unsupported

log = logging.getLogger(__name__)


def play(task: Task, controller: Controller, episodes: Episodes) -> EpisodeState:
    """The last state of episodes with one batch axis (L,), of which some may have moved on after their end.

    On a processor the control steps are compiled lane by lane (``mjx_tt.lanes``), unless ``TaskConfig.lanes`` is off
    or the controller or a term of the reward does what that compiler does not know; then by XLA, batch after batch.
    """
    prepared = task.prepare(episodes)
    state = task.reset(episodes, controller)
    limit = task.config.max_steps

    def step(tick: Array, s: EpisodeState, by_lane: tuple, by_column: Controller) -> EpisodeState:
        return task.control_step(tick, s, by_lane[0], by_lane[1], by_column)

    if task.config.lanes and task.config.engine == "fused" and jax.default_backend() == "cpu":
        try:
            return while_live(step, lambda s: s.live, state, (episodes, prepared), controller, limit)
        except Unsupported as reason:
            log.info("control steps are compiled by XLA: %s", reason)

    def running(carry: tuple[Array, EpisodeState]) -> Array:
        tick, s = carry
        return (tick < limit) & jnp.any(s.live)

    def advance(carry: tuple[Array, EpisodeState]) -> tuple[Array, EpisodeState]:
        tick, s = carry
        return tick + 1, task.control_step(tick, s, episodes, prepared, controller)

    return jax.lax.while_loop(running, advance, (jnp.int32(0), state))[1]
