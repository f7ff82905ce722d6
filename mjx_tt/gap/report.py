"""The report of a diagnosis: one HTML page that needs nothing else, and its pictures as PNG.

The order is that of a reader's questions: what does the simulation get wrong, what is the cause, why not another one,
what stays open, how much, what does it bring, what to measure next. Numbers that the diagnosis does not hold, such as
the smallest effect that would have been named, are worked out here.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ballmodel.files import replacing
from mjx_tt.gap import evidence, plots, select
from mjx_tt.gap.balls import BallFindings
from mjx_tt.gap.catalogue import BY_NAME, INVISIBLE
from mjx_tt.gap.diagnose import Diagnosis
from mjx_tt.gap.verdict import Cause, Estimate, Unexplained, Verdict

SUBSET = "a subset of the balls"  # block of balls of their own kind
RUNNERS = 5  # of the next best sets that are shown
FEW = 6  # next steps that are shown at once
# Units that read better in thousandths below a size.
DISPLAY = {
    "s": (1e3, "ms", 1.0),
    "rad": (1e3, "mrad", 0.5),
    "m": (1e3, "mm", 0.5),
    "kg": (1e3, "g", 0.1),
}

# What a name of the catalogue means, for readers who do not know it.
MEANING = {
    "drag_coefficient": "drag of the ball",
    "air_density": "thinner or denser air",
    "ball_mass": "another mass of the ball",
    "ball_radius": "another radius of the ball",
    "magnus": "spin of the ball",
    "magnus_coefficient": "curve of a spinning ball",
    "spin_decay": "loss of spin in flight",
    "wind_x": "air that moves across the table",
    "wind_y": "air that moves along the table",
    "wind_z": "air that rises or sinks",
    "gravity_tilt_x": "a measuring frame that leans across the table",
    "gravity_tilt_y": "a measuring frame that leans along the table",
    "gravity_scale": "strength of gravity",
    "buoyancy": "lift of the air on the ball",
    "clock_rate": "a clock that runs fast or slow",
    "table_restitution": "speed that the table gives back",
    "table_restitution_speed": "restitution that changes with speed",
    "table_friction": "friction of the table",
    "table_height": "height of the table",
    "table_tilt_x": "a table that leans across",
    "table_tilt_y": "a table that leans along its length",
    "paddle_restitution": "speed that the paddle gives back",
    "paddle_friction": "grip of the paddle",
    "paddle_tilt": "tilt of the paddle",
    "paddle_offset": "place of the paddle",
    "camera_scale": "scale of the camera's calibration",
    "camera_rotation_x": "camera frame turned about x",
    "camera_rotation_y": "camera frame turned about y",
    "camera_rotation_z": "camera frame turned about the vertical",
    "camera_distortion": "distortion of the camera",
    "ball_latency": "delay of the ball's measurement",
    "latency_jitter": "time stamps that scatter",
    "tracker_smoothing": "a tracker that smooths",
    "action_delay": "delay from command to motion",
    "observation_delay": "delay of the joint's measurement",
    "lag": "slow answer of the drive",
    "velocity_gain": "wrong speed of the drive",
    "joint_offset": "zero of the encoder",
    "velocity_limit": "a limit of the velocity",
    "acceleration_limit": "a limit of the acceleration",
    "backlash": "play of the gear",
    "coulomb_friction": "dry friction",
    "deadband": "small commands without motion",
}


def write(folder: Path, diagnosis: Diagnosis, title: str, play: dict | None = None) -> list[Path]:
    """Writes report.html and plots/*.png into a folder and returns their paths, the page first.

    play: what the defect costs, {"nominal": {"rate", "low", "high"}, "extended": {...}, "retrained": {...} or None,
    "balls": n}, rates from 0 to 1. Raises OSError when the folder cannot be written; files that were there stay whole.
    """
    folder = Path(folder)
    pictures = _Pictures()
    page = _page(diagnosis, title, play, pictures)
    (folder / "plots").mkdir(parents=True, exist_ok=True)
    written = []
    for name, data in pictures.data.items():
        path = folder / "plots" / f"{name}.png"
        with replacing(path) as temporary:
            temporary.write_bytes(data)
        written.append(path)
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return [folder / "report.html", *written]


def sentence(diagnosis: Diagnosis) -> str:
    """The verdict in plain words."""
    v = diagnosis.verdict
    if v.verdict == "none":
        return _nothing(diagnosis)
    if v.verdict == "unexplained":
        text = f"Something is wrong that no entry of the catalogue explains: {_odd(v.unexplained)}."
        names = ", ".join(c.name for c in v.causes)
        return text + (f" Beside it, to be taken with caution until it is understood: {names}." if names else "")
    named = " ".join(f"{claim(c)}: named {c.name}{_alike(c)}." for c in v.causes)
    if v.verdict == "undetermined":
        return f"Several sets of causes explain these logs equally well; the best of them: {named}"
    return named if len(v.causes) < 2 else f"{len(v.causes)} things are wrong. {named}"


def claim(cause: Cause) -> str:
    """What a cause means, with its size and 90 % interval."""
    joint, dot, effect = cause.name.rpartition(".")
    if effect == "magnus":
        return _spin_claim(cause)
    e = next(iter(cause.parameters.values()))
    words = (ROBOT_CLAIMS if dot else CLAIMS).get(effect, ("", "", f"{MEANING.get(effect, effect)}: {{instead}}"))
    return f"{joint} {_say(words, e)}" if dot else _say(words, e)


def detectable(found: BallFindings) -> dict[str, float]:
    """Smallest shift of a flight's last sample [mm] at which each effect that was not named would have shown, by name.

    The gates of ``select`` but the practical floor: evidence and standard errors, beside what was named; infinite where
    the logs do not excite the effect.
    """
    choice, trial = found.choice, found.trial
    scores = (
        evidence.with_spin(found.projected, choice.prior.std) if choice.spin else evidence.without_spin(found.projected)
    )
    base = [*choice.effects, *scores.always]
    others = [j for j in range(len(trial.effects)) if j not in base]
    own, gram = evidence.unexplained_scores(scores, base, others)
    out = {}
    for j, score, information in zip(others, own.T, np.diagonal(gram)):
        if not found.seen[j] or information <= 0.0:
            out[trial.effects[j].name] = math.inf
            continue
        error = math.sqrt(float(np.sum((score - score.mean()) ** 2))) / information
        least = max(math.sqrt(choice.threshold / information), select.LEAST_Z * error)
        out[trial.effects[j].name] = 1e3 * least * float(trial.shift[j])
    return out


# Numbers with units


def _span(middle: float, low: float, high: float, unit: str) -> tuple[str, str, str, str]:
    """The three numbers and the unit as a reader wants them: as many digits as the interval deserves."""
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
    return *texts, {"1": ""}.get(name, name.replace("^2", "²"))


def _join(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text


def _interval(middle: float, low: float, high: float, unit: str) -> str:
    m, a, b, name = _span(middle, low, high, unit)
    return f"{_join(m, name)} ({a} to {b})"


def _value(e: Estimate) -> str:
    """The estimate with its interval."""
    return _interval(e.estimate, e.low, e.high, e.unit)


def _size(e: Estimate) -> str:
    """The size of the change from the nominal value, with its interval."""
    ends = sorted(math.copysign(1.0, e.estimate - e.nominal) * (x - e.nominal) for x in (e.low, e.high))
    return _interval(abs(e.estimate - e.nominal), *ends, e.unit)


def _instead(e: Estimate) -> str:
    return f"{_value(e)} instead of {_nominal(e)}"


def _nominal(e: Estimate) -> str:
    if math.isinf(e.nominal):
        return "no limit"
    factor, name, below = DISPLAY.get(e.unit, (1.0, e.unit, math.inf))
    if not max(abs(x) for x in (e.estimate, e.low, e.high)) < below:
        factor, name = 1.0, e.unit
    return _join(f"{e.nominal * factor:.6g}", {"1": ""}.get(name, name.replace("^2", "²")))


# What a cause says: words for more and for less than nominal, and the sentence that takes them.
CLAIMS: dict[str, tuple[str, str, str]] = {
    "drag_coefficient": ("more", "less", "The air brakes the ball {way} than the model says, coefficient {instead}"),
    "magnus_coefficient": ("more", "less", "Spinning balls curve {way} than the model says, coefficient {instead}"),
    "spin_decay": ("faster", "more slowly", "The ball loses its spin {way} in flight, {instead}"),
    "wind_x": ("+x", "-x", "The air moves sideways, towards {way}, at {size}"),
    "wind_y": ("human (+y)", "robot (-y)", "The air moves along the table, towards the {way}, at {size}"),
    "wind_z": ("rises", "sinks", "The air {way} at {size}"),
    "gravity_tilt_x": (
        "+x", "-x", "Gravity also pulls towards {way}, with {size}, as if the measuring frame leaned across the table",
    ),
    "gravity_tilt_y": (
        "+y", "-y", "Gravity also pulls towards {way}, with {size}, as if the measuring frame leaned along the table",
    ),
    "gravity_scale": ("more slowly", "faster", "Balls fall {way} than the model says, acceleration {instead}"),
    "table_restitution": ("more", "less", "The table returns {way} speed than the model says, restitution {instead}"),
    "table_restitution_speed": ("rises", "falls", "The table's restitution {way} with the ball's speed, {instead}"),
    "table_friction": ("rougher", "smoother", "The table is {way} than the model says, friction {instead}"),
    "table_height": ("higher", "lower", "The table's surface lies {size} {way} than the model says"),
    "table_tilt_x": ("+x", "-x", "The table's surface rises towards {way} by {size}"),
    "table_tilt_y": ("+y", "-y", "The table's surface rises towards {way} by {size}"),
    "camera_scale": ("long", "short", "The camera measures lengths too {way}, scale {instead}"),
    "camera_rotation_x": ("", "", "The camera's frame is turned about x by {value}"),
    "camera_rotation_y": ("", "", "The camera's frame is turned about y by {value}"),
    "camera_rotation_z": ("", "", "The camera's frame is turned about the vertical by {value}"),
    "camera_distortion": ("", "", "The camera distorts the picture, {instead}"),
    "latency_jitter": ("", "", "The time stamps of the ball's positions scatter by {value}"),
    "tracker_smoothing": ("", "", "The tracker smooths the ball's positions, time constant {instead}"),
    "paddle_restitution": ("more", "less", "The paddle gives back {way} of the ball's speed than the model says, {instead}"),
    "paddle_friction": ("more", "less", "The rubber grips {way} than the model says, tangential gain {instead}"),
    "paddle_tilt": ("downwards", "upwards", "The blade looks {way} by {value}"),
    "paddle_offset": ("ahead of", "behind", "The blade lies {way} where the model has it, by {size}"),
    "ball_latency": ("later", "sooner", "The ball is measured {way} against the joints than the model says, {instead}"),
}  # fmt: skip
ROBOT_CLAIMS: dict[str, tuple[str, str, str]] = {
    "action_delay": ("later", "sooner", "acts {way} on a command than the model says, delay {instead}"),
    "observation_delay": ("later", "sooner", "is read {way} than the model says, delay {instead}"),
    "lag": ("", "", "follows its commands with a time constant of {instead}"),
    "velocity_gain": ("fast", "slowly", "moves too {way}, {value} of what it is told instead of {nominal}"),
    "joint_offset": ("high", "low", "reads {size} too {way}"),
    "velocity_limit": ("", "", "gets no faster than {instead}"),
    "acceleration_limit": ("", "", "gathers speed no faster than {instead}"),
    "backlash": ("", "", "has a play of {instead}"),
    "coulomb_friction": ("", "", "loses {instead} of every commanded velocity to dry friction"),
    "deadband": ("", "", "stands still for commands below {instead}"),
}


def _say(words: tuple[str, str, str], e: Estimate) -> str:
    up, down, text = words
    way = up if e.estimate > e.nominal else down
    return text.format(way=way, value=_value(e), size=_size(e), instead=_instead(e), nominal=_nominal(e))


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


def _alike(cause: Cause) -> str:
    others = cause.group[1:]
    if not others:
        return ""
    names = [f"{name} ({MEANING[name.split('.')[-1]]})" if name.split(".")[-1] in MEANING else name for name in others]
    return f"; the same log would look alike with {_or(names)}"


def _or(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " or " + names[-1]


def _odd(u: Unexplained) -> str:
    along = f"mostly in {u.direction}" if u.direction in ("x", "y", "z") else f"direction {u.direction}"
    if u.block == SUBSET:
        return f"{u.where} fly unlike the others, {along}, by {u.size}"
    return f"{_block(u.block)}, largest at {u.where}, {along}, {u.size}"


def _block(name: str) -> str:
    """An anonymous block in words."""
    joint, colon, rest = name.rpartition(": ")
    kinds = (
        ("force over ", "a force that changes with "),
        ("bounce over ", "a bounce that changes with "),
        ("measured position over ", "a shift of the measured position that changes with "),
        ("jump of the measured position at ", "a jump of the measured position across a plane in "),
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


def _nothing(diagnosis: Diagnosis) -> str:
    parts = []
    if diagnosis.balls is not None:
        found = diagnosis.balls
        floor = 1e3 * select.FLOOR
        sizes = [max(s, floor) for s in detectable(found).values() if math.isfinite(s)]
        small = f", but for what is too small to matter, {_small(found)}" if _small(found) else ""
        text = f"The model agrees with {found.problem.grid.n} balls to within the noise{small}: nothing is named"
        if sizes:
            reach = f"{floor:.0f}" if max(sizes) < floor + 0.05 else f"{min(sizes):.1f} to {max(sizes):.1f}"
            text += (
                f"; each of the {len(sizes)} effects that these balls can show would have been named once it shifted"
                f" the last sample of a flight by {reach} mm"
            )
        parts.append(text + ".")
    if diagnosis.robot is not None:
        worst = max((g.before * 1e3 for g in diagnosis.robot.held_out), default=0.0)
        parts.append(
            "The joints follow the model to within the noise: no drive effect is named; positions not used are"
            f" predicted to {worst:.2g} mm or mrad rms at worst."
        )
    return " ".join(parts)


# The page


class _Pictures:
    """Pictures of the page by name."""

    def __init__(self) -> None:
        self.data: dict[str, bytes] = {}

    def add(self, name: str, figure: Figure, caption: str, alt: str) -> str:
        """HTML of a picture; ``caption`` is HTML."""
        self.data[name] = plots.png(figure)
        source = base64.b64encode(self.data[name]).decode("ascii")
        return (
            f'<figure><div class="wide"><img src="data:image/png;base64,{source}" alt="{escape(alt)}"></div>'
            f"<figcaption>{caption}</figcaption></figure>"
        )


def _page(d: Diagnosis, title: str, play: dict | None, pictures: _Pictures) -> str:
    v = d.verdict
    sections = [
        ("What the simulation gets wrong", _residuals(d, pictures)),
        ("Verdict", _verdict(d, pictures)),
        ("Other explanations, and why they lost", _runners(d, pictures)),
        ("What these logs cannot tell", _open_questions(v)),
        ("Parameters", _parameters(d, pictures)),
        ("Gain on data that was not used", _held_out(d, pictures)),
        ("What it costs in play", _play(play, pictures) if play else ""),
        ("What to measure next", _next(v)),
        ("Data and noise", _data(d)),
    ]
    body = "\n".join(
        f'<section id="s{k}">\n<h2>{escape(heading)}</h2>\n{content}\n</section>'
        for k, (heading, content) in enumerate(((h, c) for h, c in sections if c), 1)
    )
    names = ", ".join(c.name for c in v.causes)
    state = {
        "named": names,
        "none": "nothing wrong",
        "unexplained": "no entry explains it",
        "undetermined": "not decided",
    }[v.verdict]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<meta name="viewport"'
        ' content="width=device-width, initial-scale=1">\n<title>Diagnosis:'
        f" {escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<header>\n<h1>Measured against"
        f' simulated</h1>\n<p class="sub">{escape(title)} · {escape(_amount(d))}</p>\n<p><span class="badge'
        f' {v.verdict}">{escape(v.verdict)}</span>'
        f" {escape(state)}</p>\n</header>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def _amount(d: Diagnosis) -> str:
    parts = []
    if d.balls is not None:
        sessions = int(d.balls.sessions.max()) + 1
        parts.append(f"{d.balls.problem.grid.n} balls in {sessions} session{'s' if sessions > 1 else ''}")
    if d.robot is not None:
        parts.append(f"{len(d.robot.residuals)} joint{'s' if len(d.robot.residuals) > 1 else ''}")
    return ", ".join(parts)


def _residuals(d: Diagnosis, pictures: _Pictures) -> str:
    out = []
    if d.balls is not None:
        figure, words = plots.flight_residuals(d.balls)
        out.append(
            pictures.add(
                "residuals_flight",
                figure,
                "<b>How to read it.</b> Each panel shows where the balls were measured relative to where the model"
                " says they are, along one axis of the table. Line: median of all balls; dark band: middle 50 % of the"
                " samples; light band: middle 90 %. A right model leaves a line on zero and bands that are the noise."
                " The start of each ball is fitted under the model in question, so a wrong model shows as a line that"
                f" bends or kinks, not as one that drifts away. {escape(words[0].upper() + words[1:])}.",
                f"Residuals along the flight. {words}",
            )
        )
        out.append(
            pictures.add(
                "residuals_quantities",
                plots.quantity_residuals(d.balls),
                "The same residuals against other quantities. A pattern in one column says what the error depends on:"
                " the speed (drag), the height or the place (air, camera), the time in the session (something that"
                " drifts). Lines: medians; bands: middle 50 %; dotted: middle 90 %.",
                "Residuals against speed, height, place along the table and time in the session",
            )
        )
    if d.robot is not None:
        out.append(
            pictures.add(
                "residuals_joints",
                plots.joint_residuals(d.robot),
                "<b>How to read it.</b> Measured minus predicted position of each joint, left over time, right against"
                " its velocity (line: median, band: middle 50 %, dotted: middle 90 %). A slope on the right is a delay"
                " or a lag; a step at zero velocity is play or friction; a kink at high velocity is a limit. Each 2 s"
                " have an offset of their own, so slow drift does not show. Mind the scales, which differ.",
                "Residuals of the joints over time and against velocity",
            )
        )
    return "\n".join(out)


def _verdict(d: Diagnosis, pictures: _Pictures) -> str:
    v = d.verdict
    out = [f'<p class="verdict {v.verdict}">{escape(sentence(d))}</p>']
    if v.causes:
        head = ("cause", "what it says", "confidence", _effect_head(v.causes))
        out.append(
            _table(
                head,
                [(_code(c.name), escape(claim(c)), _confidence(c.confidence), _effect(c)) for c in v.causes],
                right=(2, 3),
            )
        )
        out.append(
            '<p class="note">Confidence: how often this cause, or one that it cannot be told from, is chosen again when'
            " the balls are drawn anew (for joints: its weight against the rival explanations). It counts for the group"
            " as a whole, and it cannot know of a cause that is not in the catalogue. The effect is that on the last"
            " sample of a flight, for joints the rms of the motion.</p>"
        )
    if d.balls is not None and d.balls.findings:
        out.append("<h3>What no entry of the catalogue explains</h3>")
        out.append(
            _table(
                ("kind", "where it is largest", "direction", "size [mm]", "evidence"),
                [
                    (
                        "balls that fly unlike the others" if f.block == SUBSET else escape(_block(f.block)),
                        escape(f.where),
                        escape(f.direction),
                        f"{1e3 * f.size:.1f}",
                        f"{f.gain:.0f}",
                    )
                    for f in d.balls.findings[:8]
                ],
                right=(3, 4),
            )
        )
        if any(f.block.startswith("bounce") for f in d.balls.findings):
            out.append(
                pictures.add(
                    "bounce_map",
                    plots.bounce_map(d.balls),
                    "Where each ball bounced, coloured by how much higher or lower it flew after the bounce than"
                    " predicted (median of its samples after the bounce). Colours that stay together in a place are a"
                    " property of that place.",
                    "Map of the residuals after the bounce",
                )
            )
        out.append(
            '<p class="note">Functions without a name that stay significant beside the causes. One physical error shows'
            " in several of them; the first row explains most. Evidence: squared error that the function takes away, in"
            " units of the noise.</p>"
        )
    if d.robot is not None and d.robot.unexplained_by_joint:
        out.append("<h3>What no entry of the catalogue explains in the joints</h3>")
        out.append(
            _table(
                ("joint", "kind", "where", "direction", "size [mm], [mrad]"),
                [
                    tuple(escape(str(u[k])) for k in ("joint", "block", "where", "direction")) + (f"{u['size']:.2f}",)
                    for u in d.robot.unexplained_by_joint
                ],
                right=(4,),
            )
        )
    small = _small(d.balls) if d.balls is not None else ""
    if small:
        out.append(
            f'<p class="note">Seen, but too small to be named (less than {1e3 * select.FLOOR:.0f} mm at the end of a'
            f" flight): {escape(small)}.</p>"
        )
    if v.warnings:
        out.append("<ul>" + "".join(f"<li>{escape(w)}</li>" for w in v.warnings) + "</ul>")
    if d.balls is not None:
        out.append(_detectable(d))
    return "\n".join(out)


def _small(found: BallFindings) -> str:
    """Effects that the evidence asks for, but that move a flight's end by less than the practical floor."""
    choice, trial = found.choice, found.trial
    sizes = {trial.effects[j].name: abs(t) * float(trial.shift[j]) for j, t in zip(choice.effects, choice.theta)}
    return ", ".join(f"{name} ({1e3 * size:.1f} mm)" for name, size in sizes.items() if size < select.FLOOR)


def _detectable(d: Diagnosis) -> str:
    sizes = sorted(detectable(d.balls).items(), key=lambda x: x[1])
    floor = 1e3 * select.FLOOR
    rows = [
        (_code(name), escape(MEANING.get(name, "")))
        + ((f"{size:.2f}", f"{max(size, floor):.1f}") if math.isfinite(size) else ("not excited", "-"))
        for name, size in sizes
        if name not in INVISIBLE
    ]
    opened = " open" if d.verdict.verdict == "none" else ""
    return (
        f"<details{opened}><summary>What was checked, and how small an effect would have been seen</summary>"
        + _table(("effect that was not named", "meaning", "shows from [mm]", "named from [mm]"), rows, right=(2, 3))
        + '<p class="note">Shift of a flight\'s last sample from which the effect, alone beside what is named, would'
        f" stand out of the noise (evidence of {d.balls.choice.threshold:.0f}, {select.LEAST_Z} standard errors), and"
        f" from which it would be named: nothing below {floor:.0f} mm is of interest. Smooth forces, kicks at the"
        " bounce and shifts of the measured position without a name were checked as well.</p></details>"
    )


def _confidence(share: float) -> str:
    return "over 99 %" if share > 0.99 else _percent(share)


def _percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %"


def _effect_head(causes: Iterable[Cause]) -> str:
    units = {"mrad" if c.name.startswith("joint_") else "mm" for c in causes}
    return f"effect [{units.pop()}]" if len(units) == 1 else "effect"


def _effect(c: Cause) -> str:
    return f"{c.effect_mm:.1f}" + (" mrad" if c.name.startswith("joint_") else " mm" if "." in c.name else "")


def _runners(d: Diagnosis, pictures: _Pictures) -> str:
    if d.balls is None:
        return ""
    choice, trial = d.balls.choice, d.balls.trial

    def names(subset, spun) -> tuple[str, ...]:
        return tuple(trial.effects[i].name for i in subset) + (("magnus",) if spun and trial.spin == "none" else ())

    def price(subset, spun) -> float:
        return choice.threshold * len(subset) + (select.SPIN_GAIN if spun and trial.spin == "none" else 0.0)

    best = choice.gain - price(choice.effects, choice.spin)
    chosen = names(choice.effects, choice.spin)
    alike = {
        (tuple(sorted((*choice.effects[:i], other, *choice.effects[i + 1 :]))), choice.spin)
        for i, group in enumerate(choice.groups)
        for other in group[1:]
    }
    sets = {(s, spun): gain for s, spun, gain in [*choice.runners_up[:RUNNERS], *_rivals(d.balls)]}
    rivals = sorted(
        (
            (best - gain + price(*key), names(*key), gain - choice.gain, key in alike)
            for key, gain in sets.items()
            if key[0] or key[1] or choice.effects
        ),
        key=lambda r: r[0],
    )
    if not rivals:
        return "<p>No other set of causes came near.</p>"
    nothing = "nothing (the nominal model)"
    rows = [
        (escape(" + ".join(r) or nothing), escape(_why(chosen, r, gain, behind, choice.threshold, like)))
        for behind, r, gain, like in rivals
    ]
    figure = plots.runners(
        [" + ".join(r) or nothing for _, r, *_ in rivals],
        [max(b, 0.0) for b, *_ in rivals],
        " + ".join(chosen) or nothing,
    )
    return pictures.add(
        "runners_up",
        figure,
        "How far other sets of causes are behind the chosen one: squared error in units of the noise that they fit"
        " worse, and what they have to pay for more causes. Among them, for each cause, the best set without it and"
        f" without what looks like it. One more cause must bring at least {choice.threshold:.0f}, which is what chance"
        " reaches in these data.",
        "Bar chart of other sets of causes",
    ) + _table(("other set", "why it lost (fit: squared error in units of the noise)"), rows)


def _rivals(found: BallFindings) -> list[tuple[tuple[int, ...], bool, float]]:
    """Sets that a reader asks for: each cause replaced by what looks like it, and the best set without all of these.

    Beside the chosen effects only those enter that the data could show, as in ``select``.
    """
    choice, p = found.choice, found.projected
    scores = evidence.with_spin(p, choice.prior.std) if choice.spin else evidence.without_spin(p)
    useful = [i for i in np.flatnonzero(found.seen).tolist() if i not in scores.always]
    out = []

    def best(scores, candidates, spun) -> None:
        gains = evidence.all_gains(scores, tuple(candidates))
        subset = max(gains, key=lambda s: gains[s] - choice.threshold * len(s))
        out.append((subset, spun, float(gains[subset])))

    for i, group in enumerate(choice.groups):
        rest = choice.effects[:i] + choice.effects[i + 1 :]
        for other in group[1:]:
            subset = tuple(sorted((*rest, other)))
            out.append((subset, choice.spin, float(evidence.gain(scores, subset))))
        best(scores, [k for k in useful if k not in group], choice.spin)
    if choice.spin and found.trial.spin == "none":
        best(evidence.without_spin(p), [k for k in useful if not found.trial.effects[k].needs_spin], False)
    return out


def _why(chosen: Sequence[str], rival: Sequence[str], gain: float, behind: float, threshold: float, alike: bool) -> str:
    """Why a rival set lost. gain: squared error, in units of the noise, that it explains beyond the chosen set.

    alike: it is the chosen set with one cause replaced by one that the diagnosis groups with it.
    """
    fit = "fits no better" if abs(gain) < 0.5 else f"fits {'worse' if gain < 0 else 'better'} by {abs(gain):,.0f}"
    more = len(rival) - len(chosen)
    if alike and abs(gain) >= select.TIE:
        return f"{fit}, but its pattern is too much like that of the chosen one to tell the two apart"
    if more == 0 and abs(gain) < select.TIE:
        return f"{fit}: less than {select.TIE:.0f}, so these logs do not tell the two apart"
    if behind <= 0.0:
        return f"{fit}, but one of its causes is too small or too uncertain to be named"
    if more > 0:
        count = "one more effect" if more == 1 else f"{more} more effects"
        return f"{fit}; needs {count}" + (
            "" if "magnus" in set(rival) - set(chosen) else f", and each must bring {threshold:.0f}"
        )
    return fit + ("" if more == 0 else " with one effect less" if more == -1 else f" with {-more} effects less")


def _open_questions(v: Verdict) -> str:
    out = []
    rows = []
    for c in v.causes:
        if len(c.group) > 1 or c.separating_measurement:
            readings = [escape(part) for part in c.separating_measurement.split("; ") if part]
            others = ", ".join(_code(name) for name in c.group[1:]) or "-"
            rows.append((_code(c.name), others, "<br>".join(readings) or "-"))
    if rows:
        out.append("<h3>What would settle what is named</h3>")
        out.append(_table(("named", "would look the same", "reading that would tell"), rows))
    for heading, lines in (
        ("Not identifiable from such logs", v.not_identifiable),
        ("Not excited in these logs", v.not_excited),
    ):
        if lines:
            out.append(f"<h3>{heading}</h3>\n" + _lines(lines))
    return (
        "\n".join(out) or "<p>Nothing: every effect of the catalogue was excited, and what is named has no double.</p>"
    )


def _lines(lines: Sequence[str]) -> str:
    """Lines "name: why" as a table, the joints of one effect in one row."""
    groups: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for line in lines:
        line = line.replace("^2", "²").replace("instead of inf ", "instead of no limit ")
        name, _, why = line.partition(": ")
        joint, _, effect = name.rpartition(".")
        groups.setdefault((effect, "" if joint else why), []).append((joint, why))
    rows = []
    for (effect, _), members in groups.items():
        joints = ", ".join(j for j, _ in members if j)
        whys = list(dict.fromkeys(w for _, w in members if w))
        why = (
            whys[0]
            if len(whys) == 1
            else f"for instance {members[0][0]}: {whys[0]}" if whys else MEANING.get(effect, "")
        )
        rows.append((_code(effect), escape(joints), escape(why)))
    if any(r[1] for r in rows):
        return _table(("effect", "joints", "why"), rows)
    return _table(("effect", "why" if any(": " in line for line in lines) else "meaning"), [(a, c) for a, _, c in rows])


def _parameters(d: Diagnosis, pictures: _Pictures) -> str:
    causes = d.verdict.causes
    if not causes:
        return "<p>No parameter is changed: extended.yaml is the nominal model.</p>"
    rows = []
    for c in causes:
        effect = BY_NAME.get(c.name)
        twins = {t.path for t in effect.twins} if effect else set()
        for k, (path, e) in enumerate(c.parameters.items()):
            middle, low, high, unit = _span(e.estimate, e.low, e.high, e.unit)
            name = _code(path) if "." in path else _code(c.name.rpartition(".")[0] + "." + path)
            role = "or instead" if path in twins else ""
            nominal = _nominal(e).removesuffix(unit).strip()
            rows.append((_code(c.name) if not k else role, name, nominal, f"<b>{middle}</b>", f"{low} to {high}", unit))
    out = [_table(("cause", "parameter", "nominal", "estimate", "90 % interval", "unit"), rows, right=(2, 3, 4))]
    forest = plots.forest_rows(causes, d.balls)
    if forest:
        out.append(
            pictures.add(
                "parameters",
                plots.forest(forest),
                "Estimates (dots) and 90 % intervals (bars), drawn as what they move, so that parameters of different"
                " units compare.",
                "Forest plot of the parameters",
            )
        )
    out.append(
        "<p>extended.yaml holds these estimates, except those marked “or instead”. The next training"
        " uses it with <code>mjx-tt train my.yaml --set model=DIR/extended.yaml</code>.</p>"
    )
    return "\n".join(out)


def _held_out(d: Diagnosis, pictures: _Pictures) -> str:
    out = []
    h = d.verdict.held_out
    if h is not None:
        if not d.verdict.causes:
            judged = "nothing was changed, so there is no gain to claim"
        elif h.low > 0.0:
            judged = "the interval excludes zero: the extended model predicts better"
        else:
            judged = "the interval includes zero: <b>no gain is claimed</b>"
        out.append(
            f"<p><b>{h.before:.2f} → {h.after:.2f}</b>, gain {h.before - h.after:.2f} (90 % interval {h.low:.2f} to"
            f" {h.high:.2f}): {judged}. Measured: {escape(h.metric)}.</p>"
        )
    if d.prediction is not None and d.verdict.causes:
        out.append(
            pictures.add(
                "held_out",
                plots.held_out(d.prediction),
                "Each ball is predicted by a model whose parameters come from other balls: its state from the first 30"
                " % of its samples, the rest compared. The state from so short a piece is uncertain, which is most of"
                " the error that remains.",
                "Held-out errors ball by ball",
            )
        )
    if d.robot is not None and d.robot.held_out:
        out.append(
            pictures.add(
                "held_out_joints",
                plots.joint_gains(d.robot),
                "Positions predicted on every other window of the log, with parameters fitted to the rest.",
                "Held-out errors of the joints",
            )
        )
        out.append(
            "<details><summary>Joint by joint</summary>"
            + _table(
                ("joint", "before", "after", "gain, 90 % interval", "unit"),
                [
                    (
                        escape(g.joint),
                        f"{1e3 * g.before:.3f}",
                        f"{1e3 * g.after:.3f}",
                        f"{1e3 * g.low:.3f} to {1e3 * g.high:.3f}",
                        "mm" if g.joint.startswith("gantry") else "mrad",
                    )
                    for g in d.robot.held_out
                ],
                right=(1, 2, 3),
            )
            + "</details>"
        )
    return "\n".join(out)


def _play(play: dict, pictures: _Pictures) -> str:
    labels = {
        "nominal": "in the nominal simulation",
        "extended": "in the extended simulation, same policy",
        "retrained": "in the extended simulation, retrained",
    }
    rates = [
        (label, *(float(play[k][x]) for x in ("rate", "low", "high"))) for k, label in labels.items() if play.get(k)
    ]
    lost = rates[0][1] - rates[1][1]
    text = f"<p>The defect costs {100 * lost:.1f} percentage points of the balls that this policy returns" + (
        f"; retraining under the extended model brings {100 * (rates[2][1] - rates[1][1]):.1f} back"
        if len(rates) > 2
        else ""
    )
    table = _table(
        ("where", "returned", "interval"),
        [(escape(n), _percent(r, 1), f"{_percent(a, 1)} to {_percent(b, 1)}") for n, r, a, b in rates],
        right=(1, 2),
    )
    figure = pictures.add(
        "play", plots.play(rates), f"Return rate on {int(play['balls']):,} balls each, with intervals.", "Return rates"
    )
    return text + ".</p>" + table + figure


def _next(v: Verdict) -> str:
    steps = v.next_experiment
    if not steps:
        return "<p>These logs leave nothing that another throw or sweep would settle.</p>"

    def item(e) -> str:
        tells = f'<br><span class="note">tells {escape(", ".join(e.separates))}</span>' if e.separates else ""
        worth = f' <span class="note">(expected evidence {e.gain:.0f})</span>' if e.gain > 0.0 else ""
        return f"<li>{escape(e.what)}{worth}{tells}</li>"

    text = "<ol>" + "".join(map(item, steps[:FEW])) + "</ol>"
    if len(steps) > FEW:
        text += (
            f"<details><summary>{len(steps) - FEW} more</summary><ol start={FEW + 1}>"
            + "".join(map(item, steps[FEW:]))
            + "</ol></details>"
        )
    readings = [r for c in v.causes if len(c.group) > 1 for r in c.separating_measurement.split("; ") if r]
    if readings:
        text += "<p>Or take a reading: " + escape("; ".join(dict.fromkeys(readings))) + ".</p>"
    return text


def _data(d: Diagnosis) -> str:
    out = []
    if d.balls is not None:
        found = d.balls
        scale, memory = 1e3 * found.noise.scale, found.noise.memory
        rows = [
            (
                name,
                f"{np.median(scale[a]):.2f}",
                f"{np.percentile(scale[a], 5):.2f} to {np.percentile(scale[a], 95):.2f}",
                f"{memory[a]:.2f}",
            )
            for a, name in enumerate(("along the flight", "across it, level", "upright to both"))
        ]
        out.append(_table(("direction", "noise [mm]", "5 to 95 % of the balls [mm]", "memory"), rows, right=(1, 2, 3)))
        samples = int(found.problem.grid.mask.sum())
        out.append(
            '<p class="note">Noise of the measured positions as the residuals show it; memory: correlation of'
            f" neighbours {1e3 * found.noise.interval:.1f} ms apart. {found.problem.grid.n} flights with {samples:,}"
            " samples were used, each up to where the ball turns back.</p>"
        )
    logs = d.extended.provenance.get("logs", {})
    if logs:
        rows = [(_code(name), f'<code class="hash">{escape(str(digest))}</code>') for name, digest in logs.items()]
        out.append(_table(("file", "SHA-256"), rows))
    return "\n".join(out)


def _code(name: str) -> str:
    """A name of the catalogue or of a parameter, which may break after its dots and underscores."""
    return f"<code>{escape(str(name)).replace('_', '_<wbr>').replace('.', '.<wbr>')}</code>"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int] = ()) -> str:
    """A table; cells are HTML, columns ``right`` hold numbers."""

    def row(tag: str, cells: Sequence[str]) -> str:
        classes = ["" if k not in right else " class=n" for k in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{c}>{cell}</{tag}>" for c, cell in zip(classes, cells)) + "</tr>"

    top, body = row("th", [escape(h) for h in head]), "".join(row("td", r) for r in rows)
    wide = ' class="many"' if len(head) > 4 else ""
    return f'<div class="wide"><table{wide}><thead>{top}</thead><tbody>{body}</tbody></table></div>'


STYLE = f"""
:root {{ color-scheme: light; }}
* {{ box-sizing: border-box; }}
body {{ margin: 0; background: #f4f5f7; color: {plots.INK};
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }}
header, main {{ max-width: 1000px; margin: 0 auto; padding: 0 20px; }}
header {{ padding-top: 28px; }}
h1 {{ font-size: 1.7rem; margin: 0; }}
h2 {{ font-size: 1.25rem; margin: 0 0 .7rem; }}
h3 {{ font-size: 1rem; margin: 1.4rem 0 .4rem; }}
.sub, .note {{ color: #4d5661; }}
.sub {{ margin: .2rem 0 .8rem; overflow-wrap: anywhere; }}
.note {{ font-size: .88rem; }}
section {{ background: #fff; border: 1px solid #dfe3e8; border-radius: 8px; padding: 20px 24px; margin: 18px 0; }}
.badge {{ display: inline-block; padding: .1rem .6rem; border-radius: 4px; color: #fff; background: #4d5661;
  font-weight: 600; }}
.badge.named {{ background: {plots.AFTER}; }}
.badge.unexplained, .badge.undetermined {{ background: {plots.BEFORE}; }}
p.verdict {{ font-size: 1.12rem; border-left: 5px solid #4d5661; padding: .2rem 0 .2rem 1rem; margin: 0 0 1rem; }}
p.verdict.named {{ border-color: {plots.AFTER}; }}
p.verdict.unexplained, p.verdict.undetermined {{ border-color: {plots.BEFORE}; }}
figure {{ margin: 0 0 1.2rem; }}
figcaption {{ font-size: .9rem; color: #4d5661; margin-top: .4rem; }}
section > :last-child, section > :last-child > :last-child {{ margin-bottom: 0; }}
li {{ margin-bottom: .45rem; }}
.wide {{ overflow-x: auto; }}
img {{ display: block; width: 100%; min-width: 600px; height: auto; }}
table {{ border-collapse: collapse; width: 100%; font-size: .93rem; margin: .3rem 0 .6rem; }}
table.many {{ min-width: 560px; }}
th, td {{ text-align: left; vertical-align: top; padding: .35rem .8rem .35rem 0; border-bottom: 1px solid #e6e9ed; }}
th {{ font-weight: 600; color: #4d5661; border-bottom-color: {plots.FAINT}; }}
.n {{ text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }}
code {{ font: .9em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }}
.hash {{ overflow-wrap: anywhere; }}
summary {{ cursor: pointer; color: {plots.AFTER}; margin: .6rem 0; }}
@media (max-width: 640px) {{ section {{ padding: 14px 12px; }}
  header, main {{ padding-left: 10px; padding-right: 10px; }}
  td, th {{ padding-right: .5rem; }} }}
@media print {{ body {{ background: #fff; }} section {{ border: 0; }} }}
"""
