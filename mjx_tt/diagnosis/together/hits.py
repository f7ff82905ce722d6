"""Posterior of rubber, delays of ball and axes, encoders' zeros and the camera's sideways offset, from hits.

None of these shows in a ball before its hit or in the joints alone, and none can be told apart in a single hit; they
are ordinary sizes of what every installation has. So nothing is named here: each has a prior, and the maximum of the
posterior is sought by Gauss-Newton on the returns' place and velocity behind the paddle. Every hit has delays of its
own besides (``hit_scatter``), at which it is linearised; what else it scatters by is the noise, as in ``diagnose``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.flights.fit import first_fit, fit_starts, heading
from mjx_tt.diagnosis.ball.flights.forward_model import grid, predict
from mjx_tt.diagnosis.ball.flights.linearization import BallProblem
from mjx_tt.diagnosis.hits.diagnose import FARTHEST, FEWEST_HITS, line_behind, watched_hits
from mjx_tt.diagnosis.hits.paddle_path import JointPath, poses
from mjx_tt.diagnosis.together.balls import LIFT_ERROR, BallsTogether
from mjx_tt.diagnosis.together.hit_scatter import believed_delays, scatter
from mjx_tt.sim.randomisation import Samples
from robot_io.contract import FESTO_JOINTS, JOINT_NAMES

RUBBER = ("ball.paddle.restitution", "ball.paddle.tangential_gain")
CAMERA = ("sensing.ball_offset_x", "sensing.ball_offset_y")
# Against the arm's delay, which is taken as believed: the clock's origin shows nowhere.
DELAYS = BALL, AXES = ("latency.ball_observation", "latency.festo_observation")
# The frame is the table's: bounces that lie too high are a camera that sees high, not a table that stands there.
HEIGHT, SEEN_HIGH = "ball.table.height", "sensing.ball_offset_z"
ZEROS = tuple(f"drives.{joint}.joint_offset" for joint in JOINT_NAMES)
SHOWN = (*RUBBER, *DELAYS, *CAMERA, *ZEROS)  # by hits, and by no other log
LIFT = "lift"  # error of its coefficient, along which the balls' parameters go
STEP = 0.05  # of a prior's deviation, by which derivatives are taken
ROUNDS, INNER = 6, 3
# Times the noise that hits scatter by. What all hits share is wrong as well: spins that a flight hardly shows, a
# camera's yaw, the balls' own parameters. Over twenty realities, half of them from outside of the model's class, errors
# of rubber and delays were 0.5 to 2.3 times what the scatter gives.
WIDER = 2.0
SETTLED = 0.1  # deviations
STEEP = 10.0  # times the median hit's slope: beyond it a hit is at the blade's edge, not on a slope
DRAWS = 256
Prior = Mapping[str, tuple[float, float]]  # mean and standard deviation by dotted path


@dataclass(frozen=True)
class HitsTogether:
    """Gaussian posterior of parameters by dotted path, and last of LIFT; zeros as measured less true position."""

    paths: tuple[str, ...]
    mean: Float[np.ndarray, " P"]
    covariance: Float[np.ndarray, "P P"]
    hits: int

    def samples(
        self, ranges: Mapping[str, tuple[float, float]], seed: int = 0
    ) -> tuple[Samples, Float[np.ndarray, " S"]]:
        """Draws, kept within the ranges given by path; and the error of the balls' lift in each of them."""
        drawn = np.random.default_rng(seed).multivariate_normal(self.mean, self.covariance, DRAWS, method="eigh")
        low, high = (np.array([ranges[path][end] for path in self.paths[:-1]]) for end in (0, 1))
        return Samples(self.paths[:-1], np.clip(drawn[:, :-1], low, high), np.ones(DRAWS)), drawn[:, -1]


