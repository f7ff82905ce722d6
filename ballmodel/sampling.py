"""Balls drawn from a human ball distribution, a box or a mixture.

A proposal is uniform in the box of start positions and velocities, without spin. It is kept when, in the full
simulation, it clears the net, bounces exactly once on the table, inside the landing box on the robot's side, and then
crosses the robot's end line. "Bounces once" ends there: a second bounce on the table rejects the ball, the floor
behind it does not count. A ball that leaves over the side after its bounce is kept, and arrives when it meets the
floor. A distribution with ``short_balls`` keeps balls that bounce a second time as well: people play them, and the
robot has to take them over the table.

Wide distributions keep few proposals, so a coarse flight first throws out those that miss net or landing box by a
margin larger than its own error; the full simulation alone decides about all others. Keeping the first n accepted
proposals of a stream of independent ones leaves the distribution unbiased.

A mixture proposes start states with spin and keeps most of them: its full simulation alone decides, in one compiled
loop. Its landing box is the robot's half of the table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from ballmodel import constants as c
from ballmodel.contact import NET, TABLE, elevation, surface_gap
from ballmodel.distribution import BallDistribution, BallMixture
from ballmodel.flight import BallParams, free_step, step
from ballmodel.partial_params import without_nominal
from ballmodel.state import BallState, ball_state
from ballmodel.vec import Scalars, Vector

DT = 1.0 / 300.0  # [s] simulation step
MAX_FLIGHT = 4.0  # [s] after which a ball counts as lost
PROPOSALS = 32768  # per call of the coarse flight
CHUNK = 2048  # balls per call of the full simulation
COARSE_STEPS = 32
NET_MARGIN = 0.03  # [m] error allowed to the coarse flight at the net
LANDING_MARGIN = 0.05  # [m] and at the landing point

# Outcomes of a proposal; 0 is "kept", the others are the constraints that fail.
OUTCOMES = (
    "kept",
    "start inside or under the table or in the net",
    "hit the net",
    "bounce on the human's side",
    "miss the table's top",
    "land outside the landing box",
    "bounce on the table a second time",
)
ROBOT_SIDE = ((-c.TABLE_WIDTH / 2, -c.TABLE_LENGTH / 2), (c.TABLE_WIDTH / 2, 0.0))  # [m] corners of its half
KEPT, BAD_START, HITS_NET, OWN_SIDE, MISSES, OUTSIDE_BOX, SECOND_BOUNCE = range(len(OUTCOMES))
UNDECIDED = -1


# x, y [m] of a corner of the landing box
Corner: TypeAlias = Float[Array, "2"] | tuple[Float[Array, ""] | float, Float[Array, ""] | float]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Throw:
    """Outcome of thrown balls."""

    outcome: Int[Array, " n"]  # index into OUTCOMES
    landing: Float[Array, "2 n"]  # [m] x, y of the first bounce; zero where there was none
    arrival: Float[Array, " n"]  # [s] to the robot's end line, the floor or the second bounce; zero for other outcomes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BallPool:
    """Balls of one distribution, ready to be thrown."""

    state: BallState  # (3, n) at the start
    arrival: Float[Array, " n"]  # [s] from the start until the ball crosses the robot's end line y = -1.37 m
    landing: Float[Array, "2 n"]  # [m] x, y of the bounce
    acceptance: Float[Array, ""]  # fraction of proposals kept
    rejected: Float[Array, " outcomes"]  # by OUTCOMES: fraction of proposals by outcome; the kept ones first

    def without_spin(self) -> BallPool:
        """The same balls, none of which spins: what is drawn with them spins as the model alone says."""
        return replace(self, state=replace(self.state, spin=jnp.zeros_like(self.state.spin)))


def _bad_start(position: Vector, params: BallParams) -> Bool[Array, " n"]:
    radius = params.flight.radius
    inside = (surface_gap(TABLE, params.table, position)[1] <= radius) | (
        surface_gap(NET, params.net, position)[1] <= radius
    )
    over_footprint = (jnp.abs(position[0]) < c.TABLE_WIDTH / 2) & (jnp.abs(position[1]) < c.TABLE_LENGTH / 2)
    return inside | (over_footprint & (elevation(params.table, position) < 0.0))


@jax.jit
def throw(
    params: BallParams,
    state: BallState,
    landing_min: Corner,
    landing_max: Corner,
    dt: Scalars = DT,
) -> Throw:
    """Follows balls, (3, n), through the full simulation until each is kept or has failed a constraint.

    landing_min, landing_max: (2,) [m] corners of the landing box; dt [s].
    """
    end, floor = -c.TABLE_LENGTH / 2, params.flight.radius - c.TABLE_HEIGHT

    def flying(carry: tuple) -> Array:
        time, _, outcome, *_ = carry
        return jnp.any(outcome == UNDECIDED) & (time < MAX_FLIGHT)

    # Reads the carried state and only events of the new one: what reads the new state computes all of the step again.
    def advance(carry: tuple) -> tuple:
        time, state, outcome, bounced, x, y, arrival, y_before = carry
        y_now = state.position[1]
        gone = (outcome == UNDECIDED) & ((y_now <= end) | (state.position[2] <= floor))
        outcome = jnp.where(gone, jnp.where(bounced, KEPT, MISSES), outcome)
        over = jnp.clip((end - y_now) / jnp.where(y_before > y_now, y_before - y_now, 1.0), 0.0, 1.0)
        arrival = jnp.where(gone & bounced, time - over * dt, arrival)

        new, events = step(params, state, dt)
        active = outcome == UNDECIDED
        first = active & events.table & ~bounced
        # strict=False: the height of a bounce on the table is known.
        x, y = (jnp.where(first, now, before) for now, before in zip(events.position, (x, y), strict=False))
        in_box = (x >= landing_min[0]) & (x <= landing_max[0]) & (y >= landing_min[1]) & (y <= landing_max[1])
        outcome = jnp.where(active & events.net, HITS_NET, outcome)
        again = active & events.table & bounced
        outcome, arrival = jnp.where(again, SECOND_BOUNCE, outcome), jnp.where(again, time + dt, arrival)
        outcome = jnp.where(first & ~in_box, jnp.where(y < 0.0, OUTSIDE_BOX, OWN_SIDE), outcome)
        from_below = elevation(params.table, events.position) < 0.0  # underside or side face
        outcome = jnp.where(first & from_below, MISSES, outcome)
        return time + dt, new, outcome, bounced | first, x, y, arrival, y_now

    zero = jnp.zeros_like(state.position[0])
    outcome = jnp.where(_bad_start(state.position, params), BAD_START, UNDECIDED)
    carry = (jnp.zeros((), zero.dtype), state, outcome, zero > 1.0, zero, zero, zero, state.position[1])
    _, _, outcome, bounced, x, y, arrival, _ = jax.lax.while_loop(flying, advance, carry)
    outcome = jnp.where(outcome == UNDECIDED, jnp.where(bounced, SECOND_BOUNCE, MISSES), outcome)
    return Throw(outcome, jnp.stack([x, y]), arrival)


def coarse_outcome(params: BallParams, state: BallState, landing_min: Corner, landing_max: Corner) -> Int[Array, " n"]:
    """Outcome, (n,), of those balls that clearly fail on the way to their first bounce; UNDECIDED for all others.

    Flies COARSE_STEPS second-order steps over a little more than each ball's fall time without air.
    """
    flight = replace(params.flight, integrator="midpoint")
    # Heights and climbs are those over the table, which may be tilted.
    table = replace(params.table, height=params.table.height + flight.radius)
    slopes = replace(params.table, height=0.0)
    gravity = -flight.gravity_z
    height, vz = elevation(table, state.position), elevation(slopes, state.velocity)
    fall = (vz + jnp.sqrt(jnp.maximum(vz * vz + 2.0 * gravity * height, 0.0))) / gravity
    dt = jnp.maximum(1.25 * fall, 0.1) / COARSE_STEPS
    net_x = NET.half[0] - NET_MARGIN
    net_z = c.NET_HEIGHT + params.net.height - NET_MARGIN

    def advance(carry: tuple[BallState, Array], _: None) -> tuple[tuple[BallState, Array], None]:
        state, outcome = carry
        new = free_step(flight, state, dt)
        # An unfinished ball that comes down to the table lands; the step's parabola says when.
        h, vz = elevation(table, state.position), elevation(slopes, state.velocity)
        az = (elevation(slopes, new.velocity) - vz) / dt
        lands = (h > 0.0) & (elevation(table, new.position) <= 0.0)
        t = 2.0 * h / jnp.maximum(jnp.sqrt(jnp.maximum(vz * vz - 2.0 * az * h, 0.0)) - vz, 1e-9)
        w = jnp.clip(t / dt, 0.0, 1.0)
        x, y = (state.position[i] * (1.0 - w) + new.position[i] * w for i in (0, 1))
        x_out = (x < landing_min[0] - LANDING_MARGIN) | (x > landing_max[0] + LANDING_MARGIN)
        y_out = (y < landing_min[1] - LANDING_MARGIN) | (y > landing_max[1] + LANDING_MARGIN)
        on_table = (jnp.abs(x) < c.TABLE_WIDTH / 2) & (jnp.abs(y) < c.TABLE_LENGTH / 2)
        miss = jnp.where(on_table, jnp.where(y > 0.0, OWN_SIDE, OUTSIDE_BOX), MISSES)
        # Crossing y = 0 before landing at less than the net's height hits it.
        y0, y1 = state.position[1], new.position[1]
        u = jnp.clip(y0 / jnp.where(y0 > y1, y0 - y1, 1.0), 0.0, 1.0)
        at_net = (y0 > 0.0) & (y1 <= 0.0) & (~lands | (u < w))
        x_net = state.position[0] * (1.0 - u) + new.position[0] * u
        climb, gain = state.velocity[2], (new.velocity[2] - state.velocity[2]) / dt
        z_net = state.position[2] + u * dt * (climb + 0.5 * u * dt * gain)
        blocked = at_net & (jnp.abs(x_net) < net_x) & (z_net < net_z) & (z_net > 0.0)
        verdict = jnp.where(lands, jnp.where(x_out | y_out, miss, KEPT), UNDECIDED)
        verdict = jnp.where(blocked, HITS_NET, verdict)
        return (new, jnp.where(outcome == UNDECIDED, verdict, outcome)), None

    start = jnp.where(_bad_start(state.position, params), BAD_START, UNDECIDED)
    (_, outcome), _ = jax.lax.scan(advance, (state, start), None, length=COARSE_STEPS)
    return jnp.where(outcome == KEPT, UNDECIDED, outcome)


@jax.jit
def _propose(
    key: PRNGKeyArray, params: BallParams, box: dict[str, tuple[Array, ...]]
) -> tuple[Float[Array, "6 n"], Int[Array, " n"]]:
    """Start positions and velocities, and the coarse flight's outcomes."""
    position, velocity = (
        jax.random.uniform(one, (3, PROPOSALS), minval=low[:, None], maxval=high[:, None])
        for one, (low, high) in zip(jax.random.split(key), (box["position"], box["velocity"]), strict=True)
    )
    outcome = coarse_outcome(params, ball_state(position, velocity), *box["landing"])
    return jnp.concatenate([position, velocity]), outcome


