"""A virtual reality: a simulation that differs from that of training in ways that training does not know.

Each effect moves a few parameters of ``SimModel`` to values drawn from a range around measured ones; an effect that is
left out keeps what training believes. The draw depends on the seed and on the parameter's name only, so leaving out one
effect changes no other. Balls spin as the player hits them; training believes that none does. Effects from outside of
the model's class are added only where a study names them.

What was drawn is written down when a study is over. The learner gets measured balls and rewards.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PRNGKeyArray

from ballmodel import flight
from ballmodel.constants import TABLE_LENGTH
from ballmodel.flight import BallParams
from ballmodel.partial_params import without_nominal
from ballmodel.state import BallState
from ballmodel.trajectory import Trajectory
from mjx_tt.sim import model as models
from mjx_tt.sim import sensors
from mjx_tt.sim.model import SimModel
from robot_io.contract import FESTO_JOINTS, JOINT_NAMES

CAMERA_RATE = 125.0  # [Hz], the paper's cameras
Carry = tuple[BallState, Array, Array, Array, Array]  # ball, bounced, seconds since, still seen, frames seen

_SUBSTEPS = 4  # physics per camera frame
_LONGEST = 1.6  # [s] that a ball is followed
_AFTER_BOUNCE = 0.12  # [s] that a measured trajectory goes on after the bounce, which ends the free flight

_DRIVES = {
    f"drives.{name}.{effect}": bounds
    for i, name in enumerate(JOINT_NAMES)
    for effect, bounds in (
        ("lag", (0.0, 0.030) if i in FESTO_JOINTS else (0.0, 0.016)),  # [s]
        ("velocity_gain", (0.95, 1.05)),
    )
}
_ENCODERS = {
    f"drives.{name}.joint_offset": (-0.006, 0.006) if i in FESTO_JOINTS else (-0.012, 0.012)  # [m], [rad]
    for i, name in enumerate(JOINT_NAMES)
}
# Each range lies about the best measured value, and what training believes lies within it. What cannot be negative
# (lift, decay, lag) begins at training's zero.
#   rubber   0.917 and 0.68 +- the spread of three rackets that grip (restitution 0.813 to 0.917, gains 0.67 to 0.69 as
#            new: github.com/gossardt/tt_rackets), for another make, wear and dust
#   table    0.93 and 0.25 (Nakashima) +- what others use: 0.85 to 0.98 and 0.10 to 0.30; ITTF's rule (23 cm from 30 cm)
#            is 0.876
#   magnus   k 0.65 fitted to SpinDOE's measured spins; others 0 (the paper), 0.32, 1.33, 1.47
#   latency  the paper's means +- 1.5 of the deviations in its table; from the actions half of the lags' range is taken
#            off, since a delay that is measured from command to motion has it in it
#   drives   lag: a second filter up to twice as slow as the servo's (EGM's default low-pass has 8 ms); gain within 5 %
#   encoders an axis with its nominal feed constant is off by 4.4 mm over 2 m (CMMP manual), the arm by 0.7 degrees
#   camera   within a centimetre, half a degree, half a per cent (estimates)
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "rubber": {"ball.paddle.restitution": (0.847, 0.987), "ball.paddle.tangential_gain": (0.56, 0.80)},
    "table": {"ball.table.restitution": (0.895, 0.965), "ball.table.friction": (0.15, 0.35)},
    "magnus": {"ball.flight.magnus_coefficient": (0.0, 1.3), "ball.flight.spin_decay": (0.0, 0.1)},
    "spin": {},  # of the player's strokes, which is not the model's
    "noise": {"sensing.ball_noise": (0.003, 0.010)},  # [m]; training's 40 mm is a precaution, no measurement
    "latency": {
        "latency.ball_observation": (0.028, 0.052),
        "latency.abb_observation": (0.017, 0.041),
        "latency.festo_observation": (0.020, 0.046),
        "latency.abb_action": (0.0545, 0.0715),
        "latency.festo_action": (0.0325, 0.0665),
    },
    "camera": {
        **{f"sensing.ball_offset_{axis}": (-0.012, 0.012) for axis in "xyz"},
        **{f"sensing.camera_rotation_{axis}": (-0.008, 0.008) for axis in "xyz"},
        "sensing.camera_scale": (0.995, 1.005),
    },
    "drives": _DRIVES,
    "encoders": _ENCODERS,
}
# What neither training's parameters nor the prior of an identification have, in place of what they have for it.
#   lift     C_L = S / (0.55 + 3.55 S) within 10 %, fitted to 1,597 shots with measured spin (``aerodynamics``); the
#            diagnosis has an entry for saturation
#   bounce   restitution falls with speed: the table's by a tenth to a quarter over 10 m/s (estimate; the diagnosis has
#            an entry for it), the rubber's less than that of training's racket (0.007 to 0.018 s/m of other rackets,
#            github.com/gossardt/tt_rackets)
#   blade    a sweet spot: at its rim the blade returns less of the speed (estimate)
#   mount    the arm's base and wrist bend: resonances of 10 to 20 Hz; the encoders do not see it
OUTSIDE: dict[str, dict[str, tuple[float, float]]] = {
    "lift": {"ball.flight.magnus_coefficient": (1.64, 2.0), "ball.flight.lift_saturation": (5.8, 7.1)},
    "bounce": {"ball.table.restitution_slope": (0.010, 0.025), "ball.paddle.restitution_slope": (0.007, 0.018)},
    "blade": {"ball.paddle.rim_loss": (0.2, 0.5)},
    "mount": {f"drives.{name}.resonance": (10.0, 20.0) for name in ("joint_1", "joint_2", "joint_5")},  # [Hz]
}


def draw(seed: int, without: tuple[str, ...] = (), outside: tuple[str, ...] = ()) -> SimModel:
    """The reality of that study seed, without the named effects and with those of ``OUTSIDE`` that are named.

    Raises ValueError for an unknown effect.
    """
    for kind, names, known in (("effect", without, RANGES), ("effect outside of the model", outside, OUTSIDE)):
        for name in names:
            if name not in known:
                raise ValueError(f"no {kind} is called {name!r}; there are {', '.join(known)}")
    drawn = [ranges for effect, ranges in RANGES.items() if effect not in without]
    drawn += [ranges for effect, ranges in OUTSIDE.items() if effect in outside]
    values = {path: _uniform(seed, path, *bounds) for ranges in drawn for path, bounds in ranges.items()}
    return models.with_values(SimModel(), values)


def _uniform(seed: int, path: str, low: float, high: float) -> float:
    return float(np.random.default_rng([seed, zlib.crc32(path.encode())]).uniform(low, high))


def list_differences(model: SimModel) -> dict[str, float]:
    """Values of a reality that differ from what training believes, by dotted path."""
    nominal = models.paths()
    return {path: float(value) for path, value in models.paths(model).items() if value != nominal[path]}


def describe(model: SimModel, seed: int, without: tuple[str, ...], outside: tuple[str, ...] = ()) -> dict[str, Any]:
    """The reality as plain data."""
    found: dict[str, Any] = {"seed": seed, "without": list(without), "reality": list_differences(model)}
    return found | ({"outside": list(outside)} if outside else {})


@dataclass(frozen=True)
class Measured:
    """Tracks of n balls at CAMERA_RATE: what cameras deliver."""

    position: np.ndarray  # (T, 3, n) [m]
    length: np.ndarray  # (n,) samples of each that were taken

    def trajectories(self, session: str, first: int = 0) -> tuple[Trajectory, ...]:
        """Named by number from ``first`` on; balls of fewer than two samples are left out."""
        time = np.arange(self.position.shape[0]) / CAMERA_RATE
        return tuple(
            Trajectory(session, str(first + i), time[:k], self.position[:k, :, i].T)
            for i, k in enumerate(self.length)
            if k >= 2
        )


@partial(jax.jit, static_argnames="frames")
def _fly(params: BallParams, state: BallState, frames: int) -> tuple[Array | np.ndarray, Array]:
    """Positions (frames, 3, n) at the camera's rate and how many of them (n,) are taken."""
    dt = 1.0 / (CAMERA_RATE * _SUBSTEPS)

    def substep(_: Array, carry: tuple[BallState, Array]) -> tuple[BallState, Array]:
        state, bounced = carry
        new, events = flight.step(params, state, dt)
        return new, bounced | events.table

    def frame(carry: Carry, _: None) -> tuple[Carry, Array | np.ndarray]:
        state, bounced, since, seen, length = carry
        gone = (state.position[1] < -0.5 * TABLE_LENGTH - 0.3) | (state.position[2] < -0.5) | (since > _AFTER_BOUNCE)
        seen = seen & ~gone
        after, bounced = jax.lax.fori_loop(0, _SUBSTEPS, substep, (state, bounced))
        since = since + jnp.where(bounced, 1.0 / CAMERA_RATE, 0.0)
        return (after, bounced, since, seen, length + seen), state.position

    none = jnp.zeros(state.position.shape[1:], bool)
    start = (state, none, jnp.zeros(none.shape), ~none, jnp.zeros(none.shape, jnp.int32))
    (*_, length), positions = jax.lax.scan(frame, start, None, length=frames)
    return positions, length


