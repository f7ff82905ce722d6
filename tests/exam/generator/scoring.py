"""Opens the seal: what a verdict is worth, case by case, and the bars over many cases."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import binom, binomtest

from tests.exam.generator.cases import EFFECTS

PEOPLE = "human_single human_pair human_deleted human_invented"
ABSTAINED = ("unexplained", "undetermined")


def score(truth: dict, verdict: dict) -> dict:
    """Outcome of one case.

    outcome: right; wrong (a name that is not true, or one too many); partly (true names, one missing); missed ("none"
    although something is wrong); flagged (unexplained or undetermined). For nothing wrong, "none" is right and flagged
    is flagged. A true cause counts as named when it is in a cause's group; for a deleted one its twins and look-alikes
    count as well.
    """
    case = truth["case"]
    causes, kind = tuple(case["causes"]), case["kind"].removeprefix("human_")
    given = verdict["causes"] if verdict["verdict"] == "named" else []
    named = [{c["name"], *c.get("group", ())} for c in given]
    answer = "+".join(sorted(c["name"] for c in verdict["causes"])) if named else verdict["verdict"]
    record = {"verdict": verdict["verdict"], "answer": answer}
    accepted = {c: {c} for c in ((*causes, "tracker_filter") if kind == "kalman" else causes)}
    if "magnus" in accepted:  # spins, and a k that is not the nominal one: both are true
        accepted["magnus"].add("magnus_coefficient")
    if kind == "deleted":
        accepted = {c: {c, *truth["twins"].get(c, ()), *truth["lookalikes"].get(c, ())} for c in causes}
    elif kind in ("invented", "unexcited"):
        accepted = {}
    record["outcome"] = _outcome(kind, accepted, named, verdict["verdict"])
    record["leads"] = _leads(accepted, verdict)
    record["confidences"] = [
        [c["confidence"], any(names & group for names in accepted.values())]
        for c, group in zip(given, named, strict=True)
    ]
    if record["outcome"] == "right" and kind in ("single", "pair", "triple", "gauge", "bounce"):
        record["twins_reported"] = all(
            any({c, *truth["twins"].get(c, ())} <= g for g in named) for c in causes if truth["twins"].get(c)
        )
        record["parameters"] = parameter_errors(truth, verdict)
    if kind == "many" or (kind == "robot" and record["outcome"] == "right"):
        record["parameters"] = parameter_errors(truth, verdict)
    if kind == "unexcited":
        declared = set(verdict.get("not_excited", ())) | set(verdict.get("not_identifiable", ()))
        flat = {name for entry in declared for name in _names(entry)}
        record["declared"] = all(c in flat for c in causes)
    return record


def _leads(accepted: dict[str, set[str]], verdict: dict) -> str | None:
    """ "right" or "wrong" where a cause leads beside what is unexplained, so that the extended model holds it."""
    if verdict["verdict"] != "unexplained" or not verdict["causes"]:
        return None
    if any("the extended model does not hold them" in warning for warning in verdict.get("warnings", ())):
        return None
    groups = [{c["name"], *c.get("group", ())} for c in verdict["causes"]]
    return "right" if all(any(names & g for names in accepted.values()) for g in groups) else "wrong"


def _names(entry) -> list[str]:
    """Catalogue names within an entry of a list, which may go on to say why."""
    text = " ".join(entry) if isinstance(entry, (list, tuple)) else str(entry)
    return [word.strip(".,:;()[]'\"") for word in text.replace("=", " ").split()]


def _outcome(kind: str, accepted: dict[str, set[str]], named: list[set[str]], verdict: str) -> str:
    if verdict in ABSTAINED:
        return "flagged"
    if not named:
        return "missed" if kind not in ("none", "noise", "robot_none", "unexcited") else "right"
    hit = [cause for cause, names in accepted.items() if any(names & group for group in named)]
    false = [group for group in named if not any(names & group for names in accepted.values())]
    # Two named groups for one true cause are one name too many.
    if false or not accepted or len(named) > len(hit):
        return "wrong"
    return "right" if len(hit) == len(accepted) else "partly"


def parameter_errors(truth: dict, verdict: dict) -> dict[str, dict]:
    """Per true cause, of the first reported parameter that expresses it: error relative to the change, and coverage."""
    found: dict[str, dict] = {}
    reported = {k: v for c in verdict["causes"] for k, v in c["parameters"].items()}
    for path, value in truth["parameters"].items():
        key = _match(path, reported)
        if key is None:
            continue
        p = reported[key]
        change = abs(value - p["nominal"]) if math.isfinite(p["nominal"] or math.nan) else abs(value)
        if change > 0:
            found[path] = {
                "error": abs(p["estimate"] - value) / change,
                "absolute": abs(p["estimate"] - value),
                "covered": bool(p["low"] <= value <= p["high"]),
            }
    spin = truth.get("spin")
    if spin and any("ball_spin" in k or k.startswith(("std_", "mean_")) for k in reported):
        found |= _spin_error(spin, reported)
    return found


def _match(path: str, reported: dict) -> str | None:
    """The reported key of a model path: the path itself or its last part, with the joint for a robot."""
    if path in reported:
        return path
    for key in reported:
        if path.endswith("." + key) or key.endswith("." + path):
            return key
    return None


def _spin_error(spin: dict, reported: dict) -> dict[str, dict]:
    """Only k times the spin shows in flight: compares k times the strokes' root mean square about x."""
    values = {k.split(".")[-1]: v["estimate"] for k, v in reported.items()}
    if "std_x" not in values:
        return {}
    k = values.get("magnus_coefficient", spin["k"])
    estimate = k * math.hypot(values.get("mean_x", 0.0), values["std_x"])
    true = spin["k"] * math.hypot(spin["mean"][0], spin["std"][0])
    return {"k x rms spin": {"error": abs(estimate - true) / true, "absolute": abs(estimate - true), "covered": None}}


