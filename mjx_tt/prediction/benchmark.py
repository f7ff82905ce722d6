"""Benchmark of predictors on measured flights: the state from the first 0.15 s, the place 0.3 s ahead.

Every second flight is held out; the others are diagnosed, and say how balls spin and how far predictions miss. An error
is the distance between the prediction and the sample at that time, at most CAP; a flight counts once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from ballmodel.aerodynamics import SATURATING_LIFT
from ballmodel.io import Events
from ballmodel.trajectory import Trajectory
from mjx_tt import diagnosis
from mjx_tt.diagnosis.ball.diagnose import FEWEST_BALLS
from mjx_tt.diagnosis.ball.flights.forward_model import grid, heading_axes
from mjx_tt.diagnosis.ball.flights.forward_model import predict as fly
from mjx_tt.diagnosis.tracks import Record, clean
from mjx_tt.diagnosis.tracks.chains import take_apart
from mjx_tt.prediction import baselines
from mjx_tt.prediction.flight_fit import LEVEL, first_part, fit_states, fly_on, learn, squared_miss, targets
from mjx_tt.sim.model import SimModel, with_values

WINDOW = 0.15  # [s] of a flight that a predictor sees
HORIZONS = (0.1, 0.3, 0.5)  # [s] after it
CAP = 0.5  # [m]
LONGEST = 1.5  # [s] of a shot
FEWEST = 8  # flights of a set
DRAWS = 2000
SATURATING = {f"ball.flight.{key}": value for key, value in SATURATING_LIFT.items()}


@dataclass(frozen=True)
class Score:
    """Errors of one predictor at one horizon, with 95 % bootstrap intervals; [m]."""

    method: str
    horizon: float  # [s]
    across: str  # "all", "free" or "bounce": whether the ball bounced between the last sample seen and the target
    flights: int
    rms: tuple[float, float, float]  # value, low, high
    median: tuple[float, float, float]
    inside: float = np.nan  # share of the samples that lie in the predictor's 90 % regions


@dataclass(frozen=True)
class Benchmark:
    """Scores of one set."""

    name: str
    flights: int  # strokes, both halves
    record: Record
    scores: tuple[Score, ...]
    errors: dict[str, Float[np.ndarray, "h n"]]  # method -> [m], NaN where a flight has no sample there
    squares: dict[str, Float[np.ndarray, "h n"]]  # method -> squared misses in units of their covariances
    learnt: str  # what the diagnosis of the other half says

    def score(self, method: str, horizon: float, across: str = "all") -> Score:
        """The score of one method. Raises KeyError."""
        for s in self.scores:
            if (s.method, s.horizon, s.across) == (method, horizon, across):
                return s
        raise KeyError(f"{method}, {horizon} s, {across}")


def benchmark(
    name: str,
    tracks: Sequence[Trajectory],
    models: Mapping[str, SimModel] | None = None,
    horizons: Sequence[float] = HORIZONS,
) -> Benchmark:
    """Scores of the baselines and of the models on one set of tracks in the table frame.

    models: by name; each predicts with a spin per ball where its ball is lifted, of a distribution learnt from the
    other half. "diagnosed" is the nominal model as the diagnosis of the other half extends it, where that is large
    enough. Raises ValueError for fewer than FEWEST flights that are long enough.
    """
    strokes, record = clean(tracks)
    usable = [t for t in strokes if t.time[-1] - t.time[0] > WINDOW + horizons[0] and _seen(t) >= 6]
    if len(usable) < FEWEST:
        raise ValueError(
            f"{name}: {len(usable)} of {len(tracks)} flights last {WINDOW + horizons[0]:.2f} s, {FEWEST} are wanted"
        )
    known, held = usable[::2], usable[1::2]
    parts = [first_part(t, WINDOW) for t in held]
    times, places = targets(held, parts, horizons)
    bounced = _bounces(held, times)
    horizons = [h for h, some in zip(horizons, np.isfinite(places[0]).any(axis=1), strict=True) if some]
    times, places, bounced = times[: len(horizons)], places[:, : len(horizons)], bounced[: len(horizons)]
    worlds = {"nominal model": SimModel(), "saturating lift": with_values(SimModel(), SATURATING)}
    learnt = "too few flights"
    if len(known) >= FEWEST_BALLS:
        found = diagnosis.diagnose(diagnosis.Logs(tuple(known), (), {}))
        worlds["diagnosed"] = found.extended.model
        learnt = ", ".join(c.name for c in found.verdict.causes) or "nothing"
    worlds |= dict(models or {})
    found_places = {
        "parabola": baselines.parabola(held, WINDOW, times),
        "Kalman filter": baselines.kalman(held, WINDOW, times),
    }
    squares = {}
    for label, world in worlds.items():
        belief = learn(known, world, WINDOW, horizons)
        flown, covariance = fly_on(fit_states(parts, belief), times)
        found_places[label] = flown.position[:, 1:, 0]
        squares[label] = squared_miss(places - found_places[label], covariance)
    errors = {m: np.minimum(np.linalg.norm(at - places, axis=0), CAP) for m, at in found_places.items()}
    scores = []
    for across, chosen in (("all", np.ones_like(bounced)), ("free", ~bounced), ("bounce", bounced)):
        for h, horizon in enumerate(horizons):
            for method, error in errors.items():
                which = chosen[h] & np.isfinite(error[h])
                if which.any():
                    inside = squares[method][h, which] < chi2.ppf(LEVEL, 3) if method in squares else np.nan
                    share = float(np.mean(inside))
                    scores.append(_score(method, float(horizon), across, error[h][which], share))
    return Benchmark(name, len(usable), record, tuple(scores), errors, squares, learnt)


def landing_benchmark(name: str, events: Events, models: Mapping[str, SimModel] | None = None) -> Benchmark:
    """Errors of the first bounce's place from a shot's measured state, spin included.

    Nothing is fitted, so every shot counts; the horizon is that of the flight's median. Raises ValueError for fewer
    than FEWEST shots that a bounce follows.
    """
    shots, bounces = events.landings
    if shots.size < FEWEST:
        raise ValueError(f"{name}: {shots.size} shots are followed by a bounce, {FEWEST} are wanted")
    position, velocity, spin = (np.asarray(part) for part in jax.tree.leaves(events.state))
    axes = heading_axes(velocity[:, shots])
    along = np.einsum("can,cn->an", axes, spin[:, shots])
    start = np.concatenate([position[:, shots], velocity[:, shots], along])
    moments = np.arange(0.0, LONGEST, 0.01)
    g = grid([Trajectory("", str(i), moments, np.zeros((3, moments.size))) for i in range(shots.size)])
    known = {
        "saturating lift": SATURATING_LIFT,
        "no air": {"drag_coefficient": 0.0},
        "nominal model": {},
        "C_d 0.47, k 0.6": {"magnus_coefficient": 0.6},
    }
    worlds = {
        label: with_values(SimModel(), {f"ball.flight.{key}": value for key, value in values.items()})
        for label, values in known.items()
    } | dict(models or {})
    seconds = float(np.median(events.time[bounces] - events.time[shots]))
    errors = {}
    for label, world in worlds.items():
        landed = fly(world, {}, start[:, None], g, axes)
        off = np.linalg.norm(landed.bounce[:2, 0] - position[:2, bounces], axis=0)
        errors[label] = np.minimum(np.where(np.isfinite(landed.bounce_time[0]), off, CAP), CAP)[None]
    scores = tuple(_score(label, seconds, "all", error[0]) for label, error in errors.items())
    return Benchmark(name, shots.size, Record((), shots.size, shots.size, ()), scores, errors, {}, "")


def _seen(t: Trajectory) -> int:
    return int(np.searchsorted(t.time, t.time[0] + WINDOW + 1e-9, side="right"))


def _bounces(held: Sequence[Trajectory], times: Float[np.ndarray, "h n"]) -> Bool[np.ndarray, "h n"]:
    """True where the ball met the table between the last sample seen and the target."""
    out = np.zeros(times.shape, bool)
    for i, t in enumerate(held):
        met = [j.time - t.time[0] for c in take_apart(t).chains for j in c.junctions if j.met == "table"]
        last = t.time[_seen(t) - 1] - t.time[0]
        out[:, i] = [any(last < m <= time for m in met) for time in times[:, i]]
    return out


def _score(method: str, horizon: float, across: str, errors: Float[np.ndarray, " n"], inside: float = np.nan) -> Score:
    rng = np.random.default_rng(0)
    drawn = errors[rng.integers(0, errors.size, (DRAWS, errors.size))]

    def interval(value: float, values: np.ndarray) -> tuple[float, float, float]:
        low, high = np.quantile(values, [0.025, 0.975])
        return float(value), float(low), float(high)

    rms = interval(float(np.sqrt(np.mean(errors**2))), np.sqrt(np.mean(drawn**2, axis=1)))
    return Score(
        method, horizon, across, errors.size, rms, interval(float(np.median(errors)), np.median(drawn, axis=1)), inside
    )
