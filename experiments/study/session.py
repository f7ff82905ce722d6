"""One session of a study: looks up what it names, checks that the folder is its own, does the remaining steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.config import build
from experiments.config.files import read_yaml
from experiments.config.study import Study, parse
from experiments.errors import RunError, checked
from experiments.jobs.site import ALONE, Workers
from experiments.runs import run_dir
from experiments.runs.run_dir import Run
from experiments.study import identification, training
from experiments.study.pipeline import REPORT, Loop
from experiments.study.schedule import Simulated, items
from experiments.study.target_domain import on_robot
from experiments.study.workers import run_side_by_side
from experiments.study.workflow import JOURNAL, Journal, Waiting, run_all

SETTINGS, SESSIONS = "study.yaml", "study.json"
CHANGEABLE = ("players", "seeds", "simulation.checkpoint_seconds", "simulation.devices")


def run(study: Study, folder: Path, console: Console, workers: Workers = ALONE) -> bool:
    """Does, or goes on with, a study in ``folder``, up to its report; False when it waits for people.

    workers: that do steps which need nothing of each other side by side; alone, this process does them all. Raises
    RunError for a folder of another study, naming the differences, ConfigError for what the study names and is not
    there, and what the steps raise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with Run(folder).locked():
        if not Journal(folder / JOURNAL).entries:  # later on, what is no longer read may be gone
            look_up(study)
        loop = Loop(study, folder, console)
        _open(study, folder)
        try:
            steps, journal = loop.steps(), Journal(folder / JOURNAL)
            if workers.alone:
                run_all(steps, journal, console)
            else:
                run_side_by_side(study, folder, steps, journal, console, workers)
        except Waiting as waiting:
            console.print(str(waiting), highlight=False, soft_wrap=True, markup=False)
            return False
        except OSError as error:
            raise RunError(
                f"{error.filename or folder}: {error.strerror or error}; every finished step is kept. "
                "Make room or repair the folder, then run the same command again to continue"
            ) from error
        except KeyboardInterrupt as stopped:
            raise KeyboardInterrupt(
                f"{stopped}\n{folder}: stopped; the same command continues the study".lstrip()
            ) from None
    console.print(f"report: {folder / REPORT}", highlight=False, soft_wrap=True)
    return True


def look_up(study: Study) -> None:
    """Raises ConfigError for what a study names and is not there, before hours are spent on its first steps."""
    for balls in study.ablation.balls if study.ablation else ():
        build.distribution(balls, "ablation.balls")
    for item in items(study, study.players[0]):
        if isinstance(item, Simulated) and item.source is None:
            build.experiment(training.configuration(study, item, "narrow", None, 0), "simulation")
    if study.identification is not None:
        checked("identification", identification.prior, study.identification.prior, "prior")
    if study.robot is not None:
        on_robot.look_up(study, study.robot)


def _open(study: Study, folder: Path) -> None:
    """Records what the study is and this session, or checks that it is the one that is asked for.

    Where no step is done yet there is nothing that belongs to another study.
    """
    path = folder / SETTINGS
    if path.exists() and Journal(folder / JOURNAL).entries:
        found = parse(read_yaml(checked(str(path), path.read_text, "utf-8"), str(path)), str(path))
        changed = run_dir.differences(found.to_dict(), study.to_dict(), CHANGEABLE.__contains__, "study")
        if changed:
            raise RunError(f"{folder}: is another study:\n{changed}\nRestore these values or choose another --out")
    run_dir.write_yaml(path, study.to_dict())
    sessions = folder / SESSIONS
    before: list[dict[str, Any]] = []
    if sessions.exists():
        found = read_yaml(checked(str(sessions), sessions.read_text, "utf-8"), str(sessions))
        listed = found.get("sessions") if isinstance(found, dict) else None
        if not isinstance(listed, list):
            raise RunError(f"{sessions}: holds no list of sessions; restore the file or remove it")
        before = listed
    run_dir.write_json(sessions, {"sessions": [*before, run_dir.provenance()]})
