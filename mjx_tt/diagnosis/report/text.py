"""The words of a diagnosis: what the names of the catalogue mean, and a verdict as sentences with numbers and units."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjx_tt.diagnosis.ball import scores as evidence
from mjx_tt.diagnosis.ball import selection
from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.diagnose import Diagnosis
from mjx_tt.diagnosis.verdict import Cause, Estimate, Unexplained

SUBSET = "a subset of the balls"  # block of balls of their own kind
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
    others = [j for j in range(len(trial.effects)) if j not in base and j not in trial.left_out]
    own, gram = evidence.unexplained_scores(scores, base, others)
    out = {}
    for j, score, information in zip(others, own.T, np.diagonal(gram)):
        if not found.seen[j] or information <= 0.0:
            out[trial.effects[j].name] = math.inf
            continue
        error = math.sqrt(float(np.sum((score - score.mean()) ** 2))) / information
        least = max(math.sqrt(choice.threshold / information), selection.LEAST_Z * error)
        out[trial.effects[j].name] = 1e3 * least * float(trial.shift[j])
    return out


# Numbers with units


def span(middle: float, low: float, high: float, unit: str) -> tuple[str, str, str, str]:
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
    m, a, b, name = span(middle, low, high, unit)
    return f"{_join(m, name)} ({a} to {b})"


def _value(e: Estimate) -> str:
    """The estimate with its interval."""
    return _interval(e.estimate, e.low, e.high, e.unit)


def _size(e: Estimate) -> str:
    """The size of the change from the nominal value, with its interval."""
    ends = sorted(math.copysign(1.0, e.estimate - e.nominal) * (x - e.nominal) for x in (e.low, e.high))
    return _interval(abs(e.estimate - e.nominal), *ends, e.unit)


def _instead(e: Estimate) -> str:
    return f"{_value(e)} instead of {nominal(e)}"


def nominal(e: Estimate) -> str:
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
        "+x",
        "-x",
        "Gravity also pulls towards {way}, with {size}, as if the measuring frame leaned across the table",
    ),
    "gravity_tilt_y": (
        "+y",
        "-y",
        "Gravity also pulls towards {way}, with {size}, as if the measuring frame leaned along the table",
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
    "paddle_restitution": (
        "more",
        "less",
        "The paddle gives back {way} of the ball's speed than the model says, {instead}",
    ),
    "paddle_friction": ("more", "less", "The rubber grips {way} than the model says, tangential gain {instead}"),
    "paddle_tilt": ("downwards", "upwards", "The blade looks {way} by {value}"),
    "paddle_offset": ("ahead of", "behind", "The blade lies {way} where the model has it, by {size}"),
    "ball_latency": ("later", "sooner", "The ball is measured {way} against the joints than the model says, {instead}"),
}
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
    return text.format(way=way, value=_value(e), size=_size(e), instead=_instead(e), nominal=nominal(e))


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
    return f"{block(u.block)}, largest at {u.where}, {along}, {u.size}"


def block(name: str) -> str:
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
        floor = 1e3 * selection.FLOOR
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
    choice, trial = found.choice, found.trial
    sizes = {trial.effects[j].name: abs(t) * float(trial.shift[j]) for j, t in zip(choice.effects, choice.theta)}
    return ", ".join(f"{name} ({1e3 * size:.1f} mm)" for name, size in sizes.items() if size < selection.FLOOR)
