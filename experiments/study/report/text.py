"""The findings of a study in plain sentences, made from what was measured."""

from __future__ import annotations

import numpy as np

from experiments.study.analysis.claims import (
    AGREES,
    DIFFERS,
    DIRECTION,
    NOT_COMPARABLE,
    UNDECIDED,
    VERDICTS,
    Finding,
    Measurements,
)
from experiments.study.analysis.paper import FINAL, LEVELS, SHORT, of_level
from experiments.study.analysis.statistics import Interval


def sentences(m: Measurements, found: dict[str, Finding]) -> list[str]:
    """The findings in plain words, only of what was measured."""
    out = _loop(m)
    intervals = {key: f.interval for key, f in found.items() if f.interval is not None}

    def measured(*keys: str) -> list[str]:
        return [key for key in keys if key in intervals]

    if measured("all-ratio"):
        means = ((SHORT[key], m.raw.mean(key, of_level("all"))) for key in FINAL)
        text = ", ".join(f"{name} {mean.value:.1f}" for name, mean in means if mean is not None)
        out.append(f"Mean rally length in hits: {text}.")
        out.append(
            f"Over all players, i-S2R's rallies are {compared(intervals['all-ratio'])} those of S2R+FT; the paper: 9 % "
            "longer."
        )
    paper = {"beginner": "70 % longer", "intermediate": "175 % longer", "advanced": "far shorter"}
    for key in measured(*LEVELS):
        who = {"beginner": "With beginners", "advanced": "With the advanced player"}.get(key, f"With {key} players")
        out.append(f"{who}, they are {compared(intervals[key])} those of S2R+FT; the paper: {paper[key]}.")
    for key in measured("oracle-beginner", "oracle-intermediate"):
        out.append(
            f"With {'beginners' if 'beginner' in key else 'intermediate players'}, S2R-Oracle+FT, with 35 % of the "
            "real training, plays rallies that are "
            f"{compared(intervals[key])} i-S2R's; the paper: comparable."
        )
    if measured("keeps-is2r", "keeps-s2r"):
        kept = " and ".join(
            f"{name} {100 * i.value:.0f} % ({100 * i.low:.0f} to {100 * i.high:.0f} %)"
            for name, i in (("i-S2R", intervals.get("keeps-is2r")), ("S2R+FT", intervals.get("keeps-s2r")))
            if i is not None
        )
        out.append(
            f"With players who did not train it, a policy keeps of its rally length: {kept}; the paper: 70 % and 30 %."
        )
    steps = {
        "fine-tuning": "fine-tuning the first policy",
        "drop-sim2": "the second round in simulation",
        "drop-sim3": "the third round in simulation",
    }
    for key in measured(*steps):
        text = "longer" if key == "fine-tuning" else "shorter"
        out.append(f"After {steps[key]}, rallies are {compared(intervals[key])} before; the paper: {text}.")
    if m.changes:
        first, second = np.mean(list(m.changes.values()), axis=0)
        out.append(
            f"The human model moves by {100 * first:.1f} % from M0 to M1 and by {100 * second:.1f} % from M1 to M2."
        )
    if measured("carried"):
        out.append(
            f"With the weights carried back to simulation, rallies are {compared(intervals['carried'])} without; "
            "the paper leaves it open."
        )
    unselected = m.ratio("is2r-ft100", "s2r-ft100", "all", boot=m.unselected)
    if unselected is not None:
        i = unselected.interval
        out.append(
            "On every rally that counts, instead of the longest five sixths, i-S2R / S2R+FT is "
            f"{i.value:.2f} ({i.low:.2f} to {i.high:.2f})."
        )
    counts = {v: [f for f in found.values() if f.verdict == v] for v in VERDICTS}
    out.append(
        f"Of {len(found)} claims of the paper {len(counts[AGREES])} agree, {len(counts[DIRECTION])} in direction only, "
        f"{len(counts[DIFFERS])} differ, {len(counts[UNDECIDED])} cannot be decided and {len(counts[NOT_COMPARABLE])} "
        "not be compared."
    )
    differ = " ".join(f.claim.text for f in counts[DIFFERS])
    return [*out, f"The paper's claims that differ: {differ}"] if differ else out


def _loop(m: Measurements) -> list[str]:
    """Sentences on what the human model brings, and what identification does."""
    out = []

    def ratio(a: str, b: str) -> str | None:
        """Ratio of mean rally lengths in words, with its interval."""
        estimate = m.ratio(a, b, "all")
        if estimate is None:
            return None
        i = estimate.interval
        return f"{i.value:.2f} times ({i.low:.2f} to {i.high:.2f})"

    if rounds := ratio("is2r-sim3", "is2r-sim1"):
        out.append(
            "Before they are fine-tuned, policies of the third simulation, which knows the person's balls, play "
            f"rallies that are {rounds} as long as those of the first."
        )
    if known := ratio("id-sim3", "is2r-sim3"):
        first = ratio("id-sim3", "is2r-sim1")
        out.append(
            f"Where the simulation is identified besides, they are {known} as long as where it is not, and {first} as "
            "long as those of the first simulation, which knows neither."
        )
    if tuned := ratio("id-ft100", "is2r-ft100"):
        out.append(f"After the last fine-tuning they are {tuned} as long as without identification.")
    return out


def compared(ratio: Interval) -> str:
    """A ratio of rally lengths as what stands before "than": how much longer or shorter, with its interval."""
    value, low, high = (100.0 * (x - 1.0) for x in (ratio.value, ratio.low, ratio.high))
    if low <= 0.0 <= high:
        return f"not clearly longer or shorter ({value:+.0f} %, {low:+.0f} to {high:+.0f} %) than"
    return f"{abs(value):.0f} % {'longer' if value > 0 else 'shorter'} ({low:+.0f} to {high:+.0f} %) than"
