"""The model linearised at a set of causes: whitened residuals and columns of each ball, nuisances projected out.

Everything is in absolute coordinates: the linear model is  target = E theta + M omega + N nu + noise, with theta the
effects' changes from the nominal model, omega the spin of each ball, nu its start. So subsets that leave an effect out
again are compared on the same footing as those that keep it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.ball.effects import FLIGHT, Effect
from mjx_tt.diagnosis.ball.flights.forward_model import Flown, Grid, heading_axes, leaves, predict
from mjx_tt.diagnosis.ball.flights.noise import Noise, Whitening
from mjx_tt.sim.model import SimModel

SPIN, KICK = slice(6, 9), slice(9, 12)
MAGNUS = FLIGHT + "magnus_coefficient"
START_STEPS = np.array([1e-6] * 3 + [1e-5] * 3 + [0.1] * 3 + [1e-5] * 3)  # [m], [m/s], [rad/s], [m/s]
COARSE = 0.1  # of an effect's scale: a step over which few balls go from sliding to rolling at once
REFERENCE_MAGNUS = 0.6  # k used where the nominal model has none: in flight only k omega shows (published: 0.3 to 1.5)


@dataclass(frozen=True)
class Situation:
    """Point at which the model is linearised."""

    theta: np.ndarray  # (K,) changes of the effects
    start: np.ndarray  # (12, n) each ball's own: position, velocity, spin, and what its bounce adds to its velocity


@dataclass(frozen=True)
class Linear:
    """The linearised model in measured units."""

    residual: np.ndarray  # (3, T, n) [m] measured - predicted
    starts: np.ndarray  # (12, 3, T, n) derivative by start position, velocity, spin, and the bounce's own kick
    effects: np.ndarray  # (K, 3, T, n) derivative by the effects' changes
    base: Flown  # with v = 1
    transition: np.ndarray  # (n, T, 6, 6) derivative of true position and velocity by those at the start


class BallProblem:
    """Measured balls, the nominal model and the effects under trial; velocity: (3, n) tells where each ball heads."""

    def __init__(self, g: Grid, model: SimModel, effects: Sequence[Effect], velocity: np.ndarray) -> None:
        self.grid, self.model, self.effects = g, model, tuple(effects)
        self.axes = heading_axes(velocity)
        self.nominal = leaves(model)
        names = [e.name for e in self.effects]
        # The effect that holds k, where the nominal model has none: spin as a cause brings it along.
        has_none = self.nominal[MAGNUS] == 0.0 and "magnus_coefficient" in names
        self.coefficient = names.index("magnus_coefficient") if has_none else None

    def values(self, theta: np.ndarray) -> dict:
        """Leaves for changes theta (K, ...), which add up where effects share a parameter."""
        base, shape = self.nominal, theta.shape[1:]
        out: dict[str, np.ndarray] = {}
        for effect, change in zip(self.effects, theta, strict=True):
            for path, value in effect.values(base, change).items():
                out[path] = out.get(path, np.full(shape, base[path])) + (value - base[path])
        out.setdefault(MAGNUS, np.full(shape, base[MAGNUS]))
        return out

    def fly(self, theta: np.ndarray, start: np.ndarray, g: Grid | None = None) -> Flown:
        """Predictions for changes (K,) or (K, n) and starts (12, n)."""
        g = self.grid if g is None else g
        theta = theta[:, None, None] if theta.ndim == 1 else theta[:, None]
        return predict(self.model, self.values(theta), start[:, None], g, self.axes)

    def linearise(self, at: Situation, g: Grid | None = None, across: bool = False) -> Linear:
        """Residuals and derivatives at a situation.

        across: by effects with a kink over an ordinary size both ways, for a search that has to see beyond the kink.
        """
        g = self.grid if g is None else g
        k = len(self.effects)
        moves = np.array([e.step if e.step is not None else 1e-3 * e.scale for e in self.effects])
        # A step of its own is for an effect without a derivative at zero; elsewhere it would only blur.
        moves = np.where(at.theta != 0.0, np.minimum(moves, np.maximum(0.1 * np.abs(at.theta), 1e-6)), moves)
        kinks = np.array([i for i, e in enumerate(self.effects) if across and e.kinked], dtype=int)
        moves[kinks] = [self.effects[i].scale for i in kinks]
        # Variants: as it is; start moved (6); effects changed (k); with a ball that air can bend: as it is, spun (3);
        # and kicked at the bounce (3); effects with a kink, changed the other way.
        theta = np.repeat(at.theta[:, None], 14 + k + len(kinks), axis=1)
        theta[np.arange(k), 7 + np.arange(k)] += moves
        theta[kinks, 14 + k + np.arange(len(kinks))] -= moves[kinks]
        start = np.repeat(at.start[:, None], theta.shape[1], axis=1)
        for i in range(6):
            start[i, 1 + i] += START_STEPS[i]
        for i in range(6, 12):
            start[i, 2 + k + i] += START_STEPS[i]
        values = self.values(theta[:, :, None])
        if self.nominal[MAGNUS] == 0.0:
            lift = values[MAGNUS] = values[MAGNUS].copy()
            lift[7 + k : 11 + k] = np.where(np.abs(lift[0]) > 0.05, lift[0], REFERENCE_MAGNUS)
        flown = predict(self.model, values, start, g, self.axes, states=7)
        base, bent = flown.measured[:, :, 0], flown.measured[:, :, 7 + k]

        def slopes(variants: slice, before: np.ndarray, steps: np.ndarray) -> np.ndarray:
            return np.moveaxis(flown.measured[:, :, variants] - before[:, :, None], 2, 0) / steps[:, None, None, None]

        starts = slopes(slice(1, 7), base, START_STEPS[:6])
        spun = slopes(slice(8 + k, 11 + k), bent, START_STEPS[SPIN])
        starts = np.concatenate([starts, spun, slopes(slice(11 + k, 14 + k), base, START_STEPS[KICK])])
        effects = slopes(slice(7, 7 + k), base, moves)
        effects[kinks] = 0.5 * (effects[kinks] - slopes(slice(14 + k, None), base, moves[kinks]))
        state = np.concatenate([flown.position, flown.velocity])
        transition = (state[:, :, 1:] - state[:, :, :1]) / START_STEPS[None, None, :6, None]
        residual = np.where(g.mask, g.measured - base, 0.0)
        one = Flown(
            *(
                x[..., :1, :]
                for x in (
                    flown.measured,
                    flown.position,
                    flown.velocity,
                    flown.bounce_time,
                    flown.bounce,
                    flown.bounce_velocity,
                    flown.hit_time,
                )
            )
        )
        return Linear(residual, starts, effects, one, np.moveaxis(transition, (3, 1), (0, 1)))

    def spins_by_effects(self, at: Situation, which: Sequence[int], beside: np.ndarray) -> np.ndarray:
        """(E, 3, 3, T, n) [m per rad/s and unit] by how much more each of some effects makes the spins show.

        beside: (6, 3, n) by how much a start moves with each component of the spin.
        """
        g, count = self.grid, len(which)
        moves = np.array([COARSE * self.effects[i].scale for i in which])
        changes = np.repeat(at.theta[:, None], 1 + count, axis=1)  # none, and one effect at a time
        changes[which, 1 + np.arange(count)] += moves
        start = np.tile(at.start[:, None], (1, 4 * (1 + count), 1))  # of each: as it is, spun (3)
        for axis in range(3):
            start[6 + axis, 1 + axis :: 4] += START_STEPS[6 + axis]
            start[:6, 1 + axis :: 4] += START_STEPS[6 + axis] * beside[:, None, axis]
        flown = predict(self.model, self.values(np.repeat(changes, 4, axis=1)[:, :, None]), start, g, self.axes)
        shown = flown.measured.reshape(*flown.measured.shape[:2], 1 + count, 4, g.n)
        slopes = (shown[:, :, :, 1:] - shown[:, :, :, :1]) / START_STEPS[SPIN, None]
        return np.transpose((slopes[:, :, 1:] - slopes[:, :, :1]) / moves[:, None, None], (2, 3, 0, 1, 4))


def shifts(linear: Linear, g: Grid, effects: Sequence[Effect]) -> tuple[np.ndarray, float]:
    """Median shift [m] of the last sample of the balls concerned, per unit of each effect and per rad/s of spin.

    Against a nominal flight from the same measured start: what the effect does to the first samples is carried along.
    Of an effect that fades the largest shift of a flight counts, of a sample that is left out as well.
    """
    last = g.last
    balls = np.arange(g.n)
    dt = np.maximum(g.time[2] - g.time[0], 1e-9)
    early = np.concatenate([linear.effects[:, :, 0], (linear.effects[:, :, 2] - linear.effects[:, :, 0]) / dt], axis=1)
    carried = np.einsum("kjn,jcn->kcn", early, linear.starts[:6][:, :, last, balls])
    end = linear.effects[:, :, last, balls] - carried
    spin = linear.starts[SPIN][:, :, last, balls]
    size = np.linalg.norm(end, axis=1)
    for i in (i for i, e in enumerate(effects) if e.fades):
        flown = np.arange(len(g.time))[:, None] <= last
        size[i] = np.linalg.norm(np.where(flown, linear.effects[i], 0.0), axis=0).max(axis=0)
    concerned = [s[s > 1e-3 * s.max()] for s in size]
    return np.array([np.median(s) if s.size else 0.0 for s in concerned]), float(
        np.median(np.linalg.norm(spin, axis=1))
    )


@dataclass(frozen=True)
class Projected:
    """Whitened quantities ball by ball, starts projected out. K effects and their sums with the measured target."""

    gram: np.ndarray  # (n, K, K)
    right: np.ndarray  # (n, K) with the absolute target
    spin_gram: np.ndarray  # (n, 3, 3)
    spin_effect: np.ndarray  # (n, 3, K)
    spin_right: np.ndarray  # (n, 3)


def project(linear: Linear, at: Situation, noise: Noise, weight: np.ndarray, g: Grid) -> Projected:
    """Whitens, projects the starts out and forms the products; the target is what the effects at zero leave."""
    target = linear.residual + np.tensordot(at.theta, linear.effects, 1)
    return StartsOut(linear, target, at.start, noise, weight, g).project(linear.effects)


class StartsOut:
    """Flights whitened, starts projected out of spins and target: what any set of columns is judged against.

    target: (3, T, n) [m], to which the spins and kicks of the starts (12, n) are added: it is that of balls without.
    Where bounces scatter, each one's own kick goes out as well, as far as its distribution lets it: as an unknown
    about which rows of its own say that it is small.
    """

    def __init__(
        self, linear: Linear, target: np.ndarray, start: np.ndarray, noise: Noise, weight: np.ndarray, g: Grid
    ) -> None:
        self._weight, self._white = weight, Whitening(noise, g)
        free, kicks = (self._white.rows(linear.starts[part], weight) for part in (slice(6), KICK))
        self._kicks = remove(np.linalg.qr(free)[0], kicks)
        self._scatters = bool(noise.scatter.any())
        if self._scatters:
            known = np.broadcast_to(np.eye(3), (g.n, 3, 3))
            lower = np.concatenate([np.zeros((g.n, 3, 6)), known], axis=2)
            free = np.concatenate([np.concatenate([free, kicks * noise.scatter], axis=2), lower], axis=1)
        self._basis, _ = np.linalg.qr(free)
        self._spins = self._left(linear.starts[SPIN])
        own = linear.starts[6:] * start[6:, None, None]
        self._target = self._left(np.where(g.mask, target + own.sum(axis=0), 0.0)[None])

    def _left(self, columns: np.ndarray) -> np.ndarray:
        """Rows of columns (k, 3, T, n) without what the balls' own unknowns explain."""
        whitened = self._white.rows(columns, self._weight)
        if self._scatters:
            whitened = np.concatenate([whitened, np.zeros((len(whitened), 3, whitened.shape[2]))], axis=1)
        return remove(self._basis, whitened)

    def project(self, columns: np.ndarray) -> Projected:
        """The products of columns (K, 3, T, n) [m per unit]."""
        effects = self._left(columns)
        et, st = effects.swapaxes(1, 2), self._spins.swapaxes(1, 2)
        return Projected(
            et @ effects,
            (et @ self._target)[..., 0],
            st @ self._spins,
            st @ effects,
            (st @ self._target)[..., 0],
        )

    def starts_beside_spins(self, linear: Linear) -> np.ndarray:
        """(6, 3, n) by how much a start moves with each component of the spin where flights are to change the least."""
        free, spins = (self._white.rows(linear.starts[part], self._weight) for part in (slice(6), SPIN))
        basis, upper = np.linalg.qr(free)
        return -np.moveaxis(np.linalg.solve(upper, basis.swapaxes(1, 2) @ spins), 0, 2)

    def beside_spins_and_kicks(self, columns: np.ndarray) -> np.ndarray:
        """(n, 6, k) products of the columns of spins and kicks with others (k, 3, T, n), of noise without scatter."""
        own = np.concatenate([self._spins, self._kicks], axis=2)
        return own.swapaxes(1, 2) @ self._left(columns)


def remove(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns (n, m, k) without their part in the orthonormal basis (n, m, q)."""
    return columns - basis @ (basis.swapaxes(1, 2) @ columns)