@dataclass(frozen=True)
class Reliability:
    """Named causes of about one confidence, and the share of them that was true, with its 95 % interval."""

    confidence: float  # mean
    count: int
    true: float
    low: float
    high: float


CONFIDENCES = (0.0, 0.5, 0.8, 0.95, 0.995, 1.01)  # edges of the bins


def reliability(records: list[dict]) -> list[Reliability]:
    """Shares of the named causes that are true, from low confidence to high."""
    said = np.array([pair for r in records for pair in r.get("confidences", ())], float).reshape(-1, 2)
    out = []
    for low, high in pairwise(CONFIDENCES):
        own = said[(said[:, 0] >= low) & (said[:, 0] < high)]
        if len(own):
            hits = int(own[:, 1].sum())
            out.append(
                Reliability(float(own[:, 0].mean()), len(own), hits / len(own), *clopper_pearson(hits, len(own)))
            )
    return out


def clopper_pearson(hits: int, total: int) -> tuple[float, float]:
    """Exact two-sided 95 % interval of a proportion; (0, 1) of no cases."""
    if total == 0:
        return 0.0, 1.0
    interval = binomtest(hits, total).proportion_ci(0.95, "exact")
    return float(interval.low), float(interval.high)


@dataclass(frozen=True)
class Row:
    """One line of the table: a figure against its bar."""

    bar: str
    test: str
    wanted: str
    cases: int
    figure: float
    low: float
    high: float
    met: bool | None  # None without cases

    def text(self) -> str:
        """The line in Markdown."""
        if self.cases == 0:
            return f"| {self.bar} | {self.test} | {self.wanted} | 0 | - | - | no cases |"
        met = "-" if self.wanted == "-" else "met" if self.met else "not met"
        interval = f"{100 * self.low:.1f} to {100 * self.high:.1f} %" if math.isfinite(self.low) else "-"
        figure = f"{100 * self.figure:.1f} %"
        return f"| {self.bar} | {self.test} | {self.wanted} | {self.cases} | {figure} | {interval} | {met} |"


