"""The data of an episode: its settings, what is random in it, its state and its outcome."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax
from jax import Array
from jaxtyping import Bool, Float, Int, UInt32

from ballmodel.flight import PaddlePose
from ballmodel.state import BallState
from mjx_tt.env import rewards
from mjx_tt.env.own import Term
from mjx_tt.robot import robot
from mjx_tt.robot.robot import Robot
from mjx_tt.sim.actuators import Drives, DriveState
from mjx_tt.sim.latency import Delay
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.sensors import Camera, Filters

Tick: TypeAlias = Int[Array, ""] | int  # control steps since the start

ENGINES = ("fused", "mjx")
MISSED, HIT, RETURNED = range(3)  # outcomes; HIT: touched after the bounce, but not returned


@dataclass(frozen=True)
class TaskConfig:
    """Settings of an episode. Rates in Hz, times in seconds.

    Raises ValueError for an unknown engine, a substep count that is not whole, or weights that do not match the terms.
    """

    engine: str = "fused"
    control_rate: float = 75.0
    sim_rate: float = 300.0
    max_steps: int = 200  # control steps, both phases together
    max_observation_latency: float = 0.1  # longer draws are cut: mean + 7 deviations of the ball's
    max_action_latency: float = 0.13
    reward_weights: tuple[float, ...] = field(default=tuple(rewards.SIM_WEIGHTS.values()))  # of ``terms``
    own_terms: tuple[Term, ...] = ()  # the user's, after the eleven
    robot: Robot = field(default_factory=robot.paper)
    lanes: bool = True  # compile control steps lane by lane on processors (``mjx_tt.lanes``); else XLA does

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise ValueError(f"engine {self.engine!r} is not one of {ENGINES}")
        ratio = self.sim_rate / self.control_rate
        if self.control_rate <= 0 or abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
            raise ValueError(
                f"sim_rate {self.sim_rate} Hz is not a whole multiple of control_rate {self.control_rate} Hz"
            )
        if self.max_steps < 1:
            raise ValueError(f"max_steps is {self.max_steps}, at least 1 is needed")
        if len(self.reward_weights) != len(self.terms):
            raise ValueError(f"reward_weights has {len(self.reward_weights)} numbers, the terms are {self.terms}")

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the reward terms: the eleven and the user's."""
        return (*rewards.TERMS, *(term.name for term in self.own_terms))

    @property
    def substeps(self) -> int:
        return round(self.sim_rate / self.control_rate)

    @property
    def period(self) -> float:
        """Control period [s]."""
        return 1.0 / self.control_rate


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodes:
    """The random part of a batch of episodes."""

    ball: BallState  # (3, ...)
    latency: Float[Array, "5 *batch"]  # [s], order of model.LATENCIES
    seed: UInt32[Array, "*batch"]  # of the observation noise
    model: SimModel  # leaves scalar or (...)
    # joint positions at which the robot rests at first; None: at home
    start: Float[Array, "joints *batch"] | None = None


def reshaped(episodes: Episodes, *batch: int) -> Episodes:
    """Episodes (..., R, P), as they are drawn, with other batch axes; scalars of the model are shared as before."""
    return jax.tree.map(lambda x: x.reshape(*x.shape[:-2], *batch) if x.ndim >= 2 else x, episodes)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Prepared:
    """Delays, drives and camera of the episodes, computed once before the loop."""

    ball: Delay
    joints: Delay  # (8, ...)
    action: Delay  # (8, ...)
    drives: Drives
    camera: Camera | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sums:
    """Running quantities of phase 1."""

    closest: Float[Array, "*batch"]  # [m] least distance of ball and blade centre after the bounce
    jerk: Float[Array, "*batch"]  # means over joints, summed over steps, each step in [0, 1]
    acceleration: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]
    safe_angle: Float[Array, "*batch"]  # steps with every joint well inside its range
    collision: Float[Array, "*batch"]  # steps in contact
    low_paddle: Float[Array, "*batch"]
    bad_style: Float[Array, "*batch"]
    steps: Float[Array, "*batch"]
    peak_velocity: Float[Array, "joints *batch"]  # [m/s], [rad/s] highest commanded speed
    observation: Float[Array, "observed *batch"]  # sum of (x - shift)
    observation_sq: Float[Array, "observed *batch"]  # sum of (x - shift)^2
    own: tuple[Float[Array, "*batch"], ...] = ()  # sums of the user's terms per control step


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
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
    sums: Sums


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Return:
    """Outcome of phase 2."""

    crossed: Bool[Array, "*batch"]  # over the net plane
    net_height: Float[Array, "*batch"]  # [m] of the ball's centre there
    returned: Bool[Array, "*batch"]
    landing: Float[Array, "2 *batch"]  # [m] where it came down to the table's height
