"""The data of an episode: what is random in it, what is constant, its state and its outcome."""

from __future__ import annotations

from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int, UInt32

from ballmodel.flight import PaddlePose
from ballmodel.state import BallState
from mjx_tt.pytrees import pytree
from mjx_tt.sim.actuators import DriveState, JointDrive
from mjx_tt.sim.latency import Delay
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.sensors import Camera, Filters

Tick: TypeAlias = Int[Array, ""] | int  # control steps since the start

MISSED, HIT, RETURNED = range(3)  # outcomes; HIT: touched after the bounce, but not returned


@runtime_checkable
class Controller(Protocol):
    """Source of the robot's velocities; batch axes last."""

    @property
    def mean(self) -> Float[Array, "observed *#batch"]:
        """The value about which the observations' statistics are summed."""
        ...

    def start(self, observation: Float[Array, "observed *batch"]) -> Any:
        """State before the first control step, a pytree, from the first observation."""
        ...

    def act(
        self, tick: Tick, state: Any, observation: Float[Array, "observed *batch"]
    ) -> tuple[Float[Array, "joints *batch"], Any]:
        """Action in [-1, 1] at control step ``tick`` and the next state."""
        ...


@pytree
class FixedAction:
    """A controller with an action decided outside."""

    action: Float[Array, "joints *batch"]
    mean: Float[Array, "observed"]

    def start(self, observation: Array) -> tuple[()]:
        return ()

    def act(self, tick: Tick, state: tuple[()], observation: Array) -> tuple[Float[Array, "joints *batch"], tuple[()]]:
        return self.action, ()


@pytree
class Episodes:
    """The random part of a batch of episodes."""

    ball: BallState  # (3, ...)
    latency: Float[Array, "5 *batch"]  # [s], order of model.LATENCIES
    seed: UInt32[Array, "*batch"]  # of the observation noise
    model: SimModel  # leaves scalar or (...)
    # joint positions at which the robot rests at first; None: at home
    start: Float[Array, "joints *batch"] | None = None


def reshape_episodes(episodes: Episodes, *batch: int) -> Episodes:
    """Episodes (..., R, P), as they are drawn, with other batch axes; scalars of the model are shared as before."""
    return jax.tree.map(lambda x: x.reshape(*x.shape[:-2], *batch) if x.ndim >= 2 else x, episodes)


@pytree
class EpisodeConstants:
    """Delays, drives and camera of the episodes, computed once before the loop."""

    ball: Delay
    joints: Delay  # (8, ...)
    action: Delay  # (8, ...)
    drives: JointDrive  # (8, ...) of each effect, as ``actuators.sort_by_effect`` gives them
    camera: Camera | None


@pytree
class Accumulators:
    """Running quantities of phase 1."""

    closest: Float[Array, "*batch"]  # [m] least distance of ball and blade centre after the bounce
    steps: Float[Array, "*batch"]
    peak_velocity: Float[Array, "joints *batch"]  # [m/s], [rad/s] highest commanded speed
    observation: Float[Array, "observed *batch"]  # sum of (x - shift)
    observation_sq: Float[Array, "observed *batch"]  # sum of (x - shift)^2
    terms: dict[str, Float[Array, "*batch"]]  # of the reward terms per control step, sums over the steps


@pytree
class EpisodeState:
    """State of phase 1 between control steps."""

    qpos: Float[Array, "joints *batch"]
    qvel: Float[Array, "joints *batch"]
    pose: PaddlePose
    command: Float[Array, "joints *batch"]  # velocity commanded in the period before
    command_acceleration: Float[Array, "joints *batch"]
    reference: Float[Array, "joints *batch"]  # sum of commands
    commands: Float[Array, "depth joints *batch"]  # ring by control period
    # Ring by control period, captured at the delays' phases: 11 components, with jitter also the ball's velocity.
    observations: Float[Array, "depth captured *batch"]
    controller: Any  # pytree, whatever the controller remembers
    drive: DriveState
    filters: Filters  # of the tracker
    ball: BallState
    bounced: Bool[Array, "*batch"]
    hit: Bool[Array, "*batch"]
    live: Bool[Array, "*batch"]
    finite: Bool[Array, "*batch"]
    accumulators: Accumulators


@pytree
class Return:
    """Outcome of phase 2."""

    crossed: Bool[Array, "*batch"]  # over the net plane
    net_height: Float[Array, "*batch"]  # [m] of the ball's centre there
    returned: Bool[Array, "*batch"]
    landing: Float[Array, "2 *batch"]  # [m] where it came down to the table's height

    @classmethod
    def nowhere(cls, ball: BallState) -> Return:
        """Of balls that have not flown yet."""
        zero = jnp.zeros_like(ball.position[0])
        return cls(zero > 1.0, zero, zero > 1.0, jnp.asarray(ball.position[:2]))