def _share(bar: str, test: str, wanted: str, hits: Iterable[bool]) -> Row:
    """Share of hits against a bar such as ">= 95 %", "<= 2 %", "85-95 %" or, for a figure without a bar, "-"."""
    hits = [bool(h) for h in hits]
    figure = sum(hits) / len(hits) if hits else math.nan
    numbers = [float(n) / 100 for n in wanted.strip("<=>% ").split("-") if n]
    low = numbers[0] if numbers and not wanted.startswith("<") else 0.0
    high = numbers[-1] if numbers and not wanted.startswith(">") else 1.0
    met = low <= figure <= high if hits else None
    return Row(bar, test, wanted, len(hits), figure, *clopper_pearson(sum(hits), len(hits)), met)


def table(records: list[dict]) -> list[Row]:
    """The bars that cases can speak to, and what is worth knowing beside them."""
    by = defaultdict(list)
    for r in records:
        by[r["case"]["kind"]].append(r)

    def ended(kinds: str, *outcomes: str, size: float | None = None) -> list[bool]:
        cases = [r for kind in kinds.split() for r in by[kind] if size in (None, r["case"]["size_mm"])]
        return [r["outcome"] in outcomes for r in cases]

    def named(kinds: str) -> list[bool]:
        return [r["verdict"] == "named" for kind in kinds.split() for r in by[kind]]

    right, flagged, wrong = "right", "flagged", "wrong"
    exact = [r for r in by["gauge"] if any(r["twins"].values())]
    alone = [r["outcome"] == right and not r["twins_reported"] for r in exact]
    declared = [r["outcome"] == right and r["declared"] for r in by["unexcited"] if "declared" in r]
    leads = [r["leads"] for r in records if r.get("leads")]
    delays = [_delay_error(r) <= 2e-3 for r in _delays(by["robot"])]
    return [
        _share("1", "nothing wrong: any name", "<= 2 %", named("none noise")),
        _share("1", "nothing wrong, wrong noise model: any name", "<= 2 %", named("noise")),
        _share("1", "nothing wrong: flagged as unexplained", "-", ended("none noise", flagged)),
        _share("2", "one effect, 10 mm: right group", ">= 95 %", ended("single", right, size=10.0)),
        _share("3", "one effect, 5 mm: right group", ">= 85 %", ended("single", right, size=5.0)),
        _share("3", "one effect, 20 mm: right group", ">= 95 %", ended("single", right, size=20.0)),
        _share("2-3", "one effect: wrong name", "-", ended("single", wrong)),
        _share("4", "pairs: exact set", ">= 85 %", ended("pair", right)),
        _share("4", "triples: exact set", ">= 70 %", ended("triple", right)),
        _share("5", "exact gauge: one member reported alone", "<= 0 %", alone),
        _share("5", "gauge groups: right group", ">= 95 %", ended("gauge", right)),
        *_parameter_rows([r for r in by["single"] if r["case"]["size_mm"] == 10.0]),
        _share("6", "90 % intervals that cover, one effect of any size", "85-95 %", _covered(by["single"])),
        _share("6", "90 % intervals that cover, robot", "-", _covered(by["robot"])),
        _share("7", "true cause deleted: flagged or its twin", ">= 80 %", ended("deleted", flagged, right)),
        _share("7", "true cause deleted: confident wrong name", "<= 10 %", ended("deleted", wrong)),
        _share("7", "true cause deleted: a twin or look-alike named", "-", ended("deleted", right)),
        _share("8", "never in the catalogue: flagged", ">= 90 %", ended("invented", flagged)),
        _share("8", "never in the catalogue: wrong name", "<= 10 %", ended("invented", wrong)),
        _share("10", "robot, one effect: right", ">= 95 %", ended("robot", right)),
        _share("10", "robot, one effect: wrong name", "-", ended("robot", wrong)),
        _share("10", "robot, delay within 2 ms", ">= 100 %", delays),
        _share("10", "robot, unexcited effect: declared, nothing named", ">= 95 %", declared),
        _share("10", "robot, nothing wrong: any name", "<= 2 %", named("robot_none")),
        _share("13", "people play, nothing wrong: any name or flag", "<= 2 %", ended("human_none", wrong, flagged)),
        _share("14", "people play, one effect, 10 mm: right group", ">= 90 %", ended("human_single", right, size=10.0)),
        _share("14", "people play, one effect, 20 mm: right group", ">= 95 %", ended("human_single", right, size=20.0)),
        _share("15", "people play, pairs: exact set", ">= 80 %", ended("human_pair", right)),
        _share("16", "people play, never in the catalogue: flagged", ">= 85 %", ended("human_invented", flagged)),
        _share("16", "people play, cause deleted: flagged or its twin", "-", ended("human_deleted", flagged, right)),
        _share("14-16", "people play: wrong name", "<= 2 %", ended(PEOPLE, wrong)),
        *_many_rows(by["many"]),
        _share("17", "restitution and friction far off, 60 balls: both named", ">= 95 %", ended("bounce", right)),
        _share("17", "restitution and friction far off, 60 balls: wrong name", "<= 2 %", ended("bounce", wrong)),
        _share("18", "a tracker's Kalman filter: named", ">= 90 %", ended("kalman", right)),
        _share("18", "a tracker's Kalman filter: wrong name", "<= 2 %", ended("kalman", wrong)),
        _share("-", "a cause leads beside what is unexplained: true", "-", [x == "right" for x in leads]),
        _share("-", "any log: a false cause leads", "-", [r.get("leads") == "wrong" for r in records]),
        _share("-", "ended with an error", "-", [r["outcome"] == "error" for r in records]),
    ]


