"""The task: what the policy observes, what it is rewarded for, when an episode ends and how it begins.

One episode is one ball and one return. In phase 1 robot, policy and incoming ball run at the control rate until the
paddle touches the ball or the ball is out of reach. In phase 2 (``mjx_tt.env.return_flight``) the outgoing ball flies
alone: as at the real robot, the policy's part ends with the contact.

The paper gives names, ranges and weights of its eleven reward terms (appendix "Rewards in Simulation and the Real
World"); what each of them measures in detail stands here. ``docs/how-to/define-a-task.md`` shows how to add a term.
Everything is a pure function over a batch of any shape, the batch axes last.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from mjx_tt.env.episode import Accumulators, Controller, EpisodeConstants, Episodes, EpisodeState, Return, Tick
from mjx_tt.env.reward_weights import SIM_WEIGHTS, TERMS
from mjx_tt.env.substeps import ENGINES, Physics
from mjx_tt.env.terms import (
    REDUCTIONS,
    ControlStep,
    ObservationTerm,
    PlayedBall,
    RewardTerm,
    Sensed,
    observation_term,
    reward_term,
)
from mjx_tt.env.user_defined import count_rows
from mjx_tt.lanes.loop import while_any
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from mjx_tt.robot.scalar_algebra import optimization_barrier
from mjx_tt.sim import actuators, latency
from mjx_tt.sim.sensors import Filters
from robot_io.limits import limit_velocity

# ---- Observation -----------------------------------------------------------------------------------------------------


@observation_term()
def ball(sensed: Sensed) -> Array:
    """Position of the ball [m]: rows 0 to 2."""
    return sensed.ball


@observation_term()
def joints(sensed: Sensed) -> Array:
    """Positions of the joints [m], [rad]."""
    return sensed.joints


CONTRACT_OBSERVATIONS: tuple[ObservationTerm, ...] = (ball, joints)  # what the robot's side sees as well


def compose_observation(terms: tuple[ObservationTerm, ...], sensed: Sensed) -> Float[Array, "observed *batch"]:
    """The policy's input from what is sensed."""
    return jnp.concatenate([term(sensed).astype(sensed.ball.dtype) for term in terms])


# ---- Reward ----------------------------------------------------------------------------------------------------------

TARGET = (0.0, 0.685)  # [m] x, y: centre of the human's half
TARGET_RANGE = 0.7  # [m] e-folding distance of the bonus around the target
APPROACH_RANGE = 0.25  # [m] e-folding distance of the closest approach of paddle and ball
NET_TARGET = 0.35  # [m] height of the ball's centre over the net plane that earns the whole bonus
NET_RANGE = 0.25  # [m] deviation from it that earns exp(-1)
FAULT = -2.0  # of a robot that stopped itself, the paper's table of rewards
BLADE_CLEARANCE = 0.05  # [m] between blade and table below which the paddle counts as low
FACING = 0.3  # smallest y component of the blade's normal in good style (72 degrees from the table's axis)
SOFT_RANGE = 0.05  # share of a joint's range at each end that the joint-angle term counts as unsafe


@reward_term(per="ball")
def state_transition(ball: PlayedBall) -> Array:
    """In [0, 5]: nearing the ball up to 3, hit 3, over the net 3.5, on the human's half 4, plus up to 1 more.

    After a hit, coming down near the target is worth up to 0.5, and up to 1 once the ball lands on the human's half.
    """
    distance = jnp.hypot(ball.landing[0] - TARGET[0], ball.landing[1] - TARGET[1])
    near = jnp.exp(-distance / TARGET_RANGE)
    crossed = 0.5 * jnp.asarray(ball.crossed).astype(near.dtype)
    after_hit = 3.0 + jnp.where(ball.returned, 1.0 + near, crossed + 0.5 * near)
    return jnp.where(ball.hit, after_hit, 3.0 * jnp.exp(-ball.closest / APPROACH_RANGE))


@reward_term(per="ball")
def net_clearance(ball: PlayedBall) -> Array:
    """In [0, 1]: the outgoing ball's height over the net plane against a target height."""
    bonus = jnp.exp(-(((ball.net_height - NET_TARGET) / NET_RANGE) ** 2))
    return jnp.where(jnp.asarray(ball.hit) & ball.crossed, bonus, 0.0)


