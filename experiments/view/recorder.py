"""Replays of simulated balls: whole episodes in one compiled call, with parameters that are traced.

Moving a slider changes numbers and never the program. What is random in an episode belongs to the number of its ball,
so the same ball meets the same latencies and noise under other parameters and another policy.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ballmodel import flight
from ballmodel.partial_params import without_nominal
from ballmodel.state import BallState, where
from experiments.view.replay import RATE, Replay, Series, upsample
from mjx_tt import platform
from mjx_tt.env.episode import HIT, MISSED, RETURNED, Episodes
from mjx_tt.env.policy import NetworkController, Policy, PolicyController
from mjx_tt.env.policy import controller as controller_of
from mjx_tt.env.return_flight import fly_return
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig, evaluate_rewards
from mjx_tt.sim import model as models
from mjx_tt.sim.model import LATENCIES, ModelFile, SimModel
from robot_io.contract import JOINT_NAMES

# Few episodes are computed: a program that compiles in a third of the time is worth more than a fast one.
FAST_COMPILE = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
} | ({"xla_cpu_use_fusion_emitters": False} if platform.older_fusion() else {})
LANES = 32  # episodes of one call, whatever the number of policies
FLOOR = -0.72  # [m] of the ball's centre, where a replay ends
OUTCOMES = {MISSED: "missed", HIT: "hit, not returned", RETURNED: "returned"}


@dataclass(frozen=True)
class Slider:
    """A slider of a parameter: path in SimModel, label, range in the label's unit, and that unit in SI."""

    path: str
    label: str
    low: float
    high: float
    step: float
    unit: float = 1.0


MILLI = 1e-3
DRIVES = "Gains of the drives"
COMMON_SLIDERS = {
    "Latencies": (
        Slider("latency.ball_observation", "ball [ms]", 0.0, 100.0, 1.0, MILLI),
        Slider("latency.abb_observation", "arm's joints [ms]", 0.0, 100.0, 1.0, MILLI),
        Slider("latency.festo_observation", "axes [ms]", 0.0, 100.0, 1.0, MILLI),
        Slider("latency.abb_action", "arm's action [ms]", 0.0, 130.0, 1.0, MILLI),
        Slider("latency.festo_action", "axes' action [ms]", 0.0, 130.0, 1.0, MILLI),
    ),
    "Ball": (
        Slider("ball.table.restitution", "table's restitution", 0.5, 1.0, 0.01),
        Slider("ball.table.friction", "table's friction", 0.0, 0.6, 0.01),
        Slider("ball.paddle.restitution", "rubber's restitution", 0.3, 1.2, 0.01),
        Slider("ball.flight.magnus_coefficient", "lift of spin", 0.0, 2.5, 0.05),
        Slider("ball.flight.drag_coefficient", "drag", 0.0, 1.0, 0.01),
    ),
    "Noise": (
        Slider("sensing.ball_noise", "tracker [mm]", 0.0, 150.0, 1.0, MILLI),
        Slider("latency.ball_observation_std", "ball's latency [ms]", 0.0, 30.0, 0.5, MILLI),
    ),
}


def slider_groups(joints: tuple[str, ...] = JOINT_NAMES) -> dict[str, tuple[Slider, ...]]:
    """The sliders of a robot with these joints, in the order of the page."""
    gains = tuple(Slider(f"drives.{joint}.velocity_gain", joint, 0.5, 1.5, 0.01) for joint in joints)
    return COMMON_SLIDERS | {DRIVES: gains}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Draws:
    """Balls (3, L) with the chance that belongs to them: standard normals (5, L) and (3, L), uniforms (k, L), seeds."""

    ball: BallState
    latency: Any
    spin: Any
    model: Any
    seed: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RecordingController:
    """The policy, remembering its last input and output."""

    policy: PolicyController | NetworkController
    n_joints: int = field(metadata={"static": True})

    @property
    def mean(self) -> Array:
        return self.policy.mean

    def start(self, observation: Array) -> Any:
        action = jnp.zeros((self.n_joints, *observation.shape[1:]))
        return self.policy.start(observation), observation, action

    def act(self, tick: Any, state: Any, observation: Array) -> tuple[Array, Any]:
        action, inner = self.policy.act(tick, state[0], observation)
        return action, (inner, observation, action)