def measure(model: SimModel, balls: BallState, noise: float, key: PRNGKeyArray) -> Measured:
    """Balls (3, n) as the reality's cameras see them from the player's contact on: physics, calibration, noise [m]."""
    n = balls.position.shape[1]
    padded = jax.tree.map(lambda x: jnp.pad(jnp.asarray(x, jnp.float32), ((0, 0), (0, -n % 256)), mode="edge"), balls)
    positions, length = _fly(without_nominal(model.ball), padded, round(_LONGEST * CAMERA_RATE))
    tracked = observe(model, jnp.moveaxis(positions, 1, 0), noise, key)
    return Measured(np.moveaxis(tracked, 0, 1)[..., :n], np.asarray(length)[:n])


def observe(model: SimModel, position: Array | np.ndarray, noise: float, key: PRNGKeyArray) -> np.ndarray:
    """Positions (3, ...) [m] as the reality's cameras give them: calibration and noise [m]."""
    camera = sensors.make_camera(model.sensing)
    place = jnp.asarray(position) if camera is None else camera.project(jnp.asarray(position))
    offset = jnp.array([getattr(model.sensing, f"ball_offset_{axis}") for axis in "xyz"])
    offset = offset.reshape((3,) + (1,) * (place.ndim - 1))
    return np.asarray(place + offset + noise * jax.random.normal(key, place.shape), np.float64)
