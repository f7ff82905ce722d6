"""Viewers of each thing that can be shown, and the page that needs no server."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from experiments.config import build
from experiments.errors import ConfigError, checked
from experiments.runs import load_policy
from experiments.runs.run_dir import CONFIG, Run
from experiments.view import measured
from experiments.view.controls import Controls
from experiments.view.guard import Server
from experiments.view.page import REST, Viewer
from experiments.view.programme import Fixed, Play, Programme
from experiments.view.scene import Scene
from experiments.view.studio import Studio
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from mjx_tt.sim.model import ModelFile, SimModel

EXPORTED_RATE = 30.0  # [Hz]


def play(experiment: build.Experiment, trained: Sequence[load_policy.TrainedPolicy], seed: int) -> Play:
    """Policies in the world of an experiment."""
    names = [title(one) for one in trained]
    titles = [name if names.count(name) == 1 else f"{name} ({i})" for i, name in enumerate(names, 1)]
    studio = Studio(experiment.task, experiment.model)
    return Play(studio, titles, [one.policy for one in trained], experiment.distribution, seed)


def title(trained: load_policy.TrainedPolicy) -> str:
    """Name of a policy as the page shows it: of its run, with the update that it was taken at."""
    folder = trained.source.absolute()
    if (folder / CONFIG).is_file():
        return f"{folder.name}, update {trained.notes['update']}"
    return folder.parent.name if folder.name == "artefact" else folder.name


def recorded(path: Path, model: str | None) -> Programme:
    """A session at the robot (an .mcap) or a diagnosis (a folder)."""
    if path.is_dir():
        if model is not None:
            raise ConfigError(f"--model {model}: a diagnosis has its own two models")
        return measured.diagnosed(path)
    return measured.session(path, SimModel() if model is None else checked("--model", ModelFile.load, model).model)


def viewer(server: Server, programme: Programme) -> Viewer:
    """The page of a programme, with all controls that it allows."""
    made = Viewer(server, Scene(server, len(programme.films(0)), robot_of(programme)), programme)
    made.controls = Controls(made, programme) if isinstance(programme, Play) else None
    made.go(0)
    made.add_details()
    return made


def robot_of(programme: Programme) -> Robot:
    """The robot that a programme shows; a diagnosis of balls shows the paper's."""
    if isinstance(programme, Play):
        return programme.studio.simulator.config.robot
    return (programme.robot if isinstance(programme, Fixed) else None) or robots.paper()


class Followed:
    """The newest checkpoint of a training that goes on."""

    def __init__(self, folder: Path, viewer: Viewer, play: Play) -> None:
        self._run, self._viewer, self._play = Run(folder), viewer, play
        self._seen = newest(self._run)
        viewer.every.append(self.look)

    def look(self) -> None:
        """Plays the newest checkpoint where there is a new one."""
        if (name := newest(self._run)) != self._seen:
            self._seen = name
            trained = load_policy.load(self._run.folder)
            self._play.policies[0], self._play.names[0] = trained.policy, title(trained)
            self._play.changed()
            self._viewer.reload()


def newest(run: Run) -> str:
    """Name of a run's last checkpoint, "" before the first."""
    return max((path.name for path in run.checkpoints.glob("[0-9]*.npz")), default="")


def wait_for_checkpoint(folder: Path, console: Console) -> None:
    """Returns when a training has written its first checkpoint."""
    run = Run(folder)
    if not newest(run):
        console.print(f"{folder}: waiting for the first checkpoint", highlight=False)
    while not newest(run):
        time.sleep(0.5)


def export(server: Server, programme: Programme, entries: int, path: Path) -> int:
    """Writes a page with the first ``entries`` entries that needs no server; returns its size in bytes."""
    scene = Scene(server, len(programme.films(0)), robot_of(programme))
    recording = server.get_scene_serializer()
    for number in range(entries if programme.count is None else min(entries, programme.count)):
        films = programme.films(number)
        scene.load(films)
        for frame in range(round((max(film.seconds for film in films) + REST) * EXPORTED_RATE)):
            scene.show(frame / EXPORTED_RATE)
            recording.insert_sleep(1.0 / EXPORTED_RATE)
    page = recording.as_html()
    path.write_text(page, encoding="utf-8")
    return len(page.encode())
