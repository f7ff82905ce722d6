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
    behind: float  # price and gain against the chosen set's; negative where a gate stopped a set that fits better
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
            stopped = fault(found, *key, gain) if behind <= 0.0 and key not in alike else ""
            why = _why(chosen, theirs, gain - choice.gain, stopped, choice.threshold, key in alike)
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
    # Gains about spins of their own count from another base than those of balls that do not spin.
    own = choice.prior is not None and choice.prior.conditional
    if choice.spin and found.trial.spin == "none" and not own:
        plain = scores.without_spin(found.projected)
        best(plain, (k for k in useful if not found.trial.effects[k].needs_spin), False)
    return out


def fault(found: BallFindings, subset: Subset, spin: bool, gain: float) -> str:
    """Gate of ``selection`` that stops a set of causes, in words; "" where all that can be seen from here hold."""
    choice, trial = found.choice, found.trial
    rated = found.scores() if spin == choice.spin else scores.without_spin(found.projected)
    rated = scores.priced(rated, trial.effects)
    columns = (*subset, *rated.always)
    theta = scores.solve(rated, columns)
    error = np.sqrt(np.diagonal(scores.sandwich(rated, columns)))
    for one, other in trial.bound:
        if one in subset and other not in subset:
            return f"{trial.effects[one].name} means nothing without {trial.effects[other].name}"
    for i, j in enumerate(subset):
        effect, name = trial.effects[j], trial.effects[j].name
        if abs(theta[i]) > selection.WIDEST * effect.scale:
            return f"{name} would be {abs(theta[i]) / effect.scale:,.0f} times as large as is usual"
        if theta[i] < effect.low and abs(theta[i]) * trial.shift[j] >= selection.FLOOR:
            return f"{name} would have a size that cannot be"
        if abs(theta[i]) < selection.LEAST_Z * error[i]:
            return f"{name} is uncertain, {abs(theta[i]) / error[i]:.1f} standard errors of {selection.LEAST_Z:g}"
        brought = gain - scores.gain(rated, subset[:i] + subset[i + 1 :])
        if brought < choice.threshold:
            return f"{name} brings {max(brought, 0.0):,.0f} of the {choice.threshold:.0f} that chance reaches"
    if scores.undo(rated, subset, theta, selection.ALIKE):
        return "two of its causes take away what the other adds"
    return ""


def _why(chosen: list[str], rival: list[str], gain: float, stopped: str, threshold: float, alike: bool) -> str:
    """Reason for which a rival set lost.

    gain: squared error, in units of the noise, that it explains beyond the chosen set.
    stopped: the gate that stops it.
    alike: it is the chosen set with one cause replaced by one that the diagnosis groups with it.
    """
    fit = "fits no better" if abs(gain) < 0.5 else f"fits {'worse' if gain < 0 else 'better'} by {abs(gain):,.0f}"
    more = len(rival) - len(chosen)
    if alike and abs(gain) >= selection.TIE:
        return f"{fit}, but its pattern is too much like that of the chosen one to tell the two apart"
    if more == 0 and abs(gain) < selection.TIE:
        return f"{fit}: less than {selection.TIE:.0f}, so these logs do not tell the two apart"
    if stopped:
        return f"{fit}, but {stopped}"
    if more > 0:
        count = "one more effect" if more == 1 else f"{more} more effects"
        bring = "" if "magnus" in set(rival) - set(chosen) else f", and each must bring {threshold:.0f}"
        return f"{fit}; needs {count}{bring}"
    if gain > selection.TIE and more <= 0:
        return f"{fit}, but only where effects are taken as straight lines: one of its causes does not hold beyond that"
    return fit + ("" if more == 0 else " with one effect less" if more == -1 else f" with {-more} effects less")
