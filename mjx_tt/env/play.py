"""Episodes from their first to their last control step."""

from __future__ import annotations

from jax import Array

from mjx_tt.env.task import Controller, Episodes, EpisodeState, Prepared, Task
from mjx_tt.lanes.loop import while_any


def play(task: Task, controller: Controller, episodes: Episodes) -> EpisodeState:
    """The last state of episodes with one batch axis (L,).

    Of an episode that ended before others the robot may have moved on; ball, outcome and sums are those of its end.
    """
    prepared = task.prepare(episodes)

    def step(tick: Array, s: EpisodeState, by_lane: tuple[Episodes, Prepared], by_column: Controller) -> EpisodeState:
        return task.control_step(tick, s, *by_lane, by_column)

    return while_any(
        lambda s: s.live,
        step,
        task.reset(episodes, controller),
        (episodes, prepared),
        controller,
        limit=task.config.max_steps,
        lanes=task.config.lanes and task.config.engine == "fused",
    )
