"""The large hidden-effect examination: many drawn cases, diagnosed by the command line, scored with the seal opened.

    python -m tests.exam --cases 60 --out exam --seed 0 --bars 1,2,3

Every finished case is a line of OUT/cases.jsonl; a run that was stopped goes on where it was. OUT/summary.md and
summary.json hold the bars with Clopper-Pearson intervals and the confusion matrix. Cases of the kinds take turns, so an
unfinished examination has some of each. --cases is the number for each test; docs/results/examination.md
describes them.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from experiments.errors import ConfigError
from experiments.jobs import engine
from experiments.jobs.engine import Job, Setup
from experiments.jobs.site import ALONE as ONE_BY_ONE
from experiments.jobs.site import Workers
from experiments.options import load_site
from tests.exam.generator import cases as drawing
from tests.exam.generator import held_out, human_strokes, scoring
from tests.exam.generator.cases import BallCase, Case
from tests.exam.generator.json_lines import append, read_lines
from tests.exam.generator.sessions import draw_balls, measure
from tests.exam.generator.write import write
from tests.support.paths import MEASURED, ROOT

DATA = MEASURED / "aimy_launcher"
FRESH = 100  # balls of the held-out test, which no diagnosis sees
GAINED = ("none", "noise", "single", "pair", "triple", "many")  # kinds whose true model is a model
# Kinds and sizes of each bar, and their share of --cases. Bars 6 and 9 are read off the others.
BARS: dict[str, tuple[tuple[str, float | None, float], ...]] = {
    "1": (("none", None, 1.0), ("noise", None, 0.5)),
    "2": (("single", 10.0, 1.0),),
    "3": (("single", 5.0, 1.0), ("single", 20.0, 1.0)),
    "4": (("pair", None, 1.0), ("triple", None, 1.0)),
    "5": (("gauge", None, 0.5),),
    "6": (("single", 10.0, 1.0),),
    "7": (("deleted", None, 1.0),),
    "8": (("invented", None, 1.0),),
    "9": (("none", None, 1.0), ("single", 10.0, 1.0), ("pair", None, 1.0)),
    "10": (("robot", None, 1.0), ("unexcited", None, 0.25), ("robot_none", None, 0.25)),
    "13": (("human_none", None, 1.0),),
    "14": (("human_single", 10.0, 1.0), ("human_single", 20.0, 1.0)),
    "15": (("human_pair", None, 1.0),),
    "16": (("human_deleted", None, 0.5), ("human_invented", None, 0.5)),
    "17": (("many", None, 1.0), ("bounce", None, 0.5)),
    "18": (("kalman", None, 1.0),),
    "19": (("scattered", 20.0, 1.0),),
    "extra": (("rare", None, 0.5), ("invisible", None, 0.1)),
}
PEOPLES_BARS = ("13", "14", "15", "16")
ALONE = ("11", "12")  # time and real data: no drawn cases


def plan(bars: list[str], count: int, seed: int) -> list[Case]:
    """The cases of the bars, the kinds taking turns. A kind that two bars need is drawn once."""
    wanted = {(kind, size): share for bar in bars for kind, size, share in BARS.get(bar, ())}
    queues = [drawing.draw(kind, max(1, round(count * share)), seed, size) for (kind, size), share in wanted.items()]
    # By its place in its own queue: after a tenth of the run, a tenth of each kind is done.
    order = sorted((i / len(q), n, case) for n, q in enumerate(queues) for i, case in enumerate(q))
    return [case for _, _, case in sorted(order, key=lambda item: item[:2])]


def diagnose(files: list[Path], out: Path, options: list[str]) -> dict:
    """verdict.json of one run of the command line in this process; its output is kept beside it."""
    from experiments.cli import main

    arguments = ["diagnose", *map(str, files), "--out", str(out), *options]
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        status = main(arguments)
    out.mkdir(parents=True, exist_ok=True)
    (out / "output.txt").write_text(said.getvalue())
    if status:
        raise RuntimeError(f"mjx-tt {' '.join(arguments)} ended with {status}: {said.getvalue().strip()[-500:]}")
    return json.loads((out / "verdict.json").read_text())


def _options(case: Case, folder: Path) -> list[str]:
    options = []
    if case.human:
        model = folder / "model.yaml"
        model.write_text(f"ball:\n  flight:\n    magnus_coefficient: {drawing.MAGNUS}\n")
        options = ["--model", str(model)]
    return [*options, "--without", ",".join(case.without)] if case.without else options


ROBOT_KINDS = ("robot", "unexcited", "robot_none")


def examine(case: Case, folder: Path) -> dict:
    """Draws, writes, diagnoses and scores one case."""
    began = time.perf_counter()
    files, sealed, drawn = write(case, folder)
    record: dict = {"key": case.name, "case": asdict(case)}
    started, worked = time.perf_counter(), time.process_time()
    try:
        verdict = diagnose(files, folder / "out", _options(case, folder))
    except (Exception, SystemExit) as error:
        (folder / "error.txt").write_text(traceback.format_exc())
        record |= {
            "outcome": "error",
            "verdict": "error",
            "answer": "error",
            "twins": {},
            "error": f"{type(error).__name__}: {error}"[:500],
        }
        return record | {"seconds": time.perf_counter() - started}
    record |= {"seconds": time.perf_counter() - started, "cpu_seconds": time.process_time() - worked}
    truth = json.loads(sealed.read_text())
    record |= scoring.score(truth, verdict)
    record |= {"twins": truth["twins"], "amounts": truth["amounts"]}
    if isinstance(drawn, BallCase) and case.kind in GAINED:
        record["gain"] = gain(drawn, folder / "out" / "extended.yaml")
    if case.kind == "gauge":
        record["reading"] = _with_reading(case, truth, files, folder)
    record["all_seconds"] = time.perf_counter() - began
    return record


def _with_reading(case: Case, truth: dict, files: list[Path], folder: Path) -> str:
    """Outcome once an instrument has cleared the other members: they may no longer be named."""
    cause = case.causes[0]
    others = [*truth["twins"][cause], *truth["kin"][cause]]
    reading = replace(case, without=tuple(others))
    verdict = diagnose(files, folder / "reading", _options(reading, folder))
    return scoring.score(truth, verdict)["outcome"]


def gain(drawn: BallCase, extended: Path) -> dict[str, float]:
    """Held-out error [mm] of the nominal, the true and the diagnosed model on fresh balls of the same world."""
    rng = np.random.default_rng([drawn.case.seed, 1])
    balls = draw_balls(rng, FRESH)
    fresh = drawing.build(drawn.case, balls)
    log = measure(fresh.world, fresh.balls, "iid", rng)
    models = {
        "nominal": held_out.nominal(),
        "true": held_out.Model(drawn.world, drawn.spin_mean, drawn.spin_std),
        "extended": held_out.load(extended) if extended.exists() else held_out.nominal(),
    }
    return held_out.compare(models, log, fresh.balls)


def time_run(folder: Path, seed: int) -> dict:
    """Bar 11: one log of 500 balls in a fresh process without, then with, compiled programs; two cores at most."""
    case = Case("single", ("wind_x",), 10.0, "ar1", seed, count=500)
    files, _, _ = write(case, folder)
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    shutil.rmtree(folder / "cache", ignore_errors=True)
    start = "import sys; from experiments.cli import main; sys.exit(main(sys.argv[1:]))"
    seconds = {}
    for name in ("cold", "warm"):
        command = [sys.executable, "-c", start, "diagnose", *map(str, files), "--out", str(folder / name)]
        began = time.perf_counter()
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        seconds[name] = time.perf_counter() - began
        if done.returncode:
            raise RuntimeError(f"the timed run ended with {done.returncode}: {done.stderr[-500:]}")
    return {"seconds": seconds, "cores": len(os.sched_getaffinity(0)), "samples": sum(1 for _ in files[0].open()) - 1}


def real_data(folder: Path) -> dict:
    """Bar 12: launcher balls with topspin and without, from the drag-only model."""
    found = {}
    for name in ("mn5008_topspin", "no_spin_robot_simple"):
        from experiments.cli import main

        csv = folder / f"{name}.csv"
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.redirect_stdout(io.StringIO()):
            if main(["import", str(DATA / f"{name}.hdf5"), "--out", str(csv)]):
                raise RuntimeError(f"{name} could not be imported")
        verdict = diagnose([csv], folder / name, [])
        found[name] = {k: verdict.get(k) for k in ("verdict", "causes", "unexplained", "held_out", "not_identifiable")}
    return found


def by_itself(run: Callable[[], dict]) -> dict:
    """The result of a bar without drawn cases, or what went wrong: it must not cost the other bars their summary."""
    try:
        return run()
    except (Exception, SystemExit) as error:
        return {"error": f"{type(error).__name__}: {error}"[:500]}


def _bar_rows(alone: dict[str, dict]) -> list[str]:
    lines = [f"| {bar} | - | - | 0 | error: {r['error']} | - | not met |" for bar, r in alone.items() if "error" in r]
    alone = {bar: r for bar, r in alone.items() if "error" not in r}
    if "11" in alone:
        result = alone["11"]
        for name, most in (("cold", 60.0), ("warm", 15.0)):
            met = "met" if result["seconds"][name] <= most else "not met"
            lines.append(
                f"| 11 | {name} run, 500 balls, {result['samples']} samples, {result['cores']} core(s) "
                f"| <= {most:.0f} s | 1 | {result['seconds'][name]:.1f} s | - | {met} |"
            )
    if "12" in alone:
        for name, result in alone["12"].items():
            groups = [{c["name"], *c.get("group", ())} for c in result["causes"] or ()]
            spins = any("magnus" in g for g in groups)
            held = {k: v for k, v in (result["held_out"] or {}).items() if k != "metric"}
            gained = bool(held) and (held["low"] > 0 or held["high"] < 0)
            wanted = "spin; gain excludes 0" if "topspin" in name else "not spin"
            met = spins and gained if "topspin" in name else not spins
            answer = "+".join(c["name"] for c in result["causes"] or ()) or result["verdict"]
            figures = "held out {before:.1f} -> {after:.1f} mm".format(**held) if held else "-"
            interval = "{low:.1f} to {high:.1f} mm gained".format(**held) if held else "-"
            ending = f"{interval} | {'met' if met else 'not met'} |"
            lines.append(f"| 12 | launcher, {name} | {wanted} | 1 | {answer}; {figures} | {ending}")
    return lines


def summarise(records: list[dict], alone: dict[str, dict], baselines: list[dict], folder: Path) -> str:
    """Writes summary.md and summary.json; returns the Markdown."""
    rows = scoring.table(records)
    lines = ["| bar | test | wanted | cases | figure | 95 % interval | |", "|---|---|---|---|---|---|---|"]
    lines += [row.text() for row in rows] + _bar_rows(alone)
    if baselines:
        from tests.exam.baselines import side_by_side

        lines += ["", *side_by_side(records, baselines)]
    lines += ["", "| confidence of a name | names | true | 95 % interval |", "|---|---|---|---|"]
    bins = scoring.reliability(records)
    lines += [f"| {b.confidence:.3f} | {b.count} | {b.true:.3f} | {b.low:.3f} to {b.high:.3f} |" for b in bins]
    if bins:
        _draw_reliability(bins, folder / "reliability.png")
    lines += ["", "| true | answers |", "|---|---|"]
    matrix = scoring.confusion(records)
    lines += [f"| {t} | {', '.join(f'{a} {n}' for a, n in answers.items())} |" for t, answers in matrix.items()]
    timed = [r for r in records if r["case"]["kind"] not in ROBOT_KINDS and "cpu_seconds" in r]
    if timed:
        wall, cpu = (np.median([r[k] for r in timed]) for k in ("seconds", "cpu_seconds"))
        lines += ["", f"One ball log in a warm process, median: {wall:.1f} s, processor time {cpu:.1f} s."]
    text = "\n".join(lines) + "\n"
    data = {"rows": [asdict(row) for row in rows], "confusion": matrix, "alone": alone, "cases": len(records)}
    for name, content in (("summary.md", text), ("summary.json", json.dumps(data, indent=1))):
        temporary = folder / f"{name}.tmp"
        temporary.write_text(content)
        os.replace(temporary, folder / name)
    return text


def _draw_reliability(bins: list[scoring.Reliability], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(4.5, 4.0), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7", label="calibrated")
    said, true = np.array([b.confidence for b in bins]), np.array([b.true for b in bins])
    errors = np.clip([true - [b.low for b in bins], [b.high for b in bins] - true], 0.0, None)
    axes.errorbar(said, true, errors, fmt="o", capsize=3, label="named causes, 95 %")
    for b in bins:
        axes.annotate(f"{b.count}", (b.confidence, b.true), (6, -12), textcoords="offset points", fontsize=8)
    axes.set(xlabel="confidence", ylabel="share that was true", xlim=(0, 1.03), ylim=(0, 1.03))
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def examiner() -> Callable[[Case, Path], dict]:
    """The function that examines a case, in a worker."""
    return examine


def run_all(
    cases: list[Case], folder: Path, keep: bool, part: tuple[int, int] = (1, 1), workers: Workers = ONE_BY_ONE
) -> list[dict]:
    """Examines what is not yet in OUT/cases.jsonl, or every n-th case of it; returns the records of all that are done.

    Several processes may work on the parts of one examination: each appends whole lines. workers: that examine side by
    side.
    """
    path = folder / "cases.jsonl"
    wanted = {case.name for case in cases}
    done = {r["key"] for r in read_lines(path)}
    left = [case for case in cases[part[0] - 1 :: part[1]] if case.name not in done]
    began, ended = time.perf_counter(), 0

    def note(case: Case, record: dict) -> None:
        nonlocal ended
        append(path, record)
        if not keep:
            shutil.rmtree(folder / "cases" / case.name)
        ended += 1
        remaining = (time.perf_counter() - began) / ended * (len(left) - ended)
        print(
            f"{ended}/{len(left)} {case.name}: {record['outcome']} ({record['answer']}), "
            f"{record['seconds']:.1f} s; {remaining / 60:.0f} min left",
            flush=True,
        )
        if ended % 20 == 0:
            summarise([r for r in read_lines(path) if r["key"] in wanted], {}, [], folder)

    if workers.alone:
        for case in left:
            note(case, examine(case, folder / "cases" / case.name))
    elif left:
        jobs = [Job(case.name, (case, folder / "cases" / case.name)) for case in left]
        setup = Setup("tests.exam.examination:examiner", ())
        engine.run(workers.engine(setup, folder), jobs, lambda job, record: note(job.arguments[0], record))
    return [r for r in read_lines(path) if r["key"] in wanted]


def main(arguments: list[str] | None = None) -> int:
    """Runs the examination; returns 0 when it is complete, whatever its figures are."""
    parser = argparse.ArgumentParser("exam", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = (*BARS, *ALONE)
    parser.add_argument("--cases", type=int, default=50, metavar="N", help="cases for each test (default: 50)")
    parser.add_argument("--out", type=Path, default=Path("exam"), metavar="DIR")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bars", default=",".join(known), help=f"which of {','.join(known)} (default: all)")
    parser.add_argument("--baselines", action="store_true", help="run the four baselines on the same cases as well")
    help_ = "only every N-th case, for N processes on one OUT; the first does bars 11 and 12"
    parser.add_argument("--part", default="1/1", metavar="K/N", help=help_)
    parser.add_argument("--keep", action="store_true", help="keep logs, truths and reports of every case")
    parser.add_argument("--processes", type=int, metavar="N", help="cases at a time, by as many processes (default: 1)")
    parser.add_argument("--site", metavar="YAML", help="by the workers of a site: docs/how-to/use-a-cluster.md")
    options = parser.parse_args(arguments)
    bars = options.bars.split(",")
    if not human_strokes.DATA.exists():
        absent = [bar for bar in bars if bar in PEOPLES_BARS]
        bars = [bar for bar in bars if bar not in PEOPLES_BARS]
        if absent:
            print(f"bars {', '.join(absent)} are left out: {human_strokes.DATA} is absent", flush=True)
    unknown = [bar for bar in bars if bar not in known]
    if unknown:
        parser.error(f"unknown bar {', '.join(unknown)}; known are {', '.join(known)}")
    try:
        part, parts = map(int, options.part.split("/"))
    except ValueError:
        parser.error(f"--part {options.part}: K/N is wanted, such as 1/2")
    if not 1 <= part <= parts:
        parser.error(f"--part {options.part}: K of K/N runs from 1 to N")
    try:
        elsewhere = load_site(options.site, processes=options.processes)
    except ConfigError as error:
        parser.error(str(error))
    workers = Workers(options.processes or 1, elsewhere, str(options.site))
    options.out.mkdir(parents=True, exist_ok=True)
    alone = {}
    if "11" in bars and part == 1:
        alone["11"] = by_itself(lambda: time_run(options.out / "time", options.seed))
    records = run_all(plan(bars, options.cases, options.seed), options.out, options.keep, (part, parts), workers)
    if "12" in bars and part == 1 and DATA.is_dir():
        alone["12"] = by_itself(lambda: real_data(options.out / "launcher"))
    compared: list[dict] = []
    if options.baselines:
        from tests.exam import baselines

        compared = baselines.run_all([r["case"] for r in records], options.out)
    print(summarise(records, alone, compared, options.out))
    return 0