def fit(
    balls: BallsTogether, trajectories: Sequence[Trajectory], path: JointPath | None, prior: Prior
) -> HitsTogether | None:
    """The posterior after the hits among the trajectories; None where there are fewer than FEWEST_HITS of them.

    balls: what flights before a hit say, which is taken as settled but for the lift; a table that lies high in it is a
    camera that sees high, since the robot stands in the table's frame. path: of the joints on the balls' clock, as late
    as the model of ``balls`` has it, with the zeros that were reported. prior: of those of ``SHOWN`` that are sought;
    the others stay as they are.
    """
    pairs = watched_hits(trajectories, path)
    if len(pairs) < FEWEST_HITS or path is None:
        return None
    prior = {**prior, LIFT: (0.0, LIFT_ERROR)}
    names = (*(name for name in SHOWN if name in prior), LIFT)
    whole, before = [t for t, _ in pairs], np.array([n for _, n in pairs])
    g = grid(whole)
    incoming = np.arange(len(g.time))[:, None] < before[None]
    problem = BallProblem(g, balls.problem.model, balls.problem.effects, heading(g))
    # The spin that a ball's own flight and bounce show decides where the rubber sends it.
    theta, spins = balls.posterior.theta, balls.spins
    spins = spins and replace(spins, own_mean=None, own_covariance=None)
    first = first_fit(problem, theta, None if spins is None else spins.mean, incoming)
    before_hit = replace(g, mask=g.mask & incoming)
    out = g.mask & ~incoming

    @cache
    def started(lift: float) -> np.ndarray:
        return fit_starts(problem, balls.along_lift(lift), first, before_hit, None, spins)

    def seen(values: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measured positions (3, T, n) that the model plays with each hit's own delays, and when each is hit (n,)."""
        at = dict(zip(names, values, strict=True))
        zeros = [at.get(name, 0.0) for name in ZEROS]
        moved = replace(path, position=tuple(q - zero for q, zero in zip(path.position, zeros, strict=True)))
        ball, axes = (
            at.get(name, problem.nominal[name]) - problem.nominal[name] + mine
            for name, mine in zip(DELAYS, own, strict=True)
        )
        late = np.stack([ball - axes if i in FESTO_JOINTS else ball for i in range(len(JOINT_NAMES))])
        changed = problem.values(balls.along_lift(float(at[LIFT]))[:, None, None])
        begin = started(float(at[LIFT])).copy()
        if HEIGHT in changed:
            high = changed[HEIGHT] - problem.nominal[HEIGHT]
            changed |= {HEIGHT: changed[HEIGHT] - high, SEEN_HIGH: problem.nominal[SEEN_HIGH] + high}
            begin[2] -= high[0, 0]
        for name in (*RUBBER, *CAMERA):
            if name in at:
                changed[name] = np.full((1, 1), at[name])
        for i, name in enumerate(CAMERA):  # the ball is where the camera's offset puts it
            begin[i] -= at.get(name, problem.nominal[name]) - problem.nominal[name]
        paddle = poses(whole, g.steps, moved, late)
        flown = predict(problem.model, changed, begin[:, None], replace(g, paddle=paddle), problem.axes)
        return flown.measured[:, :, 0], flown.hit_time[0]

    mean, deviation = np.array([prior[name] for name in names]).T
    values, precision, own = mean.copy(), np.diag(deviation**-2.0), np.zeros((2, g.n))
    jitter = believed_delays(problem.model.latency)
    for _ in range(ROUNDS):
        base, hit = seen(values, own)
        behind = line_behind(g, out, hit)
        y = behind(np.where(out, g.measured - base, 0.0))
        usable = np.isfinite(hit) & (np.linalg.norm(y[:3], axis=0) < FARTHEST)
        sizes = np.concatenate([STEP * deviation, STEP * np.sqrt(np.diagonal(jitter)) + 1e-6])
        columns = []  # by the values and by the delays of each hit's own, which all hits are moved by at once
        for step, size in zip(np.diag(sizes), sizes, strict=True):
            other, met = seen(values + step[:-2], own + step[-2:, None])
            columns.append(behind(np.where(out, other - base, 0.0)) / size)
            usable &= np.isfinite(met)
        usable &= smooth(np.array(columns))
        if usable.sum() < FEWEST_HITS:
            return None
        jacobian, slopes = np.split(np.array(columns)[:, :, usable], [len(values)])
        y = y[:, usable] + np.einsum("kcn,kn->cn", slopes, own[:, usable])  # of hits without delays of their own
        change = np.zeros(len(values))
        for _ in range(INNER):  # the scatter is what the change leaves over
            left = y - np.einsum("kcn,k->cn", jacobian, change)
            noise = scatter(left, slopes, jitter)
            inverse = np.linalg.inv(noise.covariance(slopes)) * noise.weight[:, None, None] / WIDER**2
            covariance = np.linalg.inv(np.einsum("kcn,ncd,ldn->kl", jacobian, inverse, jacobian) + precision)
            right = np.einsum("kcn,ncd,dn->k", jacobian, inverse, y)
            change = covariance @ (right + precision @ (mean - values))
        values = values + change
        own[:, usable] = noise.own(y - np.einsum("kcn,k->cn", jacobian, change), slopes)
        if np.max(np.abs(change) / np.sqrt(np.diagonal(covariance))) < SETTLED:
            break
    return HitsTogether(names, values, covariance, int(usable.sum()))


def smooth(columns: Float[np.ndarray, "P 6 n"]) -> Bool[np.ndarray, " n"]:
    """False for hits whose velocity changes by any value STEEP times as much as the median hit's.

    One of them, met or missed within a difference, would decide that value to a tenth of a millimetre by itself.
    """
    size = np.linalg.norm(columns[:, 3:], axis=1)
    return np.all(size <= STEEP * np.median(size, axis=1, keepdims=True) + 1e-12, axis=0)
