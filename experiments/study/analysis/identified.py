"""Worlds that a study identified, parameter by parameter, beside the reality once it is opened."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile
from mjx_tt.sim.randomisation import Samples

LOGS, PRIOR, BELIEVED = "logs", "prior", "as believed"
BUSES = ("abb", "festo")
SPIN = "ball_spin."  # of strokes: a person's own, so that a reality has no one number for it


def estimates(world: ModelFile, truth: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """A row for each parameter that the world moved or draws: its value, 90 % of what is drawn, and the truth if known.

    decided by: the logs, the prior, or neither. truth: values that differ from the nominal model, by dotted path;
    delays as ``in_sums`` has them.
    """
    nominal, values = models.paths(), models.paths(world.model)
    drawn = {path: ends for one in world.randomise for path, ends in one.ends().items()}
    logged = {path for one in world.randomise if isinstance(one, Samples) for path in one.paths}
    known = None if truth is None else in_sums(nominal | dict(truth), values)
    rows = []
    for path, value in values.items():
        low, high = drawn.get(path, (value, value))
        if low == high == nominal[path] and (truth is None or path not in truth):
            continue
        row: dict[str, Any] = {"parameter": path, "believed": nominal[path], "low": low, "high": high}
        alone = path not in drawn and value != nominal[path]  # one value for all, such as the strokes' mean spin
        row["decided by"] = LOGS if path in logged or alone else PRIOR if path in drawn else BELIEVED
        if known is not None and not path.startswith(SPIN):
            row["truth"] = known[path]
        rows.append(row)
    return rows


def in_sums(truth: Mapping[str, float], believed: Mapping[str, float]) -> dict[str, float]:
    """The truth's values with delays as logs and play can show them.

    Of a bus only the sum of the delays of command and measurement shows, of the ball its delay against the arm's
    joints: the joints' are as believed, and the others have the difference.
    """
    found = dict(truth)
    observed = {bus: f"latency.{bus}_observation" for bus in BUSES}
    for bus, path in observed.items():
        found[f"latency.{bus}_action"] += truth[path] - believed[path]
    found["latency.ball_observation"] += believed[observed["abb"]] - truth[observed["abb"]]
    return found | {path: believed[path] for path in observed.values()}


def holds(row: Mapping[str, Any]) -> bool | None:
    """True where the interval has the truth in it; None where nothing was drawn, or there is no one truth."""
    if row.get("truth") is None or row["low"] == row["high"]:
        return None
    return bool(row["low"] <= row["truth"] <= row["high"])
