"""Worlds that a study identified, parameter by parameter, beside the reality once it is opened."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.study.analysis import delays
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile
from mjx_tt.sim.randomisation import Samples

LOGS, PRIOR, BELIEVED = "logs", "prior", "as believed"
PRIOR_ALONE = "from the prior alone"  # what made the world: those of its samples that no log decided
SPIN = "ball_spin."  # of strokes: a person's own, so that a reality has no one number for it


def list_estimates(world: ModelFile, truth: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """A row for each parameter that the world moved or draws: its value, 90 % of what is drawn, and the truth if known.

    decided by: the logs, the prior, or neither. truth: values that differ from the nominal model, by dotted path;
    delays as ``delays.add_to_sums`` has them.
    """
    nominal, values = models.paths(), models.paths(world.model)
    shown = [delays.restore_command(x, values[delays.AXES]) if isinstance(x, Samples) else x for x in world.randomise]
    drawn = {path: ends for one in shown for path, ends in one.ends().items()}
    alone = (world.provenance or {}).get("identified", {}).get(PRIOR_ALONE, ())
    logged = {path for one in shown if isinstance(one, Samples) for path in one.paths} - set(alone)
    known = None if truth is None else delays.add_to_sums(nominal | dict(truth), values)
    rows = []
    for path, value in values.items():
        low, high = drawn.get(path, (value, value))
        if low == high == nominal[path] and (truth is None or path not in truth):
            continue
        row: dict[str, Any] = {"parameter": path, "believed": nominal[path], "low": low, "high": high}
        one_value = path not in drawn and value != nominal[path]  # for all, such as the strokes' mean spin
        row["decided by"] = LOGS if path in logged or one_value else PRIOR if path in drawn else BELIEVED
        if known is not None and not path.startswith(SPIN):
            row["truth"] = known[path]
        rows.append(row)
    return rows


def holds(row: Mapping[str, Any]) -> bool | None:
    """True where the interval has the truth in it; None where nothing was drawn, or there is no one truth."""
    if row.get("truth") is None or row["low"] == row["high"]:
        return None
    return bool(row["low"] <= row["truth"] <= row["high"])
