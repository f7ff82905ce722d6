"""Sentences of a diagnosis: a verdict, a cause and a block without a name in plain words, with numbers and units."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjx_tt.diagnosis.ball import effects as ball_effects
from mjx_tt.diagnosis.ball.diagnose import FLOOR, BallFindings
from mjx_tt.diagnosis.description import Description, Way
from mjx_tt.diagnosis.diagnose import Diagnosis
from mjx_tt.diagnosis.inclusion import LEAST_EVIDENCE, PRICE
from mjx_tt.diagnosis.joint import effects as joint_effects
from mjx_tt.diagnosis.verdict import Cause, Estimate, Experiment, Unexplained, Verdict

# Units that read better in thousandths below a size.
DISPLAY = {
    "s": (1e3, "ms", 1.0),
    "rad": (1e3, "mrad", 0.5),
    "m": (1e3, "mm", 0.5),
    "kg": (1e3, "g", 0.1),
}


def description(name: str) -> Description:
    """Description of an effect of the ball, or of a joint by joint.effect."""
    _, dot, effect = name.rpartition(".")
    return (joint_effects.DESCRIPTIONS if dot else ball_effects.DESCRIPTIONS)[effect]


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in one sentence."""
    v = diagnosis.verdict
    if v.verdict == "none":
        parts = []
        if diagnosis.balls is not None:
            parts.append(f"{diagnosis.balls.problem.grid.n} balls")
        if diagnosis.robot is not None:
            count = len(diagnosis.robot.residuals)
            parts.append(f"{count} joint{'s' if count > 1 else ''}")
        return f"The simulation agrees with {' and '.join(parts)} to within the noise: nothing is named."
    names, left = _and([_noun(c.name) + _share(c) for c in v.causes]), left_over(v)
    if v.unexplained is not None:
        open_ = f"no entry of the catalogue explains {left}: {_odd(v.unexplained)}"
        return f"{names[0].upper()}{names[1:]}; beside it {open_}." if names else f"{open_[0].upper()}{open_[1:]}."
    if v.verdict == "undetermined":
        return f"What was found predicts unused data worse, and is not adopted: {names}."
    if len(v.causes) == 1:
        return f"{claim(v.causes[0])}{_share(v.causes[0])}."
    better = ""
    if v.held_out is not None and v.held_out.low > 0.0 and v.held_out.metric.endswith("[mm]"):
        better = f"; with them unused data are missed by {v.held_out.after:.1f} instead of {v.held_out.before:.1f} mm"
    return f"{len(v.causes)} things are wrong: {names}{better}."


def _share(cause: Cause) -> str:
    """Part of the error that a cause takes away, in words; "" where it is not told."""
    return f" ({100 * min(cause.share, 1.0):.0f} % of the error)" if cause.share > 0.0 else ""


def left_over(v: Verdict) -> str:
    """What is left of the flights' error, in words."""
    if v.left is None:
        return "something"
    return f"{v.left.mm:.1f} of {v.left.nominal_mm:.1f} mm"


def _noun(name: str) -> str:
    joint, dot, _ = name.rpartition(".")
    return f"{joint}'s {description(name).meaning}" if dot else description(name).meaning


def told(separates: Sequence[str]) -> str:
    """Lines "a from b" and "whether there is c" as one, each first word once; "" for none."""
    pairs: dict[str, list[str]] = {}
    for line in separates:
        for word in (" from ", "whether there is "):
            head, found, tail = line.partition(word)
            if found:
                pairs.setdefault(head + found, []).append(tail)
                break
        else:
            pairs.setdefault(line, [])
    return _and([head + _or(tails) if tails else head for head, tails in pairs.items()])


def advice(steps: Sequence[Experiment]) -> tuple[str, list[str]]:
    """Advice that all next steps give alike, and what each gives beside that, in words; "" for nothing."""
    informative = [step.separates for step in steps if step.separates]
    shared = [line for line in informative[0] if all(line in other for other in informative)] if informative else []
    common = shared if len(informative) > 1 else []  # one step alone says for itself what it tells
    own = [[line for line in step.separates if line not in common] for step in steps]
    return told(common), [told(lines) for lines in own]