def sample_pool(
    key: PRNGKeyArray,
    distribution: BallDistribution | BallMixture,
    params: BallParams,
    n: int,
    dt: float = DT,
    min_acceptance: float = 1e-5,
) -> BallPool:
    """Draws ``n`` balls; the same key gives the same balls, and a larger n the same first ones.

    params: scalars (one ball model for the whole pool); dt [s] of the full simulation.
    Of a distribution with ``short_balls``, those count as kept, and arrive at their second bounce.
    Raises ValueError when fewer than ``min_acceptance`` of the proposals are kept, with the share that each constraint
    rejected.
    """
    if n < 1:
        raise ValueError(f"n is {n}; at least one ball is wanted")
    if isinstance(distribution, BallMixture):
        return _sample_mixture(key, distribution, without_nominal(params), n, dt, max(min_acceptance, 1e-3))
    params = without_nominal(params)
    box = {
        part: tuple(jnp.asarray(getattr(distribution, f"{part}_{end}")) for end in ("min", "max"))
        for part in ("position", "velocity", "landing")
    }
    fewest_proposals = int(np.ceil(10.0 / min_acceptance))

    waiting = np.empty((6, 0), np.float32)  # passed the coarse flight, not yet simulated
    kept: list[np.ndarray] = []
    coarse_counts, full_counts = np.zeros((2, len(OUTCOMES)))
    proposals = 0

    def shares() -> np.ndarray:
        """Fractions of all proposals by outcome; the waiting ones are taken to fare like the simulated ones."""
        passed = proposals - coarse_counts.sum()
        return coarse_counts / proposals + passed / proposals * full_counts / max(full_counts.sum(), 1)

    while full_counts[KEPT] < n:
        rows, outcome = map(np.asarray, _propose(jax.random.fold_in(key, proposals // PROPOSALS), params, box))
        proposals += PROPOSALS
        open_ = outcome == UNDECIDED
        coarse_counts += np.bincount(outcome[~open_], minlength=len(OUTCOMES))
        waiting = np.concatenate([waiting, rows[:, open_]], axis=1)
        while (missing := n - full_counts[KEPT]) > 0 and waiting.shape[1] >= min(CHUNK, 2 * missing):
            chunk, waiting = waiting[:, :CHUNK], waiting[:, CHUNK:]
            size = chunk.shape[1]
            padded = np.pad(chunk, ((0, 0), (0, CHUNK - size)), mode="edge")
            result = throw(params, ball_state(padded[:3], padded[3:]), *box["landing"], dt)
            outcome = np.asarray(result.outcome)[:size]
            if distribution.short_balls:
                outcome = np.where(outcome == SECOND_BOUNCE, KEPT, outcome)
            good = outcome == KEPT
            full_counts += np.bincount(outcome, minlength=len(OUTCOMES))
            found = np.concatenate([padded, np.asarray(result.arrival)[None], np.asarray(result.landing)])
            kept.append(found[:, :size][:, good])
        if proposals >= fewest_proposals and shares()[KEPT] < min_acceptance:
            raise ValueError(_complaint(distribution, proposals, shares()))

    table = jnp.asarray(np.concatenate(kept, axis=1)[:, :n])
    share = shares()
    state = ball_state(table[:3], table[3:6])
    return BallPool(state, table[6], table[7:9], jnp.asarray(share[KEPT]), jnp.asarray(share))


def _sample_mixture(
    key: PRNGKeyArray, mixture: BallMixture, params: BallParams, n: int, dt: float, min_acceptance: float
) -> BallPool:
    """Pool of a mixture's balls. Raises ValueError where fewer than ``min_acceptance`` of the proposals are kept."""
    components = [jnp.asarray(a, jnp.float32) for a in (np.log(np.maximum(mixture.weights, 1e-30)), mixture.means.T)]
    factors = jnp.asarray(np.moveaxis(mixture.factors, 0, -1), jnp.float32)
    most = int(np.ceil((n + 10.0) / min_acceptance / CHUNK))
    short = mixture.short_balls
    table, counts = _fill(key, params, *components, factors, jnp.float32(dt), jnp.int32(most), n=n, short=short)
    proposals = counts.sum()
    shares = counts / proposals
    if int(counts[KEPT]) < n:
        raise ValueError(_complaint(mixture, int(proposals), np.asarray(shares)))
    state = BallState(table[:3], table[3:6], table[6:9])
    return BallPool(state, table[9], table[10:12], shares[KEPT], shares)


@partial(jax.jit, static_argnames=("n", "short"))
def _fill(
    key: PRNGKeyArray,
    params: BallParams,
    log_weights: Float[Array, " k"],
    means: Float[Array, "9 k"],
    factors: Float[Array, "9 9 k"],
    dt: Float[Array, ""],
    most: Int[Array, ""],
    n: int,
    short: bool,
) -> tuple[Float[Array, "12 n"], Float[Array, " outcomes"]]:
    """State (9), arrival and landing (2) of the first n balls kept of at most ``most`` chunks, and the outcomes.

    short: balls that bounce twice are kept.
    """

    def unfilled(carry: tuple[Array, Array, Array]) -> Array:
        calls, counts, _ = carry
        return (counts[KEPT] < n) & (calls < most)

    def advance(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        calls, counts, table = carry
        key_component, key_normal = jax.random.split(jax.random.fold_in(key, calls))
        component = jax.random.categorical(key_component, log_weights, shape=(CHUNK,))
        normal = jax.random.normal(key_normal, (9, CHUNK), jnp.float32)
        rows = means[:, component] + jnp.sum(factors[:, :, component] * normal[None], axis=1)
        thrown = throw(params, BallState(rows[:3], rows[3:6], rows[6:]), *ROBOT_SIDE, dt)
        outcome = jnp.where(short & (thrown.outcome == SECOND_BOUNCE), KEPT, thrown.outcome)
        order = jnp.argsort(outcome != KEPT, stable=True)
        rows = jnp.concatenate([rows, thrown.arrival[None], thrown.landing])[:, order]
        table = jax.lax.dynamic_update_slice(table, rows, (0, counts[KEPT].astype(jnp.int32)))
        found = jnp.sum(outcome[None] == jnp.arange(len(OUTCOMES))[:, None], axis=1)
        return calls + 1, counts + found, table

    zero = jnp.zeros((), jnp.int32)
    start = (zero, jnp.zeros(len(OUTCOMES), jnp.int32), jnp.zeros((12, n + CHUNK), jnp.float32))
    _, counts, table = jax.lax.while_loop(unfilled, advance, start)
    return table[:, :n], counts.astype(jnp.float32)


def _complaint(distribution: BallDistribution | BallMixture, proposals: int, shares: np.ndarray) -> str:
    reasons = sorted(
        ((share, text) for share, text in zip(shares[1:], OUTCOMES[1:], strict=True) if share > 0), reverse=True
    )
    listed = ", ".join(f"{share:.4%} {text}" for share, text in reasons)
    return f"distribution {distribution.name!r} keeps {shares[KEPT]:.2g} of {proposals:,} proposals: {listed}"