@reward_term(per="ball")
def hit_and_land(ball: PlayedBall) -> Array:
    """1 for a ball that was returned."""
    return jnp.where(ball.returned, 1.0, 0.0)


@reward_term(per="ball")
def fault(ball: PlayedBall) -> Array:
    """-2 for a fault of the robot."""
    return jnp.where(ball.fault, FAULT, 0.0)


@reward_term(reduce="one_minus_mean")
def jerk(step: ControlStep) -> Array:
    """Share of the jerk that full acceleration against full acceleration takes."""
    return measure_share(step.jerk, 2.0 * np.asarray(step.limits.acceleration) / step.period)


@reward_term(reduce="one_minus_mean")
def acceleration(step: ControlStep) -> Array:
    """Share of the accelerations' limits."""
    return measure_share(step.acceleration, step.limits.acceleration)


@reward_term(reduce="one_minus_mean")
def velocity(step: ControlStep) -> Array:
    """Share of the velocities' limits."""
    return measure_share(step.command, step.limits.velocity)


@reward_term()
def joint_angle(step: ControlStep) -> Array:
    """Control steps with every joint well inside its range."""
    lower, upper = np.asarray(step.limits.lower), np.asarray(step.limits.upper)
    soft = SOFT_RANGE * (upper - lower)
    inside = [(q > lower[i] + soft[i]) & (q < upper[i] - soft[i]) for i, q in enumerate(step.joints)]
    return functools.reduce(operator.and_, inside)


@reward_term(reduce="minus_sum")
def collision(step: ControlStep) -> Array:
    """Control steps in contact with table or robot."""
    return (step.table_gap <= 0.0) | (step.own_gap <= 0.0)


@reward_term(reduce="minus_sum")
def paddle_height(step: ControlStep) -> Array:
    """Control steps with a low paddle."""
    return step.blade_gap < BLADE_CLEARANCE


@reward_term(reduce="minus_sum")
def style(step: ControlStep) -> Array:
    """Control steps with a paddle that faces backwards."""
    return jnp.asarray(step.blade.normal[1] < FACING)


def measure_share(values: Float[Array, "joints *batch"], limit: np.ndarray | tuple[float, ...]) -> Array:
    """Mean over the joints of |value| / limit, at most 1 each."""
    parts = [jnp.minimum(jnp.abs(values[i]) / limit[i], 1.0) for i in range(len(limit))]
    return jnp.asarray(sum(parts)) / len(limit)


BUILT_IN_REWARDS: tuple[RewardTerm, ...] = tuple(globals()[name] for name in TERMS)


def weigh_rewards(weights: Mapping[str, float], user: Iterable[RewardTerm] = ()) -> tuple[RewardTerm, ...]:
    """The built-in terms and the user's with these weights; a term without one weighs 0.

    Raises ValueError for a name that no term has.
    """
    terms = (*BUILT_IN_REWARDS, *user)
    unknown = weights.keys() - {term.name for term in terms}
    if unknown:
        raise ValueError(
            f"rewards: {', '.join(sorted(unknown))} is no reward term; allowed: "
            f"{', '.join(term.name for term in terms)}, and terms that the file of the key definitions has"
        )
    return tuple(replace(term, weight=float(weights.get(term.name, 0.0))) for term in terms)


def evaluate_rewards(
    terms: tuple[RewardTerm, ...], s: EpisodeState, back: Return, fault: Bool[Array, "*batch"] | bool = False
) -> Float[Array, "terms *batch"]:
    """The unweighted terms of episodes that are over."""
    sums, steps = s.accumulators, jnp.maximum(s.accumulators.steps, 1.0)
    returned = back.returned & s.hit
    outcome = s.hit, back.crossed, returned, back.net_height, back.landing
    played = PlayedBall(*outcome, sums.closest, sums.steps, sums.peak_velocity, fault)
    values = (
        jnp.asarray(term(played)) if term.per == "ball" else REDUCTIONS[term.reduce](sums.terms[term.name], steps)
        for term in terms
    )
    return jnp.stack([jnp.broadcast_to(value.astype(steps.dtype), steps.shape) for value in values])


def add_weighted(terms: tuple[RewardTerm, ...], values: Float[Array, "terms *batch"]) -> Float[Array, "*batch"]:
    """The return: the sum of the weighted terms."""
    return jnp.asarray(sum(term.weight * values[i] for i, term in enumerate(terms)))