def claim(cause: Cause) -> str:
    """A cause as a sentence, with its size and 90 % interval."""
    if cause.name == "magnus":
        return _spin_claim(cause)
    words, e = description(cause.name), next(iter(cause.parameters.values()))
    sentence = words.claim.format(
        meaning=words.meaning,
        way=Way(e.estimate > e.nominal),
        value=_value(e),
        size=_size(e),
        instead=_instead(e),
        nominal=nominal(e),
    )
    joint, dot, _ = cause.name.rpartition(".")
    return f"{joint} {sentence}" if dot else sentence


def detectable(found: BallFindings) -> dict[str, float]:
    """Smallest shift of a flight's last sample [mm] at which each effect that was not chosen would have shown, by name.

    By the evidence beside what was chosen; infinite where the logs do not excite the effect.
    """
    search = found.search
    out = {}
    for j, effect in enumerate(found.problem.effects):
        if j in search.chosen or j in search.model.always or j in found.left_out or effect.made_of:
            continue
        if j not in search.model.candidates:
            out[effect.name] = math.inf
            continue
        error = math.sqrt(search.model.solve((*search.chosen, j))[1][j, j])
        price = 2.0 * (PRICE + LEAST_EVIDENCE) + 2.0 * math.log(max(search.model.scale[j] / error, 1.0))
        out[effect.name] = 1e3 * error * math.sqrt(price) * float(search.shift[j])
    return out


# Numbers with units


def span(middle: float, low: float, high: float, unit: str) -> tuple[str, str, str, str]:
    """Three numbers and the unit, with as many digits as the interval deserves."""
    factor, name, below = DISPLAY.get(unit, (1.0, unit, math.inf))
    if not max(abs(x) for x in (middle, low, high)) < below:
        factor, name = 1.0, unit
    half = 0.5 * abs(high - low) * factor
    if math.isfinite(half) and half > 0.0:
        digits = int(np.clip(math.ceil(-math.log10(half) - 1e-3), 0, 7))  # the last one moves by less than the interval
        # Rounded first: what is zero to these digits has no sign.
        texts = [f"{round(x * factor, digits) + 0.0:.{digits}f}" for x in (middle, low, high)]
    else:
        texts = [f"{x * factor:.4g}" for x in (middle, low, high)]
    middle_text, low_text, high_text = texts
    return middle_text, low_text, high_text, {"1": ""}.get(name, name.replace("^2", "²"))