class Recorder:
    """Plays balls in one world; compiles once."""

    def __init__(self, task: TaskConfig, world: ModelFile) -> None:
        self.simulator, self.world = Simulator(task), world
        self.episodes = jax.jit(self._episodes)
        self._record = jax.jit(self._play, compiler_options=FAST_COMPILE if jax.default_backend() == "cpu" else None)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the robot's joints."""
        return self.simulator.task.contract.joints

    def nominal(self) -> dict[str, float]:
        """Values of the sliders in this world; NaN for a parameter that is drawn for every episode."""
        known = models.paths(self.world.model)
        drawn = {path for one in self.world.randomise for path in one.paths}
        paths = [slider.path for group in slider_groups(self.joints).values() for slider in group]
        return {path: float("nan") if path in drawn else float(known[path]) for path in paths}

    def draws(self, state: np.ndarray, numbers: Sequence[int], seed: int) -> Draws:
        """Balls with position, velocity and spin ``state`` (9, n), each with its number's chance."""
        chance = [np.random.default_rng([seed, number]) for number in numbers]
        normal = np.stack([r.standard_normal(8) for r in chance], axis=1).astype(np.float32)
        uniform = np.stack([r.random(len(self.world.randomise)) for r in chance], axis=1).astype(np.float32)
        seeds = np.array([r.integers(2**32, dtype=np.uint32) for r in chance], np.uint32)
        state = state.astype(np.float32)
        return Draws(BallState(state[:3], state[3:6], state[6:]), normal[:5], normal[5:], uniform, seeds)

    def model(self, draws: Draws, values: Mapping[str, Any]) -> SimModel:
        """The world's model with the sliders' values, each (L,)."""
        drawn = {p: v for i, one in enumerate(self.world.randomise) for p, v in one.at(draws.model[i]).items()}
        for path, value in values.items():
            moved = jnp.broadcast_to(jnp.asarray(value, jnp.float32), draws.seed.shape)
            drawn[path] = jnp.where(jnp.isnan(moved), drawn[path], moved) if path in drawn else moved
        model = without_nominal(models.with_values(self.world.model, drawn))
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), model)

    def _episodes(self, draws: Draws, values: Mapping[str, Any]) -> Episodes:
        config, model, shape = self.simulator.config, self.model(draws, values), draws.seed.shape

        def rows(part: Any, names: Iterable[str]) -> Array:
            return jnp.stack([jnp.broadcast_to(getattr(part, name), shape) for name in names])

        mean, std = (rows(model.latency, [name + end for name in LATENCIES]) for end in ("", "_std"))
        longest = jnp.array([config.max_observation_latency] * 3 + [config.max_action_latency] * 2)[:, None]
        latency = jnp.clip(mean + std * draws.latency, 0.0, longest)
        mean, std = (rows(model.ball_spin, [f"{kind}_{axis}" for axis in "xyz"]) for kind in ("mean", "std"))
        spin = draws.ball.spin + mean + std * draws.spin
        home = jnp.broadcast_to(jnp.asarray(self.simulator.task.home, jnp.float32)[:, None], (len(self.joints), *shape))
        return Episodes(replace(draws.ball, spin=spin), latency, jnp.asarray(draws.seed), model, home)

    def record(self, policies: Sequence[Policy], episodes: Episodes) -> dict[str, np.ndarray]:
        """Everything about episodes (L,), each played by its policy; the episode is the last axis."""
        missing = LANES - len(policies)

        def padded(x: Any) -> Array:
            x = jnp.asarray(x)
            return jnp.concatenate([x, jnp.repeat(x[..., -1:], missing, axis=-1)], axis=-1) if x.ndim else x

        stacked = jax.tree.map(lambda *x: np.stack(x, axis=-1), *policies)
        policy, episodes = jax.tree.map(padded, (stacked, episodes))
        recorded = self._record(policy, episodes)
        return {name: np.asarray(x)[..., : len(policies)] for name, x in recorded.items()}

    def _play(self, policy: Policy, episodes: Episodes) -> dict[str, Array]:
        """The episodes tick by tick (max_steps, ..., L), then balls that are over flying on alone, and the result."""
        task, config = self.simulator.task, self.simulator.config
        controller = RecordingController(controller_of(policy), len(self.joints))
        constants, start = task.prepare(episodes), task.reset(episodes, controller)
        alone = replace(episodes.model.ball, flight=replace(episodes.model.ball.flight, integrator="midpoint"))

        def advance(carry: tuple, tick: Array) -> tuple[tuple, dict[str, Array]]:
            state, ball = carry
            new = task.step(tick, state, episodes, constants, controller)
            _, observation, action = new.controller
            shown = {
                "qpos": state.qpos,
                "ball": ball.position,
                "velocity": ball.velocity,
                "live": state.live,
                "observation": observation,
                "action": action,
            }
            flown, _ = flight.step(alone, ball, config.period)
            return (new, where(state.live, new.ball, flown)), shown

        (state, _), shown = jax.lax.scan(advance, (start, start.ball), jnp.arange(config.max_steps))
        back = fly_return(config, state.ball, state.hit & state.finite, episodes.model)
        terms = evaluate_rewards(config.rewards, state, back)
        returned = state.hit & back.returned & state.finite
        outcome = jnp.where(returned, RETURNED, jnp.where(state.hit & state.finite, HIT, MISSED))
        return {**shown, "terms": terms, "outcome": outcome, "hit": state.hit}

    def replays(self, recorded: dict[str, np.ndarray], titles: Sequence[str]) -> list[Replay]:
        """A replay of every episode."""
        return [self._replay({k: v[..., i] for k, v in recorded.items()}, title) for i, title in enumerate(titles)]

    def _replay(self, r: dict[str, np.ndarray], title: str) -> Replay:
        period = self.simulator.config.period
        factor = round(RATE * period)
        over = int(np.argmin(r["live"])) if not r["live"].all() else len(r["live"]) - 1
        grounded = np.flatnonzero(r["ball"][over:, 2] < FLOOR)
        last = min(over + int(grounded[0]) + 1 if grounded.size else len(r["ball"]), len(r["ball"])) - 1
        ticks = np.arange(last + 1) * period
        time = np.arange(factor * last + 1) / RATE
        ball = upsample(r["ball"][: last + 1], r["velocity"][: last + 1], period, factor)
        qpos = np.stack([np.interp(time, ticks, q) for q in r["qpos"][: last + 1].T], axis=1)
        played = slice(0, over + 1)
        speeds = np.linalg.norm(r["velocity"], axis=1)
        text = f"{OUTCOMES[int(r['outcome'])]}, {speeds[0]:.1f} m/s"
        if r["hit"]:
            text += f" in, {speeds[over]:.1f} m/s out"
        terms = zip(self.simulator.config.terms, r["terms"], self.simulator.config.reward_weights, strict=True)
        seen, joints = r["observation"][played], self.joints
        return Replay(
            time=time,
            qpos=qpos,
            balls={"ball": ball},
            title=title,
            outcome=text,
            decided=over * period,
            contact=over * period if r["hit"] else float("nan"),
            series={
                "Input: ball as seen [m]": Series(("x", "y", "z"), ticks[played], seen[:, :3]),
                "Input: joints as seen [m, rad]": Series(joints, ticks[played], seen[:, 3 : 3 + len(joints)]),
                "Output: share of the joints' speed": Series(joints, ticks[played], r["action"][played]),
            },
            terms={name: (float(value), float(weight)) for name, value, weight in terms},
        )
