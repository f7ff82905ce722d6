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
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from experiments.errors import ConfigError
from experiments.jobs import engine
from experiments.jobs.engine import Job, Setup
from experiments.jobs.site import Workers
from experiments.options import load_site
from tests.exam.generator import cases as drawing
from tests.exam.generator import human_strokes, scoring
from tests.exam.generator.cases import Case
from tests.exam.generator.json_lines import append, read_lines
from tests.exam.generator.write import write

# Kinds and sizes of each bar, and their share of --cases. Bar 6 is read off the others.
BARS: dict[str, tuple[tuple[str, float | None, float], ...]] = {
    "1": (("none", None, 1.0), ("noise", None, 0.5)),
    "2": (("single", 10.0, 1.0),),
    "3": (("single", 5.0, 1.0), ("single", 20.0, 1.0)),
    "4": (("pair", None, 1.0), ("triple", None, 1.0)),
    "5": (("gauge", None, 0.5),),
    "6": (("single", 10.0, 1.0),),
    "7": (("deleted", None, 1.0),),
    "8": (("invented", None, 1.0),),
    "10": (("robot", None, 1.0), ("unexcited", None, 0.25), ("robot_none", None, 0.25)),
    "13": (("human_none", None, 1.0),),
    "14": (("human_single", 10.0, 1.0), ("human_single", 20.0, 1.0)),
    "15": (("human_pair", None, 1.0),),
    "16": (("human_deleted", None, 0.5), ("human_invented", None, 0.5)),
    "17": (("many", None, 1.0), ("bounce", None, 0.5)),
    "18": (("kalman", None, 1.0),),
}
PEOPLES_BARS = ("13", "14", "15", "16")


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
    files, sealed, _ = write(case, folder)
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
    return record


def summarise(records: list[dict], folder: Path) -> str:
    """Writes summary.md and summary.json; returns the Markdown."""
    rows = scoring.table(records)
    lines = ["| bar | test | wanted | cases | figure | 95 % interval | |", "|---|---|---|---|---|---|---|"]
    lines += [row.text() for row in rows]
    lines += ["", "| confidence of a name | names | true | 95 % interval |", "|---|---|---|---|"]
    bins = scoring.reliability(records)
    lines += [f"| {b.confidence:.3f} | {b.count} | {b.true:.3f} | {b.low:.3f} to {b.high:.3f} |" for b in bins]
    lines += ["", "| true | answers |", "|---|---|"]
    matrix = scoring.confusion(records)
    lines += [f"| {t} | {', '.join(f'{a} {n}' for a, n in answers.items())} |" for t, answers in matrix.items()]
    timed = [r for r in records if r["case"]["kind"] not in ROBOT_KINDS and "cpu_seconds" in r]
    if timed:
        wall, cpu = (np.median([r[k] for r in timed]) for k in ("seconds", "cpu_seconds"))
        lines += ["", f"One ball log in a warm process, median: {wall:.1f} s, processor time {cpu:.1f} s."]
    text = "\n".join(lines) + "\n"
    data = {"rows": [asdict(row) for row in rows], "confusion": matrix, "cases": len(records)}
    for name, content in (("summary.md", text), ("summary.json", json.dumps(data, indent=1))):
        temporary = folder / f"{name}.tmp"
        temporary.write_text(content)
        os.replace(temporary, folder / name)
    return text


def examiner() -> Callable[[Case, Path], dict]:
    """The function that examines a case, in a worker."""
    return examine


def run_all(cases: list[Case], folder: Path, keep: bool, workers: Workers) -> list[dict]:
    """Examines what is not yet in OUT/cases.jsonl; returns the records of all that are done."""
    path = folder / "cases.jsonl"
    wanted = {case.name for case in cases}
    done = {r["key"] for r in read_lines(path)}
    left = [case for case in cases if case.name not in done]
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
            summarise([r for r in read_lines(path) if r["key"] in wanted], folder)

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
    parser.add_argument("--cases", type=int, default=50, metavar="N", help="cases for each test (default: 50)")
    parser.add_argument("--out", type=Path, default=Path("exam"), metavar="DIR")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bars", default=",".join(BARS), help=f"which of {','.join(BARS)} (default: all)")
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
    unknown = [bar for bar in bars if bar not in BARS]
    if unknown:
        parser.error(f"unknown bar {', '.join(unknown)}; known are {', '.join(BARS)}")
    try:
        elsewhere = load_site(options.site, processes=options.processes)
    except ConfigError as error:
        parser.error(str(error))
    workers = Workers(options.processes or 1, elsewhere, str(options.site))
    options.out.mkdir(parents=True, exist_ok=True)
    records = run_all(plan(bars, options.cases, options.seed), options.out, options.keep, workers)
    print(summarise(records, options.out))
    return 0