def _parameter_rows(records: list[dict]) -> list[Row]:
    entries = [list(r.get("parameters", {}).values()) for r in records]
    errors = [e[0]["error"] for e in entries if e]
    low, high = _median_interval(errors)
    median = float(np.median(errors)) if errors else math.nan
    met = median <= 0.05 if errors else None
    return [
        Row("6", "parameter error at 10 mm, median", "<= 5 %", len(errors), median, low, high, met),
        _share("6", "90 % intervals that cover, one effect of 10 mm", "85-95 %", _covered(records)),
    ]


def _covered(records: list[dict]) -> list[bool]:
    entries = [list(r.get("parameters", {}).values()) for r in records]
    return [e[0]["covered"] for e in entries if e and e[0]["covered"] is not None]


def _median_interval(values: list[float], level: float = 0.95) -> tuple[float, float]:
    """Distribution-free interval of a median: order statistics by the binomial law."""
    if len(values) < 6:
        return math.nan, math.nan
    ordered = np.sort(values)
    k = int(binom.ppf((1 - level) / 2, len(values), 0.5))
    return float(ordered[max(k - 1, 0)]), float(ordered[min(len(values) - k, len(values) - 1)])


def _many_rows(records: list[dict]) -> list[Row]:
    covered = []
    for r in records:
        for cause in r["case"]["causes"]:
            # A cause and its twins are one number.
            found = [r["parameters"][p] for p in EFFECTS[cause].truth(0.01) if p in r.get("parameters", {})]
            covered += [bool(p["covered"]) for p in found[:1] if p["covered"] is not None]
    return [
        _share("17", "2 to 8 ordinary causes: wrong name", "<= 2 %", [r["outcome"] == "wrong" for r in records]),
        _share("17", "2 to 8 ordinary causes: 90 % intervals that cover", "85-95 %", covered),
    ]


def _delays(records: list[dict]) -> list[dict]:
    return [
        r
        for r in records
        if r["outcome"] == "right" and r["case"]["causes"][0].endswith("_delay") and math.isfinite(_delay_error(r))
    ]


def _delay_error(record: dict) -> float:
    return next((p["absolute"] for k, p in record.get("parameters", {}).items() if k.endswith("_delay")), math.nan)


def confusion(records: list[dict]) -> dict[str, dict[str, int]]:
    """Answers by true cause, for cases with one cause."""
    matrix: dict[str, Counter] = defaultdict(Counter)
    for r in records:
        if len(r["case"]["causes"]) <= 1:
            truth = r["case"]["causes"][0] if r["case"]["causes"] else "nothing"
            if r["case"]["kind"] not in ("single", "gauge"):
                truth = f"{r['case']['kind']}: {truth}"
            matrix[truth][r["answer"]] += 1
    return {truth: dict(counts.most_common()) for truth, counts in sorted(matrix.items())}
