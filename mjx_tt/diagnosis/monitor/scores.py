"""Scores of single balls: in which direction each one asks the believed world to be changed.

A score is the derivative of the logarithm of a ball's likelihood by an effect of the catalogue, over its deviation
(Rao, Proc. Camb. Phil. Soc. 44, 1948): of the flight up to the robot, with start, spin and the bounce's scatter
integrated out; of the return behind a hit, whose six numbers count as they are as well; and of each joint's motion
meanwhile. In the believed world scores scatter about a constant. A change moves those of the effects that look like it.
A large one bends flights more than derivatives tell; how badly flights and returns fit shows it all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.diagnose import flights
from mjx_tt.diagnosis.ball.effects import EFFECTS
from mjx_tt.diagnosis.ball.flights import marginal, noise
from mjx_tt.diagnosis.ball.flights.fit import first_fit, fit_starts, heading
from mjx_tt.diagnosis.ball.flights.forward_model import PAD, Grid, grid
from mjx_tt.diagnosis.ball.flights.linearization import BallProblem, Situation
from mjx_tt.diagnosis.ball.flights.spin_prior import SpinPrior
from mjx_tt.diagnosis.hits.diagnose import FARTHEST, compare_returns, spread, watched_hits
from mjx_tt.diagnosis.hits.paddle_path import JointPath, joint_path, poses
from mjx_tt.diagnosis.joint.fit import slopes
from mjx_tt.diagnosis.joint.forward_model import nominal_response
from mjx_tt.diagnosis.joint.log import SHORTEST, JointLog, JointRecord
from mjx_tt.sim.model import SimModel
from robot_io.contract import JOINT_NAMES

FLIGHT_EFFECTS = tuple(e for e in EFFECTS if e.fit and not e.at_paddle and not e.made_of)
HIT_EFFECTS = tuple(e for e in EFFECTS if e.at_paddle)
JOINT_EFFECTS = ("lag", "velocity_gain", "action_delay")
RETURN = (*(f"return_{what}_{axis}" for what in ("place", "velocity") for axis in "xyz"), "return_misfit")
NAMES = (
    *(e.name for e in FLIGHT_EFFECTS),
    "flight_misfit",
    *(e.name for e in HIT_EFFECTS),
    *RETURN,
    *(f"{joint}.{effect}" for joint in JOINT_NAMES for effect in JOINT_EFFECTS),
)
BOUNCE_SCATTER = np.full(3, 0.05)  # [m/s] from ball to ball, so that one bounce is no change
BESIDE = 0.4  # [s] of the joints' motion before and after a ball that count as its own
LEAST = 1e-9  # information below which a ball shows nothing of an effect


class Scorer:
    """Scores balls about a believed model. The first balls that are scored say what noise and scatter are like."""

    def __init__(self, model: SimModel) -> None:
        self._model = model
        spin = model.ball_spin
        mean, std = (np.array([getattr(spin, f"{kind}_{axis}") for axis in "xyz"]) for kind in ("mean", "std"))
        self._spins = SpinPrior(mean, std) if std.any() and model.ball.flight.magnus_coefficient else None
        self._noise: noise.Noise | None = None
        self._root: Float[np.ndarray, "6 6"] | None = None
        self._usual = np.zeros((6, 1))  # return, which the model is off by
        self._sizes: dict[str, tuple[int, int]] = {}

    def score(self, balls: Sequence[Trajectory], joints: Sequence[JointRecord]) -> Float[np.ndarray, "n M"]:
        """Scores of each ball by the order of NAMES; NaN where it does not show one.

        balls: from the person's paddle on, with their returns; joints: on the same clock, none or all eight.
        """
        found = np.full((len(balls), len(NAMES)), np.nan)
        first = len(FLIGHT_EFFECTS) + 1
        second = first + len(HIT_EFFECTS) + len(RETURN)
        incoming = [(i, flown[0]) for i, t in enumerate(balls) if (flown := flights([t])) and _approaches(flown[0])]
        if incoming:
            found[[i for i, _ in incoming], :first] = self._of_flights([flight for _, flight in incoming])
        path = joint_path(joints, self._model) if joints else None
        place = {id(t): i for i, t in enumerate(balls)}
        hits = [(place[id(t)], pair) for t in balls for pair in watched_hits([t], path)]
        if hits:
            found[[i for i, _ in hits], first:second] = self._of_hits([pair for _, pair in hits], path)
        for i, ball in enumerate(balls if joints else ()):
            found[i, second:] = self._of_joints(joints, ball.time[0] - BESIDE, ball.time[-1] + BESIDE)
        return found

    def _grid(self, kind: str, balls: Sequence[Trajectory]) -> Grid:
        """On a grid of the largest size so far: one compiled program for all that follow."""
        most = -(-max(map(len, balls)) // PAD) * PAD
        g = grid(balls, *self._sizes.get(kind, (0, most)))
        self._sizes[kind] = len(g.steps), len(g.time)
        return g

    def _of_flights(self, balls: Sequence[Trajectory]) -> Float[np.ndarray, "n K"]:
        g = self._grid("flights", balls)
        problem, zero = BallProblem(g, self._model, FLIGHT_EFFECTS, heading(g)), np.zeros(len(FLIGHT_EFFECTS))
        spins = self._spins
        start = first_fit(problem, zero, None if spins is None else spins.mean)
        at = Situation(zero, fit_starts(problem, zero, start, g, None, spins))
        linear = problem.linearise(at)
        frame = noise.flight_frame(linear.base.velocity[:, :, 0])
        if self._noise is None:
            self._noise = noise.estimate(linear.residual, frame, g, 6 if spins is None else 9)
        scale = np.repeat(np.median(self._noise.scale, axis=1)[:, None], g.n, axis=1)
        own = replace(self._noise, frame=frame, scale=scale, scatter=BOUNCE_SCATTER)
        out = marginal.starts_out(linear, at, own, noise.robust_weights(linear.residual, own, g), problem)
        score, information = marginal.own_unknowns_out(marginal.products(linear, out), spins, BOUNCE_SCATTER)
        misfit = np.log(np.sqrt((linear.residual**2).sum(axis=(0, 1)) / g.mask.sum(axis=0)))
        return np.concatenate([_standardise(score, information), misfit[:, None]], axis=1)

    def _of_hits(self, pairs: Sequence[tuple[Trajectory, int]], path: JointPath | None) -> Float[np.ndarray, "n H"]:
        whole, before = [t for t, _ in pairs], np.array([n for _, n in pairs])
        g = self._grid("hits", whole)
        g = replace(g, paddle=poses(whole, g.steps, path))
        incoming = np.arange(len(g.time))[:, None] < before[None]
        problem, zero = BallProblem(g, self._model, HIT_EFFECTS, heading(g)), np.zeros(len(HIT_EFFECTS))
        spins = self._spins
        first = first_fit(problem, zero, None if spins is None else spins.mean, incoming)
        start = fit_starts(problem, zero, first, replace(g, mask=g.mask & incoming), None, spins)
        y, jacobian, hit = compare_returns(problem, zero, start, incoming)
        usable = np.isfinite(hit) & (np.linalg.norm(y[:3], axis=0) < FARTHEST)
        if self._root is None:
            if usable.sum() < len(RETURN):
                return np.full((len(pairs), len(HIT_EFFECTS) + len(RETURN)), np.nan)
            self._usual = np.median(y[:, usable], axis=1, keepdims=True)
            self._root = spread(y[:, usable] - self._usual)[0]
        j, t = np.einsum("cd,kdn->kcn", self._root, jacobian), self._root @ (y - self._usual)
        scores = _standardise(np.einsum("kcn,cn->nk", j, t), np.einsum("kcn,kcn->nk", j, j))
        misfit = np.log(np.linalg.norm(t, axis=0) + LEAST)
        return np.where(usable[:, None], np.concatenate([scores, y.T, misfit[:, None]], axis=1), np.nan)

    def _of_joints(self, joints: Sequence[JointRecord], begin: float, end: float) -> Float[np.ndarray, " J"]:
        by_name, found = {r.joint: r for r in joints}, []
        for name in JOINT_NAMES:
            record = by_name[name]
            inside = record.state_time[(record.state_time >= begin) & (record.state_time <= end)]
            sent = record.command_time[(record.command_time >= begin) & (record.command_time <= end)]
            if sent.size < 2 or inside.size < 2 or inside[-1] - max(inside[0], sent[0]) <= SHORTEST:
                found += [np.nan] * len(JOINT_EFFECTS)
                continue
            log = JointLog(record.between(begin, end), nominal_response(self._model, name, record.robot))
            columns = log.centred(slopes(log, {effect: log.base[effect] for effect in JOINT_EFFECTS}))
            rest = log.centred(log.measured - log.simulate({}))
            found += list(_standardise(columns.T @ rest, (columns**2).sum(axis=0)))
        return np.array(found)


def _approaches(ball: Trajectory) -> bool:
    """True for a ball on its way to the robot."""
    return bool(ball.position[1, -1] < ball.position[1, 0])


def _standardise(score: np.ndarray, information: np.ndarray) -> np.ndarray:
    shown = information > LEAST
    return np.where(shown, score / np.sqrt(np.where(shown, information, 1.0)), np.nan)
