"""Report of a diagnosis: one HTML page that needs no other file, and its figures as PNG.

The verdict comes first, in one sentence and one picture. The order is then that of a reader's questions: where does it
show, why not another cause, what stays open, how much, what does it bring, what to measure next. Its HTML is that of
``templates``, its sentences are those of ``text``; a section is left away where its function gives no context.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
from markupsafe import Markup

from mjx_tt.diagnosis.ball.diagnose import FLOOR
from mjx_tt.diagnosis.ball.effects import BY_NAME, INVISIBLE
from mjx_tt.diagnosis.diagnose import Diagnosis
from mjx_tt.diagnosis.hits.diagnose import LEAST_SHIFT, RETURN
from mjx_tt.diagnosis.inclusion import LEAST_SHARE
from mjx_tt.diagnosis.report import figures, headline, residuals, text
from mjx_tt.diagnosis.verdict import Cause
from mjx_tt.viz.html import Page, environment

FEW = 6  # next steps that are shown at once
STATES = {"none": "nothing wrong", "unexplained": "no entry explains it", "undetermined": "not decided"}


def _code(name: str) -> Markup:
    """A name of the catalogue or of a parameter, which may break after its dots and underscores."""
    return Markup("<code>{}</code>").format(Markup(re.sub("([._])", r"\1<wbr>", str(Markup.escape(name)))))


_environment = environment("mjx_tt.diagnosis.report")
_environment.globals.update(before=residuals.BEFORE, after=residuals.AFTER)
_environment.filters["code"] = _code


class Rate(TypedDict):
    """Return rate from 0 to 1 with its interval."""

    rate: float
    low: float
    high: float


class Play(TypedDict):
    """Cost of the defect in play."""

    nominal: Rate
    extended: Rate
    retrained: Rate | None
    balls: int


Context = Mapping[str, object] | None


def write_report(folder: str | os.PathLike, diagnosis: Diagnosis, title: str, play: Play | None = None) -> list[Path]:
    """Writes `report.html` and `plots/*.png` into a folder and returns their paths, the page first.

    play: what the defect costs. Raises OSError when the folder cannot be written; files that were there stay whole.
    """
    folder = Path(folder)
    return _page(diagnosis, title, play).write(folder / "report.html", folder / "plots")


def _page(d: Diagnosis, title: str, play: Play | None) -> Page:
    v = d.verdict
    state = STATES.get(v.verdict) or ", ".join(c.name for c in v.causes)
    badge = Markup('<span class="badge {0}">{0}</span> {1}').format(v.verdict, state)
    css = _environment.get_template("report.css").render()
    page = Page("Measured against simulated", f"{title} · {_amount(d)}", badge, css)
    sections: tuple[tuple[str, str, Callable[[Diagnosis, Page], Context]], ...] = (
        ("Verdict", "verdict", _verdict),
        ("What the simulation gets wrong", "residuals", _residuals),
        ("The robot's hits", "hits", _hits),
        ("Sets of causes", "sets", _sets),
        ("What these logs cannot tell", "open_questions", _open_questions),
        ("Parameters", "parameters", _parameters),
        ("Gain on data that was not used", "held_out", _held_out),
        ("Spin of the balls", "spins", _spins),
        ("What it costs in play", "play", lambda d, page: _play(play, page)),
        ("What to measure next", "next", _next),
        ("What was taken out of the tracks", "cleaned", _cleaned),
        ("Data and noise", "data", _data),
    )
    for heading, template, context in sections:
        found = context(d, page)
        if found is not None:
            page.section(re.sub("[^a-z]+", "-", heading.lower()), heading)
            html = _environment.get_template(f"{template}.html").render(found, d=d)
            page.add(re.sub(r"\s*\n\s*", " ", html).strip())
    return page


def _amount(d: Diagnosis) -> str:
    parts = []
    if d.balls is not None:
        sessions = int(d.balls.sessions.number.max()) + 1
        parts.append(f"{d.balls.problem.grid.n} balls in {sessions} session{'s' if sessions > 1 else ''}")
    if d.robot is not None:
        parts.append(f"{len(d.robot.residuals)} joint{'s' if len(d.robot.residuals) > 1 else ''}")
    return ", ".join(parts)


def _percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %"


def _residuals(d: Diagnosis, page: Page) -> Context:
    context: dict[str, object] = {}
    if d.balls is not None:
        flight, context["largest"] = residuals.flight(d.balls)
        context["flight"] = page.embed("residuals_flight", flight)
        context["quantities"] = page.embed("residuals_quantities", residuals.quantities(d.balls))
    if d.robot is not None:
        context["joints"] = page.embed("residuals_joints", residuals.joints(d.robot))
    return context


def _verdict(d: Diagnosis, page: Page) -> Context:
    causes, found = d.verdict.causes, d.balls
    units = {"mrad" if c.name.startswith("joint_") else "mm" for c in causes}
    context: dict[str, object] = {
        "headline": text.headline(d),
        "picture": None,
        "sentence": text.nothing(d) if d.verdict.verdict == "none" else "",
        "causes": [
            (_code(c.name), text.claim(c) + text.alike(c), _percent(min(c.share, 1.0)) if c.share else "", *_sure(c))
            for c in causes
        ],
        "warnings": [w for w in d.verdict.warnings if w not in _told_elsewhere(d)],
        "effect_head": f"effect [{units.pop()}]" if len(units) == 1 else "effect",
        "return_time": f"{RETURN:g}",
        "floor": f"{1e3 * FLOOR:.0f}",
        "small": text.below_floor(found) if found is not None else "",
        "bounce_map": "",
    }
    shown = headline.picture(d)
    if shown is not None:
        context |= {"picture": page.embed("verdict", shown[0]), "caption": shown[1]}
    if d.robot is not None:
        left = d.robot.unexplained_by_joint
        context["joint_findings"] = [(u.joint, u.block, u.where, u.direction, f"{u.size:.2f}") for u in left]
    if found is not None:
        context["findings"] = [
            (text.block(p.name), p.direction, f"{1e3 * p.size:.1f}", f"{1e3 * p.rms:.2f}") for p in found.patterns[:8]
        ]
        if found.unexplained and any(p.name.startswith("bounce") for p in found.patterns):
            context["bounce_map"] = page.embed("bounce_map", residuals.bounce_map(found))
        floor = 1e3 * FLOOR
        context["checked"] = [
            (_code(name), text.description(name).meaning)
            + ((f"{size:.2f}", f"{max(size, floor):.1f}") if math.isfinite(size) else ("not excited", "-"))
            for name, size in sorted(text.detectable(found).items(), key=lambda x: x[1])
            if name not in INVISIBLE
        ]
    return context


def _told_elsewhere(d: Diagnosis) -> set[str]:
    """Warnings that a section of their own holds."""
    return set(d.record.lines() if d.record is not None else ())


def _sure(c: Cause) -> tuple[str, str]:
    return _confidence(c.confidence), _effect(c)


def _confidence(share: float) -> str:
    return "over 99 %" if share > 0.99 else _percent(share)


def _effect(c: Cause) -> str:
    return f"{c.effect_mm:.1f}" + (" mrad" if c.name.startswith("joint_") else " mm" if "." in c.name else "")


def _hits(d: Diagnosis, page: Page) -> Context:
    """Offsets of the returns, before and after, and effects that the hits could not show."""
    found = d.hits
    if found is None:
        return None
    states = (found.before, found.after) if found.causes else (found.before,)
    rows, off = [], []
    for k in range(6):
        factor, unit, digits = (1e3, "mm", 1) if k < 3 else (1.0, "m/s", 2)
        what = f"{'place' if k < 3 else 'velocity'} {residuals.AXES[k % 3]}"
        cells: list[str] = []
        for values in states:
            numbers = [*figures.median_interval(factor * values[k]), *np.percentile(factor * values[k], (5, 95))]
            middle, low, high, few, many = (f"{round(x, digits) + 0.0:+.{digits}f}" for x in numbers)
            cells += [Markup("<b>{}</b> ({} to {})").format(middle, low, high), f"{few} to {many}"]
        rows.append((f"{what} [{unit}]", *cells))
        median, least, most = figures.median_interval(factor * states[-1][k])
        if least > 0.0 or most < 0.0:
            off.append(f"{what} {median:+.{digits}f} {unit}")
    named, causes = [c.effect.name for c in found.causes], {c.name for c in d.verdict.causes}
    head = ["measured − predicted", "before: median", "hit to hit", "after: median", "hit to hit"]
    return {
        "picture": page.embed("hits", figures.hits(found)),
        "head": head[: 1 + 2 * len(states)],
        "rows": rows,
        "off": off,
        "named": named,
        "left": [name for name in named if name not in causes],
        "quiet": [
            (_code(e.name), e.meaning, e.reading) for e in (BY_NAME[n] for n in found.quiet) if e.name not in named
        ],
        "least_shift": f"{2e3 * LEAST_SHIFT:.0f}",
        "return_time": f"{RETURN:g}",
    }


def _sets(d: Diagnosis, page: Page) -> Context:
    """The likeliest set of each number of causes, and how far each is behind the best."""
    if d.balls is None:
        return None
    search, effects = d.balls.search, d.balls.problem.effects
    best = max(search.picked.evidence)
    rows = [
        (
            Markup(" + ").join(_code(effects[j].name) for j in s) or "nothing",
            f"{best - evidence:.1f}",
            "chosen" if set(s) == set(search.chosen) else "",
        )
        for s, evidence in zip(search.picked.path, search.picked.evidence, strict=True)
    ]
    return {"rows": rows, "least": f"{100 * LEAST_SHARE:.0f} %"}


def _open_questions(d: Diagnosis, page: Page) -> Context:
    v = d.verdict
    settled = []
    for c in v.causes:
        if len(c.group) > 1 or c.separating_measurement:
            readings = [part for part in c.separating_measurement.split("; ") if part]
            others = Markup(", ").join(map(_code, c.group[1:])) or "-"
            settled.append((_code(c.name), others, Markup("<br>").join(readings) or "-"))
    unseen = (
        ("Not identifiable from such logs", *_lines(v.not_identifiable)),
        ("Not excited in these logs", *_lines(v.not_excited)),
    )
    return {"settled": settled, "unseen": unseen, "nothing": not (settled or v.not_identifiable or v.not_excited)}


def _lines(lines: Sequence[str]) -> tuple[tuple[str, ...], Sequence[tuple[str, ...]]]:
    """Lines "name: why" as head and rows of a table, the joints of one effect in one row."""
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
        if len(whys) > 1:
            why = f"for instance {members[0][0]}: {whys[0]}"
        else:
            why = whys[0] if whys else text.description(effect).meaning
        rows.append((_code(effect), joints, why))
    if any(joints for _, joints, _ in rows):
        return ("effect", "joints", "why"), rows
    head = ("effect", "why" if any(": " in line for line in lines) else "meaning")
    return head, [(name, why) for name, _, why in rows]


def _parameters(d: Diagnosis, page: Page) -> Context:
    rows = []
    for c in d.verdict.causes:
        effect = BY_NAME.get(c.name)
        twins = {t.path for t in effect.twins} if effect else set()
        for k, (path, e) in enumerate(c.parameters.items()):
            middle, low, high, unit = text.span(e.estimate, e.low, e.high, e.unit)
            role = "or instead" if path in twins else ""
            nominal = text.nominal(e).removesuffix(unit).strip()
            estimate = Markup("<b>{}</b>").format(middle)
            rows.append((_code(c.name) if not k else role, _code(path), nominal, estimate, f"{low} to {high}", unit))
    shifts = figures.forest_rows(d.verdict.causes, d.balls)
    together = [
        (_code(t.name), f"{t.change:+.3g}", f"{t.low:+.3g} to {t.high:+.3g}", f"± {t.prior:g}", t.unit)
        for t in sorted(d.verdict.together, key=lambda t: -abs(t.change) / max(t.high - t.change, 1e-12))
    ]
    return {
        "together": together,
        "rows": rows,
        "forest": page.embed("parameters", figures.forest(shifts)) if shifts else "",
    }


def _held_out(d: Diagnosis, page: Page) -> Context:
    robot, balls, joints = d.robot, "", ""
    if d.prediction is not None and d.verdict.causes:
        balls = page.embed("held_out", figures.held_out(d.prediction))
    gains = robot.held_out if robot is not None else ()
    if robot is not None and gains:
        joints = page.embed("held_out_joints", figures.joint_gains(robot))
    if d.verdict.held_out is None and not balls and not joints:
        return None
    return {
        "h": d.verdict.held_out,
        "balls": balls,
        "joints": joints,
        "gains": [
            (
                g.joint,
                f"{1e3 * g.before:.3f}",
                f"{1e3 * g.after:.3f}",
                f"{1e3 * g.low:.3f} to {1e3 * g.high:.3f}",
                f"m{g.unit}",
            )
            for g in gains
        ],
    }


def _play(play: Play | None, page: Page) -> Context:
    if play is None:
        return None
    rates = [
        ("in the nominal simulation", play["nominal"]),
        ("in the extended simulation, same policy", play["extended"]),
    ]
    back = None
    if play["retrained"]:
        rates.append(("in the extended simulation, retrained", play["retrained"]))
        back = 100 * (play["retrained"]["rate"] - play["extended"]["rate"])
    numbers = [(label, r["rate"], r["low"], r["high"]) for label, r in rates]
    return {
        "lost": 100 * (play["nominal"]["rate"] - play["extended"]["rate"]),
        "back": back,
        "rows": [(n, _percent(r, 1), f"{_percent(a, 1)} to {_percent(b, 1)}") for n, r, a, b in numbers],
        "picture": page.embed("play", figures.play(numbers)),
        "balls": f"{play['balls']:,}",
    }


def _next(d: Diagnosis, page: Page) -> Context:
    steps = d.verdict.next_experiment
    common, own = text.advice(steps)
    gains = [f"{step.gain:.0f}" if step.gain > 0.0 else "" for step in steps]
    rows = [(step.what, gain, tells) for step, gain, tells in zip(steps, gains, own, strict=True)]
    readings = any(len(c.group) > 1 and c.separating_measurement for c in d.verdict.causes)
    return {"rows": rows, "few": FEW, "common": common, "readings": readings}


def _spins(d: Diagnosis, page: Page) -> Context:
    found = d.balls
    if found is None or found.spins is None:
        return None
    return {
        "picture": page.embed("spins", figures.spins(found.spins)),
        "balls": len(found.spins.name),
        "size": f"{np.median(np.linalg.norm(found.spins.mean, axis=0)):.0f}",
        "deviation": f"{np.median(found.spins.std):.1f}",
    }


def _cleaned(d: Diagnosis, page: Page) -> Context:
    if d.record is None or not d.record.entries:
        return None
    taken = any(e.samples for e in d.record.entries)
    return {
        "lines": d.record.lines(),
        "picture": page.embed("taken_out", figures.taken_out(d.record)) if taken else None,
        "entries": [str(e) for e in d.record.entries],
    }


def _data(d: Diagnosis, page: Page) -> Context:
    context: dict[str, object] = {"noise": [], "logs": []}
    if d.balls is not None:
        noise, grid = d.balls.search.noise, d.balls.problem.grid
        context["noise"] = [
            (name, f"{np.median(own):.2f}", f"{np.percentile(own, 5):.2f} to {np.percentile(own, 95):.2f}", f"{r:.2f}")
            for name, own, r in zip(
                ("along the flight", "across it, level", "upright to both"),
                1e3 * noise.scale,
                noise.memory,
                strict=True,
            )
        ]
        context |= {"interval": 1e3 * noise.interval, "flights": grid.n, "samples": int(grid.mask.sum())}
    logs = d.extended.provenance.get("logs", {})
    context["logs"] = [(_code(n), Markup('<code class="hash">{}</code>').format(digest)) for n, digest in logs.items()]
    return context if context["noise"] or logs else None
