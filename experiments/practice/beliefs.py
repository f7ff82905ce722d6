"""What a session believes of its world, and how two beliefs differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ballmodel.trajectory import Trajectory
from experiments.config.prior import PRIOR
from experiments.study import identification
from experiments.study.analysis import delays
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.diagnosis.together import balls as of_balls
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile
from mjx_tt.sim.randomisation import Range, Samples

SURE = 4.0  # deviations by which a parameter that is named has moved
LARGE = 0.1  # of what may change of a parameter, below which it is not named
NAMED = 3  # parameters in a sentence, at most
NOISE, LIFT = "sensing.ball_noise", of_balls.LIFT
WIDER = 1.5  # times the width of the prior's range, by which a parameter may change either way
RUBBER = {"ball.paddle.restitution": 0.5, "ball.paddle.tangential_gain": 0.5}  # worn, wet, or another one
INSTALLED = {path: ends for path, ends in PRIOR.items() if path != NOISE}
# Half of the range of what may change within a session, by dotted path: worn rubber, another table, a tripod that was
# kicked, a clock that slipped. Air and ball lift much as before; a fan may be switched on [m/s].
CHANGES: dict[str, float] = {
    **{path: WIDER * (high - low) for path, (low, high) in INSTALLED.items()},
    # A lag and a delay look alike in most motion: together they may not change as much as each alone.
    **{path: high - low for path, (low, high) in INSTALLED.items() if path.endswith(".lag")},
    **RUBBER,
    LIFT: 0.2,
    "ball.flight.spin_decay": 0.05,
    **{f"ball.flight.wind_{axis}": 1.0 for axis in "xy"},
}


@dataclass(frozen=True)
class Change:
    """A parameter that two identifications have at different values, with the later one's 90 % interval."""

    path: str
    before: float
    after: float
    low: float
    high: float
    deviations: float

    def __str__(self) -> str:
        return f"{self.path} {self.before:.4g} -> {self.after:.4g} ({self.low:.4g} to {self.high:.4g})"


def identify(balls: Sequence[Trajectory], joints: Sequence[JointRecord], believed: ModelFile) -> ModelFile:
    """The world after these balls, hits among them, and the joints meanwhile. Raises ValueError where they are few.

    What these logs do not decide is drawn as before, at first from the prior: one program takes all worlds. A parameter
    that is known no better than before is not decided: a fit that went astray says so by its uncertainty.
    """
    before = _distributions(believed)
    if before:
        ranges = [_about(path, float(column.mean()), CHANGES[path]) for path, column in before.items()]
    else:  # nothing is known but what an installation may be like, and that its rubber may be worn
        halves = {path: RUBBER.get(path, 0.5 * (high - low)) for path, (low, high) in INSTALLED.items()}
        ranges = [_about(path, 0.5 * sum(INSTALLED[path]), half) for path, half in halves.items()]
    ranges.append(Range(NOISE, *PRIOR[NOISE]))
    found = identification.identify_world(balls, joints, [(balls, joints)] if joints else [], believed, ranges)
    samples = next(one for one in found.randomise if isinstance(one, Samples))
    known = {one.path: (one.high - one.low) / 12**0.5 for one in ranges}
    drawn = zip(samples.paths, samples.values.T, strict=True)
    decided = {path: column for path, column in drawn if column.std() < known.get(path, np.inf)}
    columns, rng = dict(decided), np.random.default_rng(len(balls))
    for path in sorted(CHANGES.keys() - decided.keys() - {delays.ARM}):
        low, high = PRIOR.get(path, (0.0, 0.0))
        columns[path] = before.get(path, rng.uniform(low, high, len(samples.values)))
    ordered = sorted(columns)
    whole = Samples(tuple(ordered), np.stack([columns[path] for path in ordered], axis=1), samples.weight)
    others = tuple(one for one in found.randomise if not set(one.paths) & columns.keys())
    values = {path: float(column.mean()) for path, column in columns.items()}
    if LIFT not in decided:  # nor is the spin, of which a flight shows the product with it
        values |= {f"ball_spin.{name}": float(value) for name, value in asdict(believed.model.ball_spin).items()}
    return ModelFile(models.with_values(found.model, values), (whole, *others), found.provenance)


def compare(before: ModelFile, after: ModelFile) -> tuple[Change, ...]:
    """What has changed between two identified worlds, the surest first."""
    old, new = (_distributions(world) for world in (before, after))
    found = []
    for path in old.keys() & new.keys():
        a, b = old[path], new[path]
        shift, error = b.mean() - a.mean(), float(np.hypot(a.std(), b.std()))
        if abs(shift) > SURE * error and abs(shift) > LARGE * CHANGES[path]:
            low, high = np.quantile(b, (0.05, 0.95)).tolist()
            found.append(Change(path, float(a.mean()), float(b.mean()), low, high, float(abs(shift) / error)))
    return tuple(sorted(found, key=lambda change: -change.deviations))


def say(changes: Sequence[Change]) -> str:
    """One sentence about what has changed."""
    if not changes:
        return "no parameter of the model has changed beyond chance"
    return "; ".join(str(change) for change in changes[:NAMED])


def _about(path: str, middle: float, half: float) -> Range:
    return Range(path, middle - half, middle + half)


def _distributions(world: ModelFile) -> dict[str, np.ndarray]:
    """Draws of each parameter that logs decided, by dotted path."""
    samples = [one for one in world.randomise if isinstance(one, Samples)]
    return {path: one.values[:, i] for one in samples for i, path in enumerate(one.paths) if path in CHANGES}