# ---- Configuration ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TaskConfig:
    """Settings of an episode. Rates in Hz, times in seconds.

    Raises ValueError for an unknown engine, a substep count that is not whole, or a name that two terms have.
    """

    engine: str = "fused"
    control_rate: float = 75.0
    sim_rate: float = 300.0
    max_steps: int = 200  # control steps, both phases together
    max_observation_latency: float = 0.1  # longer draws are cut: mean + 7 deviations of the ball's
    max_action_latency: float = 0.13
    contact_ends_episode: bool = False  # of the robot with the table or itself, as the real one stops; else it goes on
    rewards: tuple[RewardTerm, ...] = field(default_factory=lambda: weigh_rewards(SIM_WEIGHTS))
    observations: tuple[ObservationTerm, ...] = CONTRACT_OBSERVATIONS
    robot: Robot = field(default_factory=robots.paper)
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
        if len(set(self.terms)) != len(self.terms):
            raise ValueError(f"rewards has a name twice: {self.terms}")
        if self.observations[: len(CONTRACT_OBSERVATIONS)] != CONTRACT_OBSERVATIONS:
            raise ValueError("observations must begin with ball and joints, which the robot's contract has")

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the reward terms."""
        return tuple(term.name for term in self.rewards)

    @property
    def reward_weights(self) -> tuple[float, ...]:
        return tuple(term.weight for term in self.rewards)

    @functools.cached_property
    def n_observation(self) -> int:
        """Rows of the policy's input: 11 for the paper's robot without further terms."""
        return count_rows(self.observations, self.robot.contract)

    @property
    def substeps(self) -> int:
        return round(self.sim_rate / self.control_rate)

    @property
    def period(self) -> float:
        """Control period [s]."""
        return 1.0 / self.control_rate


# ---- Reset and the control step --------------------------------------------------------------------------------------


class Task(Physics):
    """Episodes of one robot under one configuration."""

    config: TaskConfig

    def reset(self, episodes: Episodes, controller: Controller) -> EpisodeState:
        """Robot at rest at home (or ``episodes.start``), ball at its launch; history buffers hold these values."""
        batch, dtype, config = episodes.ball.position.shape[1:], episodes.ball.position.dtype, self.config
        n = self.contract.n_joints

        def full(value: float, *leading: int) -> Array:
            return jnp.broadcast_to(jnp.asarray(value, dtype), leading + batch)

        zeros = full(0.0, n)
        home = jnp.asarray(self.home, dtype).reshape((n,) + (1,) * len(batch))
        home = jnp.broadcast_to(home if episodes.start is None else episodes.start, zeros.shape)
        seen = jnp.concatenate([episodes.ball.position, home])
        zero, false = full(0.0), jnp.broadcast_to(False, batch)
        constants, tracker = self.prepare(episodes), episodes.model.sensing
        captured = seen if tracker.jitter is None else jnp.concatenate([seen, episodes.ball.velocity])
        sensed = self.measure(episodes, constants, captured, zeros, 0)
        depth = latency.count_slots(config.max_observation_latency, self.period)
        return EpisodeState(
            qpos=home,
            qvel=zeros,
            pose=self.kinematics.pose(home, zeros),
            command=zeros,
            command_acceleration=zeros,
            reference=home,
            commands=full(0.0, latency.count_slots(config.max_action_latency, self.period), n),
            observations=jnp.broadcast_to(captured, (depth, *captured.shape)),
            controller=controller.start(compose_observation(config.observations, sensed)),
            drive=actuators.rest(constants.drives, home),
            filters=Filters.settle(tracker, episodes.ball.position, self.timestep),
            ball=episodes.ball,
            bounced=false,
            hit=false,
            live=~false,
            finite=~false,
            accumulators=Accumulators(
                closest=full(3.0),
                steps=zero,
                peak_velocity=zeros,
                observation=full(0.0, config.n_observation),
                observation_sq=full(0.0, config.n_observation),
                terms={term.name: zero for term in config.rewards if term.per == "step"},
            ),
        )

    def play(self, controller: Controller, episodes: Episodes) -> EpisodeState:
        """The last state of episodes with one batch axis (L,).

        Of an episode that ended before others the robot may have moved on; ball, outcome and sums are those of its end.
        """
        return while_any(
            lambda s: s.live,
            lambda tick, s, given, plays: self.step(tick, s, given[0], given[1], plays),
            self.reset(episodes, controller),
            (episodes, self.prepare(episodes)),
            controller,
            limit=self.config.max_steps,
            lanes=self.config.lanes and self.config.engine == "fused",
        )

    def observe(
        self, tick: Tick, s: EpisodeState, episodes: Episodes, constants: EpisodeConstants
    ) -> Float[Array, "observed *batch"]:
        """The policy's input at control step ``tick``."""
        sensed = self.sense(tick, s, episodes, constants)
        return optimization_barrier(compose_observation(self.config.observations, sensed))

    def step(
        self, tick: Tick, s: EpisodeState, episodes: Episodes, constants: EpisodeConstants, controller: Controller
    ) -> EpisodeState:
        """One control period: observe, act, advance robot and ball by the substeps, count."""
        seen = self.observe(tick, s, episodes, constants)
        action, controller_state = controller.act(tick, s.controller, seen)
        limits, period = self.contract.limits, self.period
        scale = np.asarray(limits.policy_velocity, action.dtype).reshape((-1,) + (1,) * (action.ndim - 1))
        # After the contact the robot is only braked: what the real one does before it returns home.
        request = jnp.where(s.live, action * scale, 0.0)
        command = optimization_barrier(limit_velocity(request, s.command, s.reference, period, limits, xp=jnp))
        reference = s.reference + command * period
        commands = latency.write_ring(s.commands, tick, command)
        in_force = (
            latency.read_ring(commands, tick - constants.action.periods - 1),
            latency.read_ring(commands, tick - constants.action.periods),
        )
        (qpos, qvel, pose, drive, filters, ball, flags, closest), captured = self.step_physics(
            s, episodes, constants, in_force
        )
        bounced, hit, live = flags
        carried = qpos if drive.output is None else drive.output
        gaps = optimization_barrier(self.clearance(optimization_barrier(self.kinematics.links(carried)), carried[0]))
        acceleration = (command - s.command) / period
        done = ControlStep(
            observation=seen,
            command=command,
            acceleration=acceleration,
            jerk=(acceleration - s.command_acceleration) / period,
            joints=carried,
            blade=pose,
            ball_position=jnp.asarray(ball.position),
            ball_velocity=jnp.asarray(ball.velocity),
            bounced=bounced,
            table_gap=gaps.table,
            own_gap=gaps.own,
            blade_gap=gaps.blade,
            limits=limits,
            period=period,
        )
        if self.config.contact_ends_episode:
            live = live & (gaps.table > 0.0) & (gaps.own > 0.0)
        ok = jnp.isfinite(sum(qpos[i] for i in range(self.contract.n_joints)) + sum(ball.position[i] for i in range(3)))
        return EpisodeState(
            qpos=qpos,
            qvel=qvel,
            pose=pose,
            command=command,
            command_acceleration=acceleration,
            reference=reference,
            commands=commands,
            observations=latency.write_ring(s.observations, tick, captured),
            controller=controller_state,
            drive=drive,
            filters=filters,
            ball=ball,
            bounced=bounced,
            hit=hit,
            live=live & ok,
            finite=s.finite & (ok | ~s.live),
            accumulators=self._accumulate(s, done, controller.mean, closest),
        )

    def _accumulate(
        self,
        s: EpisodeState,
        step: ControlStep,
        shift: Float[Array, "observed *#batch"],
        closest: Float[Array, "*batch"],
    ) -> Accumulators:
        """The running quantities after a control period. shift: value about which observations are summed."""
        before, alive = s.accumulators, s.live.astype(step.command.dtype)
        centred = step.observation - shift.reshape(shift.shape + (1,) * (step.observation.ndim - shift.ndim))

        def add(term: RewardTerm) -> Array:
            # What a term says of a ball that is over, perhaps no number, must not reach the sum.
            value = jnp.asarray(term(step)).astype(alive.dtype)
            return before.terms[term.name] + jnp.where(s.live, value, 0.0)

        return Accumulators(
            closest=closest,
            steps=before.steps + alive,
            peak_velocity=jnp.maximum(before.peak_velocity, alive[None] * jnp.abs(step.command)),
            observation=before.observation + alive[None] * centred,
            observation_sq=before.observation_sq + alive[None] * centred * centred,
            terms={term.name: add(term) for term in self.config.rewards if term.per == "step"},
        )