def _join(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text


def _interval(middle: float, low: float, high: float, unit: str) -> str:
    m, a, b, name = span(middle, low, high, unit)
    return f"{_join(m, name)} ({a} to {b})"


def _value(e: Estimate) -> str:
    """The estimate with its interval."""
    return _interval(e.estimate, e.low, e.high, e.unit)


def _size(e: Estimate) -> str:
    """The size of the change from the nominal value, with its interval."""
    low, high = sorted(math.copysign(1.0, e.estimate - e.nominal) * (x - e.nominal) for x in (e.low, e.high))
    return _interval(abs(e.estimate - e.nominal), low, high, e.unit)


def _instead(e: Estimate) -> str:
    return f"{_value(e)} instead of {nominal(e)}"


def nominal(e: Estimate) -> str:
    """Nominal value with its unit."""
    if math.isinf(e.nominal):
        return "no limit"
    factor, name, below = DISPLAY.get(e.unit, (1.0, e.unit, math.inf))
    if not max(abs(x) for x in (e.estimate, e.low, e.high)) < below:
        factor, name = 1.0, e.unit
    return _join(f"{e.nominal * factor:.6g}", {"1": ""}.get(name, name.replace("^2", "²")))


def _spin_claim(cause: Cause) -> str:
    means = {p[-1]: e for p, e in cause.parameters.items() if p.startswith("ball_spin.mean_")}
    spreads = {p[-1]: e for p, e in cause.parameters.items() if p.startswith("ball_spin.std_")}
    if not means:
        e = next(iter(cause.parameters.values()))
        return f"The balls spin and the air bends their flight, Magnus coefficient {_instead(e)}"
    axis = max(means, key=lambda a: means[a].estimate ** 2 + spreads[a].estimate ** 2)
    return (
        f"The balls spin and the air bends their flight, most about {axis}: mean {_value(means[axis])}, "
        f"ball to ball {_value(spreads[axis])}"
    )


def alike(cause: Cause) -> str:
    """Other causes of the same log, in words; "" without one."""
    if len(cause.group) < 2:
        return ""
    names = [f"{name} ({description(name).meaning})" for name in cause.group[1:]]
    return f"; the same log would look alike with {_or(names)}"


def _or(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " or " + names[-1]


def _and(names: Sequence[str]) -> str:
    return "".join(names) if len(names) < 2 else ", ".join(names[:-1]) + " and " + names[-1]


def _odd(u: Unexplained) -> str:
    along = f"mostly in {u.direction}" if u.direction in ("x", "y", "z") else f"direction {u.direction}"
    return f"{block(u.block)}, largest at {u.where}, {along}, {u.size}"


def block(name: str) -> str:
    """An anonymous block in words."""
    joint, colon, rest = name.rpartition(": ")
    kinds = (
        ("force over ", "a force that changes with "),
        ("bounce over ", "a bounce that changes with "),
        ("measured position over ", "a shift of the measured position that changes with "),
        ("force by session", "a force that differs from session to session"),
        ("bounce by session", "a bounce that differs from session to session"),
    )
    quantities = {
        "x": "x, across the table",
        "y": "y, along the table",
        "z": "the height z",
        "flight": "the time in flight",
        "session": "the time in a session",
        "the table": "the place on the table",
        "speed": "the speed",
        "vertical speed": "the vertical speed",
    }
    if colon:
        return f"a motion of {joint.split(': ')[0]} ({rest})"
    for start, words in kinds:
        if name.startswith(start):
            over = name[len(start) :]
            return words + quantities.get(over, over)
    return name


def nothing(diagnosis: Diagnosis) -> str:
    """What "none" says: how small an effect would have been named."""
    parts = []
    if diagnosis.balls is not None:
        found = diagnosis.balls
        floor = 1e3 * FLOOR
        sizes = [max(s, floor) for s in detectable(found).values() if math.isfinite(s)]
        small = f", but for what is too small to matter, {below_floor(found)}" if below_floor(found) else ""
        text = f"The model agrees with {found.problem.grid.n} balls to within the noise{small}: nothing is named"
        if sizes:
            reach = f"{floor:.0f}" if max(sizes) < floor + 0.05 else f"{min(sizes):.1f} to {max(sizes):.1f}"
            text += (
                f"; each of the {len(sizes)} effects that these balls can show would have been named once it shifted"
                f" the last sample of a flight by {reach} mm"
            )
        parts.append(text + ".")
    if diagnosis.hits is not None:
        blind = f"; {', '.join(diagnosis.hits.quiet)} they could not show" if diagnosis.hits.quiet else ""
        parts.append(f"The robot's {diagnosis.hits.hits} hits name nothing at the paddle either{blind}.")
    if diagnosis.robot is not None:
        worst = max((g.before * 1e3 for g in diagnosis.robot.held_out), default=0.0)
        parts.append(
            "The joints follow the model to within the noise: no drive effect is named; positions not used are"
            f" predicted to {worst:.2g} mm or mrad rms at worst."
        )
    return " ".join(parts)


def below_floor(found: BallFindings) -> str:
    """Effects that the evidence asks for, but that move a flight's end by less than the practical floor."""
    search = found.search
    sizes = {found.problem.effects[j].name: abs(search.at.theta[j]) * float(search.shift[j]) for j in search.chosen}
    return ", ".join(f"{name} ({1e3 * size:.1f} mm)" for name, size in sizes.items() if size < FLOOR)
