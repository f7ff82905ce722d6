"""The report of a diagnosis: one HTML page that needs nothing else, and its pictures as PNG.

The order is that of a reader's questions: what does the simulation get wrong, what is the cause, why not another one,
what stays open, how much, what does it bring, what to measure next. Its sentences are those of ``words``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from mjx_tt.diagnosis.ball import scores, selection
from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.ball.effects import BY_NAME, INVISIBLE
from mjx_tt.diagnosis.diagnose import Diagnosis
from mjx_tt.diagnosis.hits import diagnose
from mjx_tt.diagnosis.report import figures
from mjx_tt.diagnosis.report import text as words
from mjx_tt.diagnosis.verdict import Cause, Verdict
from mjx_tt.viz.html import Page, table

RUNNERS = 5  # of the next best sets that are shown
FEW = 6  # next steps that are shown at once


def write(folder: Path, diagnosis: Diagnosis, title: str, play: dict | None = None) -> list[Path]:
    """Writes report.html and plots/*.png into a folder and returns their paths, the page first.

    play: what the defect costs, {"nominal": {"rate", "low", "high"}, "extended": {...}, "retrained": {...} or None,
    "balls": n}, rates from 0 to 1. Raises OSError when the folder cannot be written; files that were there stay whole.
    """
    folder = Path(folder)
    return _page(diagnosis, title, play).write(folder / "report.html", folder / "plots")


def _page(d: Diagnosis, title: str, play: dict | None) -> Page:
    v = d.verdict
    state = {
        "named": ", ".join(c.name for c in v.causes),
        "none": "nothing wrong",
        "unexplained": "no entry explains it",
        "undetermined": "not decided",
    }[v.verdict]
    badge = f'<span class="badge {v.verdict}">{escape(v.verdict)}</span> {escape(state)}'
    page = Page("Measured against simulated", f"{title} · {_amount(d)}", badge, CSS)
    for heading, content in (
        ("What the simulation gets wrong", _residuals(d, page)),
        ("Verdict", _verdict(d, page)),
        ("The robot's hits", _hits(d, page) if d.hits is not None else ""),
        ("Other explanations, and why they lost", _runners(d, page)),
        ("What these logs cannot tell", _open_questions(v)),
        ("Parameters", _parameters(d, page)),
        ("Gain on data that was not used", _held_out(d, page)),
        ("What it costs in play", _play(play, page) if play else ""),
        ("What to measure next", _next(v)),
        ("Data and noise", _data(d)),
    ):
        if content:
            page.section(re.sub("[^a-z]+", "-", heading.lower()), heading)
            page.add(content)
    return page


def _amount(d: Diagnosis) -> str:
    parts = []
    if d.balls is not None:
        sessions = int(d.balls.sessions.max()) + 1
        parts.append(f"{d.balls.problem.grid.n} balls in {sessions} session{'s' if sessions > 1 else ''}")
    if d.robot is not None:
        parts.append(f"{len(d.robot.residuals)} joint{'s' if len(d.robot.residuals) > 1 else ''}")
    return ", ".join(parts)


def _residuals(d: Diagnosis, page: Page) -> str:
    out = []
    if d.balls is not None:
        figure, largest = figures.flight_residuals(d.balls)
        out.append(
            page.picture(
                "residuals_flight",
                figure,
                "<b>How to read it.</b> Each panel shows where the balls were measured relative to where the model"
                " says they are, along one axis of the table. Line: median of all balls; dark band: middle 50 % of the"
                " samples; light band: middle 90 %. A right model leaves a line on zero and bands that are the noise."
                " The start of each ball is fitted under the model in question, so a wrong model shows as a line that"
                f" bends or kinks, not as one that drifts away. {escape(largest[0].upper() + largest[1:])}.",
                f"Residuals along the flight. {largest}",
            )
        )
        out.append(
            page.picture(
                "residuals_quantities",
                figures.quantity_residuals(d.balls),
                "The same residuals against other quantities. A pattern in one column says what the error depends on:"
                " the speed (drag), the height or the place (air, camera), the time in the session (something that"
                " drifts). Lines: medians; bands: middle 50 %; dotted: middle 90 %.",
                "Residuals against speed, height, place along the table and time in the session",
            )
        )
    if d.robot is not None:
        out.append(
            page.picture(
                "residuals_joints",
                figures.joint_residuals(d.robot),
                "<b>How to read it.</b> Measured minus predicted position of each joint, left over time, right against"
                " its velocity (line: median, band: middle 50 %, dotted: middle 90 %). A slope on the right is a delay"
                " or a lag; a step at zero velocity is play or friction; a kink at high velocity is a limit. Each 2 s"
                " have an offset of their own, so slow drift does not show. Mind the scales, which differ.",
                "Residuals of the joints over time and against velocity",
            )
        )
    return "\n".join(out)


def _verdict(d: Diagnosis, page: Page) -> str:
    v = d.verdict
    out = [f'<p class="verdict {v.verdict}">{escape(words.sentence(d))}</p>']
    if v.causes:
        head = ("cause", "what it says", "confidence", _effect_head(v.causes))
        out.append(
            table(
                head,
                [(_code(c.name), escape(words.claim(c)), _confidence(c.confidence), _effect(c)) for c in v.causes],
                right=(2, 3),
            )
        )
        out.append(
            '<p class="note">Confidence: how often this cause, or one that it cannot be told from, is chosen again when'
            " the balls are drawn anew (for joints: its weight against the rival explanations; at the paddle: from its"
            " error). It counts for the group as a whole, and it cannot know of a cause that is not in the catalogue."
            " The effect is that on the last sample of a flight, for joints the rms of the motion, at the paddle the"
            f" shift of the return {diagnose.RETURN:g} s after the hit.</p>"
        )
    if d.balls is not None and d.balls.findings:
        out.append("<h3>What no entry of the catalogue explains</h3>")
        out.append(
            table(
                ("kind", "where it is largest", "direction", "size [mm]", "evidence"),
                [
                    (
                        "balls that fly unlike the others" if f.block == words.SUBSET else escape(words.block(f.block)),
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
                page.picture(
                    "bounce_map",
                    figures.bounce_map(d.balls),
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
            table(
                ("joint", "kind", "where", "direction", "size [mm], [mrad]"),
                [
                    tuple(escape(getattr(u, k)) for k in ("joint", "block", "where", "direction")) + (f"{u.size:.2f}",)
                    for u in d.robot.unexplained_by_joint
                ],
                right=(4,),
            )
        )
    small = words.below_floor(d.balls) if d.balls is not None else ""
    if small:
        out.append(
            f'<p class="note">Seen, but too small to be named (less than {1e3 * selection.FLOOR:.0f} mm at the end of a'
            f" flight): {escape(small)}.</p>"
        )
    if v.warnings:
        out.append("<ul>" + "".join(f"<li>{escape(w)}</li>" for w in v.warnings) + "</ul>")
    if d.balls is not None:
        out.append(_detectable(d))
    return "\n".join(out)


def _detectable(d: Diagnosis) -> str:
    sizes = sorted(words.detectable(d.balls).items(), key=lambda x: x[1])
    floor = 1e3 * selection.FLOOR
    rows = [
        (_code(name), escape(words.description(name).meaning))
        + ((f"{size:.2f}", f"{max(size, floor):.1f}") if math.isfinite(size) else ("not excited", "-"))
        for name, size in sizes
        if name not in INVISIBLE
    ]
    opened = " open" if d.verdict.verdict == "none" else ""
    return (
        f"<details{opened}><summary>What was checked, and how small an effect would have been seen</summary>"
        + table(("effect that was not named", "meaning", "shows from [mm]", "named from [mm]"), rows, right=(2, 3))
        + '<p class="note">Shift of a flight\'s last sample from which the effect, alone beside what is named, would'
        f" stand out of the noise (evidence of {d.balls.choice.threshold:.0f}, {selection.LEAST_Z} standard errors), and"
        f" from which it would be named: nothing below {floor:.0f} mm is of interest. Smooth forces, kicks at the"
        " bounce and shifts of the measured position without a name were checked as well.</p></details>"
    )


def _hits(d: Diagnosis, page: Page) -> str:
    """Where the returns lie off, before and after, and what the hits could not show."""
    found = d.hits
    states = (found.before, found.after) if found.causes else (found.before,)
    rows, off = [], []
    for k in range(6):
        factor, unit, digits = (1e3, "mm", 1) if k < 3 else (1.0, "m/s", 2)
        what = f"{'place' if k < 3 else 'velocity'} {figures.AXES[k % 3]}"
        cells = []
        for values in states:
            numbers = [*figures.median_interval(factor * values[k]), *np.percentile(factor * values[k], (5, 95))]
            middle, low, high, few, many = (f"{round(x, digits) + 0.0:+.{digits}f}" for x in numbers)
            cells += [f"<b>{middle}</b> ({low} to {high})", f"{few} to {many}"]
        rows.append((f"{what} [{unit}]", *cells))
        middle, low, high = figures.median_interval(factor * states[-1][k])
        if low > 0.0 or high < 0.0:
            off.append(f"{what} {middle:+.{digits}f} {unit}")
    head = ["measured − predicted", "before: median", "hit to hit"]
    head += ["after: median", "hit to hit"] if found.causes else []
    out = [
        f"<p><b>{found.hits} hits</b> were judged: {_named_hits(d)} the typical return lies"
        f" {'off in ' + ', '.join(off) if off else 'where the model puts it, to within its error'}.</p>",
        page.picture(
            "hits",
            figures.hits(found),
            "<b>How to read it.</b> The model flies each ball to the racket, moves the blade as the joints were"
            " measured and plays the return. A dot is a hit: how far the measured return lies from that one, left its"
            " place at the moment of the hit, right its velocity. Diamonds: medians with their 90 % intervals;"
            " triangles on the edge: hits farther out. What all hits share moves the diamonds: a return that starts too"
            " early is ahead in place, a wrong rubber or a tilted blade shows in the velocity. The scatter is each"
            " hit's own (where on the rubber, an encoder's tick, a millisecond) and is the noise that a cause has to"
            " stand out of. The ball's own causes are settled before and after.",
            "Place and velocity behind the paddle, measured minus predicted, hit by hit",
        ),
        table(head, rows, right=range(1, len(head))),
        '<p class="note">Medians with 90 % intervals; hit to hit: the middle 90 %.</p>',
    ]
    named = {c.effect.name for c in found.causes}
    quiet = [BY_NAME[name] for name in found.quiet if name not in named]
    if quiet:
        out.append(
            "<h3>What these hits could not show</h3><p>A change of these that moves the return by"
            f" {2e3 * diagnose.LEAST_SHIFT:.0f} mm, {diagnose.RETURN:g} s after the hit, would have stayed in the scatter. More"
            " hits would show it, at other speeds and angles of the blade.</p>"
        )
        lines = [(_code(e.name), escape(e.meaning), escape(e.reading)) for e in quiet]
        out.append(table(("effect", "meaning", "reading that would tell"), lines))
    return "\n".join(out)


def _named_hits(d: Diagnosis) -> str:
    """What the hits name, as the start of a sentence."""
    names = [c.effect.name for c in d.hits.causes]
    if not names:
        return "they name nothing at the paddle, and"
    left = [name for name in names if name not in {c.name for c in d.verdict.causes}]
    but = f" (not in the verdict{'' if left == names else ': ' + ', '.join(left)})" if left else ""
    return f"they name {' and '.join(map(_code, names))}{but}. With {'it' if len(names) == 1 else 'them'},"


def _confidence(share: float) -> str:
    return "over 99 %" if share > 0.99 else _percent(share)


def _percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %"


def _effect_head(causes: Iterable[Cause]) -> str:
    units = {"mrad" if c.name.startswith("joint_") else "mm" for c in causes}
    return f"effect [{units.pop()}]" if len(units) == 1 else "effect"


def _effect(c: Cause) -> str:
    return f"{c.effect_mm:.1f}" + (" mrad" if c.name.startswith("joint_") else " mm" if "." in c.name else "")


def _runners(d: Diagnosis, page: Page) -> str:
    if d.balls is None:
        return ""
    choice, trial = d.balls.choice, d.balls.trial

    def names(subset, spun) -> tuple[str, ...]:
        return tuple(trial.effects[i].name for i in subset) + (("magnus",) if spun and trial.spin == "none" else ())

    def price(subset, spun) -> float:
        return choice.threshold * len(subset) + (selection.SPIN_GAIN if spun and trial.spin == "none" else 0.0)

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
    figure = figures.runners(
        [" + ".join(r) or nothing for _, r, *_ in rivals],
        [max(b, 0.0) for b, *_ in rivals],
        " + ".join(chosen) or nothing,
    )
    return page.picture(
        "runners_up",
        figure,
        "How far other sets of causes are behind the chosen one: squared error in units of the noise that they fit"
        " worse, and what they have to pay for more causes. Among them, for each cause, the best set without it and"
        f" without what looks like it. One more cause must bring at least {choice.threshold:.0f}, which is what chance"
        " reaches in these data.",
        "Bar chart of other sets of causes",
    ) + table(("other set", "why it lost (fit: squared error in units of the noise)"), rows)


def _rivals(found: BallFindings) -> list[tuple[tuple[int, ...], bool, float]]:
    """Sets that a reader asks for: each cause replaced by what looks like it, and the best set without all of these.

    Beside the chosen effects only those enter that the data could show, as in ``select``.
    """
    choice, p = found.choice, found.projected
    rated = found.scores()
    useful = [i for i in np.flatnonzero(found.seen).tolist() if i not in rated.always]
    out = []

    def best(rated, candidates, spun) -> None:
        gains = scores.all_gains(rated, tuple(candidates))
        subset = max(gains, key=lambda s: gains[s] - choice.threshold * len(s))
        out.append((subset, spun, float(gains[subset])))

    for i, group in enumerate(choice.groups):
        rest = choice.effects[:i] + choice.effects[i + 1 :]
        for other in group[1:]:
            subset = tuple(sorted((*rest, other)))
            out.append((subset, choice.spin, float(scores.gain(rated, subset))))
        best(rated, [k for k in useful if k not in group], choice.spin)
    if choice.spin and found.trial.spin == "none":
        best(scores.without_spin(p), [k for k in useful if not found.trial.effects[k].needs_spin], False)
    return out


def _why(chosen: Sequence[str], rival: Sequence[str], gain: float, behind: float, threshold: float, alike: bool) -> str:
    """Why a rival set lost. gain: squared error, in units of the noise, that it explains beyond the chosen set.

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
        out.append(table(("named", "would look the same", "reading that would tell"), rows))
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
            else f"for instance {members[0][0]}: {whys[0]}"
            if whys
            else words.description(effect).meaning
            if effect in BY_NAME
            else ""
        )
        rows.append((_code(effect), escape(joints), escape(why)))
    if any(r[1] for r in rows):
        return table(("effect", "joints", "why"), rows)
    return table(("effect", "why" if any(": " in line for line in lines) else "meaning"), [(a, c) for a, _, c in rows])


def _parameters(d: Diagnosis, page: Page) -> str:
    causes = d.verdict.causes
    if not causes:
        return "<p>No parameter is changed: extended.yaml is the nominal model.</p>"
    rows = []
    for c in causes:
        effect = BY_NAME.get(c.name)
        twins = {t.path for t in effect.twins} if effect else set()
        for k, (path, e) in enumerate(c.parameters.items()):
            middle, low, high, unit = words.span(e.estimate, e.low, e.high, e.unit)
            name = _code(path) if "." in path else _code(c.name.rpartition(".")[0] + "." + path)
            role = "or instead" if path in twins else ""
            nominal = words.nominal(e).removesuffix(unit).strip()
            rows.append((_code(c.name) if not k else role, name, nominal, f"<b>{middle}</b>", f"{low} to {high}", unit))
    out = [table(("cause", "parameter", "nominal", "estimate", "90 % interval", "unit"), rows, right=(2, 3, 4))]
    forest = figures.forest_rows(causes, d.balls)
    if forest:
        out.append(
            page.picture(
                "parameters",
                figures.forest(forest),
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


def _held_out(d: Diagnosis, page: Page) -> str:
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
            page.picture(
                "held_out",
                figures.held_out(d.prediction),
                "Each ball is predicted by a model whose parameters come from other balls: its state from the first 30"
                " % of its samples, the rest compared. The state from so short a piece is uncertain, which is most of"
                " the error that remains.",
                "Held-out errors ball by ball",
            )
        )
    if d.robot is not None and d.robot.held_out:
        out.append(
            page.picture(
                "held_out_joints",
                figures.joint_gains(d.robot),
                "Positions predicted on every other window of the log, with parameters fitted to the rest.",
                "Held-out errors of the joints",
            )
        )
        out.append(
            "<details><summary>Joint by joint</summary>"
            + table(
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


def _play(play: dict, page: Page) -> str:
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
    rows = table(
        ("where", "returned", "interval"),
        [(escape(n), _percent(r, 1), f"{_percent(a, 1)} to {_percent(b, 1)}") for n, r, a, b in rates],
        right=(1, 2),
    )
    figure = page.picture(
        "play",
        figures.play(rates),
        f"Return rate on {int(play['balls']):,} balls each, with intervals.",
        "Return rates",
    )
    return text + ".</p>" + rows + figure


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
        out.append(table(("direction", "noise [mm]", "5 to 95 % of the balls [mm]", "memory"), rows, right=(1, 2, 3)))
        samples = int(found.problem.grid.mask.sum())
        out.append(
            '<p class="note">Noise of the measured positions as the residuals show it; memory: correlation of'
            f" neighbours {1e3 * found.noise.interval:.1f} ms apart. {found.problem.grid.n} flights with {samples:,}"
            " samples were used, each up to where the ball turns back.</p>"
        )
    logs = d.extended.provenance.get("logs", {})
    if logs:
        rows = [(_code(name), f'<code class="hash">{escape(str(digest))}</code>') for name, digest in logs.items()]
        out.append(table(("file", "SHA-256"), rows))
    return "\n".join(out)


def _code(name: str) -> str:
    """A name of the catalogue or of a parameter, which may break after its dots and underscores."""
    return f"<code>{escape(str(name)).replace('_', '_<wbr>').replace('.', '.<wbr>')}</code>"


CSS = f"""
.badge.named {{ background: {figures.AFTER}; }}
.badge.unexplained, .badge.undetermined {{ background: {figures.BEFORE}; }}
p.verdict {{ font-size: 1.12rem; border-left: 5px solid #4d5661; padding: .2rem 0 .2rem 1rem; margin: 0 0 1rem; }}
p.verdict.named {{ border-color: {figures.AFTER}; }}
p.verdict.unexplained, p.verdict.undetermined {{ border-color: {figures.BEFORE}; }}
"""
