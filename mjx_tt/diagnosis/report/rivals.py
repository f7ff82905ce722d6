"""Other sets of causes than the chosen one, and why they lost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.ball import scores, selection
from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.ball.scores import Scores, Subset

RUNNERS = 5  # of the next best sets that are shown
NOTHING = "nothing (the nominal model)"


@dataclass(frozen=True)
class Rival:
    """Another set of causes."""

    name: str
    behind: float  # price and gain against the chosen set's
    why: str  # it lost


def rivals(found: BallFindings) -> tuple[str, list[Rival]]:
    """Name of the chosen set, and the rivals, nearest first."""
    choice, trial = found.choice, found.trial

    def names(subset: Subset, spun: bool) -> list[str]:
        return [trial.effects[i].name for i in subset] + (["magnus"] if spun and trial.spin == "none" else [])

    def price(subset: Subset, spun: bool) -> float:
        return choice.threshold * len(subset) + (selection.SPIN_GAIN if spun and trial.spin == "none" else 0.0)

    best = choice.gain - price(choice.effects, choice.spin)
    chosen = names(choice.effects, choice.spin)
    alike = {
        (tuple(sorted((*choice.effects[:i], other, *choice.effects[i + 1 :]))), choice.spin)
        for i, group in enumerate(choice.groups)
        for other in group[1:]
    }
    sets = {(s, spun): gain for s, spun, gain in [*choice.runners_up[:RUNNERS], *_asked_for(found)]}
    out = []
    for key, gain in sets.items():
        if key[0] or key[1] or choice.effects:
            theirs, behind = names(*key), best - gain + price(*key)
            why = _why(chosen, theirs, gain - choice.gain, behind, choice.threshold, key in alike)
            out.append(Rival(" + ".join(theirs) or NOTHING, behind, why))
    return " + ".join(chosen) or NOTHING, sorted(out, key=lambda r: r.behind)


def _asked_for(found: BallFindings) -> list[tuple[Subset, bool, float]]:
    """Sets that a reader asks for: each cause replaced by what looks like it, and the best set without all of these.

    Beside the chosen effects only those enter that the data could show, as in ``selection``.
    """
    choice, rated = found.choice, found.scores()
    useful = [i for i in np.flatnonzero(found.seen).tolist() if i not in rated.always]
    out = []

    def best(rated: Scores, candidates: Iterable[int], spun: bool) -> None:
        gains = scores.all_gains(rated, tuple(candidates))
        subset = max(gains, key=lambda s: gains[s] - choice.threshold * len(s))
        out.append((subset, spun, gains[subset]))

    for i, group in enumerate(choice.groups):
        rest = choice.effects[:i] + choice.effects[i + 1 :]
        for other in group[1:]:
            subset = tuple(sorted((*rest, other)))
            out.append((subset, choice.spin, scores.gain(rated, subset)))
        best(rated, (k for k in useful if k not in group), choice.spin)
    if choice.spin and found.trial.spin == "none":
        plain = scores.without_spin(found.projected)
        best(plain, (k for k in useful if not found.trial.effects[k].needs_spin), False)
    return out


def _why(chosen: list[str], rival: list[str], gain: float, behind: float, threshold: float, alike: bool) -> str:
    """Reason for which a rival set lost.

    gain: squared error, in units of the noise, that it explains beyond the chosen set.
    alike: it is the chosen set with one cause replaced by one that the diagnosis groups with it.
    """
    fit = "fits no better" if abs(gain) < 0.5 else f"fits {'worse' if gain < 0 else 'better'} by {abs(gain):,.0f}"
    more = len(rival) - len(chosen)
    if alike and abs(gain) >= selection.TIE:
        return f"{fit}, but its pattern is too much like that of the chosen one to tell the two apart"
    if more == 0 and abs(gain) < selection.TIE:
        return f"{fit}: less than {selection.TIE:.0f}, so these logs do not tell the two apart"
    if behind <= 0.0:
        return f"{fit}, but one of its causes is too small or too uncertain to be named"
    if more > 0:
        count = "one more effect" if more == 1 else f"{more} more effects"
        bring = "" if "magnus" in set(rival) - set(chosen) else f", and each must bring {threshold:.0f}"
        return f"{fit}; needs {count}{bring}"
    return fit + ("" if more == 0 else " with one effect less" if more == -1 else f" with {-more} effects less")
