"""``mjx-tt vision``: the ball detector's pictures, labels, training and evaluation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import Parameter

from experiments import options
from experiments.commands import group
from experiments.errors import ConfigError, error_context
from experiments.options import argument, existing, option, suffixed
from experiments.progress import make_console, print_stages
from experiments.runs.locate import artefact_of

if TYPE_CHECKING:
    from robot_io.vision.rig import CameraRig

app = group(
    "vision",
    "Finds balls in camera pictures: detector, calibration, tracker.",
    """\
  mjx-tt vision render --out pictures/                  what the cameras see, as PNG with labels
  mjx-tt vision record --out rally.mcap                 a rendered rally as raw frames, losslessly
  mjx-tt vision label clip.mp4 --out clip.csv           the detector's balls, for a person to correct
  mjx-tt vision evaluate clip.mp4 --labels clip.csv     how many it finds; the columns are frame,x,y
  mjx-tt vision evaluate --flights 100                  on rendered flights instead
  mjx-tt vision train --out runs/detector               from nothing to weights, in about an hour and a half
  mjx-tt vision calibrate rally.mcap --out rig.yaml     cameras by the table's lines and flights
  mjx-tt vision run rally.mcap --rig rig.yaml           the tracker: datagrams to the bridge
  mjx-tt vision rally runs/quickstart/artefact          the emulated robot plays by rendered cameras
""",
)

Detector = Annotated[
    str | None, option("FOLDER", "a trained detector (default: the one that comes with the program)", name="--detector")
]
Rig = Annotated[str | None, option("YAML", "the cameras (default: two as the paper places them)", existing("--rig"))]
Seed = Annotated[int, option("K", "seed of halls, people, balls and noise (default: 0)")]
CameraName = Annotated[str | None, option("NAME", "camera of a recording")]
Flights = Annotated[int, options.count("rendered flights (default: 20)")]


def read_rig(path: str | None) -> CameraRig:
    """The rig of a YAML, or the one that ships. Raises ConfigError."""
    from robot_io.vision import rig

    with error_context():
        return rig.standard() if path is None else rig.read(path)


def find_detector(folder: str | None) -> Path:
    """The folder of a detector, or the shipped one. Raises ConfigError where it holds none."""
    from experiments.vision.pipeline import SHIPPED
    from robot_io.vision.detector import NETWORK

    path = SHIPPED if folder is None else Path(folder)
    if not (path / NETWORK).exists():
        raise ConfigError(f"--detector {path}: expected {NETWORK} in it, found none; mjx-tt vision train makes one")
    return path


@app.command
def render(
    *,
    out: Annotated[Path, option("FOLDER", "where the pictures go")],
    count: Annotated[int, options.count("pictures of each camera (default: 8)")] = 8,
    rig: Rig = None,
    seed: Seed = 0,
) -> None:
    """Draws what the cameras see: a PNG for each picture, and labels.csv with frame,x,y for each camera."""
    options.check_writable(out)
    options.start_jax()
    import cv2

    from experiments.vision import clips, evaluation, flights
    from experiments.vision.crops import SEEN

    cameras, rng = read_rig(rig).cameras, np.random.default_rng(seed)
    for camera in cameras:
        (out / camera.name).mkdir(parents=True, exist_ok=True)
    labels: dict[str, clips.Labels] = {camera.name: {} for camera in cameras}
    for number, flight in enumerate(evaluation.play_flights(cameras, flights.fly_balls(count, seed), rng)):
        chosen = int(rng.integers(5, 60))
        time, shots, path = next(shot for k, shot in enumerate(flight) if k == chosen)
        place = path(np.array([time]))[0]
        for camera, shot in zip(cameras, shots, strict=True):
            picture = cv2.cvtColor(shot.frame, cv2.COLOR_BayerRGGB2BGR)
            cv2.imwrite(str(out / camera.name / f"{number}.png"), picture)
            labels[camera.name][number] = camera.project(place) if shot.seen > SEEN else None
    for name, places in labels.items():
        clips.write_labels(out / name / "labels.csv", places)
    make_console().print(f"{count} pictures of {', '.join(labels)} in {out}")


@app.command
def record(
    *,
    out: Annotated[Path, option("MCAP", "the recording", suffixed(".mcap"))],
    flights: Annotated[int, options.count("balls (default: 3)")] = 3,
    rig: Rig = None,
    seed: Seed = 0,
) -> None:
    """Records rendered flights as raw frames; each camera's labels go beside them, as OUT.CAMERA.csv."""
    options.start_jax()
    from experiments.vision import clips, evaluation
    from experiments.vision.crops import SEEN
    from experiments.vision.flights import fly_balls
    from robot_io.vision.recording import FrameWriter

    described, rng, screen = read_rig(rig), np.random.default_rng(seed), make_console()
    cameras, rate = described.cameras, described.rate
    labels: dict[str, clips.Labels] = {camera.name: {} for camera in cameras}
    played = evaluation.play_flights(cameras, fly_balls(flights, seed), rng, rate, described.exposure)
    count = 0
    with FrameWriter(out, {camera.name: camera.size for camera in cameras}, rate) as writer:
        for flight in played:
            for time, shots, path in flight:
                place = path(np.array([time]))[0]
                for camera, shot in zip(cameras, shots, strict=True):
                    writer.write(camera.name, count / rate, shot.frame)
                    seen = shot.seen > SEEN and not np.isnan(place[0])
                    labels[camera.name][count] = camera.project(place) if seen else None
                count += 1
    for name, places in labels.items():
        clips.write_labels(out.with_suffix(f".{name}.csv"), places)
    screen.print(f"{count} frames of {', '.join(labels)}, {out.stat().st_size / 1e6:.0f} MB: {out}")


@app.command
def label(
    clip: Annotated[str, argument("CLIP", "a video file or a recording", existing())],
    /,
    *,
    out: Annotated[Path, option("CSV", "the file to write: frame,x,y", suffixed(".csv"))],
    detector: Detector = None,
    camera: CameraName = None,
) -> None:
    """Writes the surest ball of each frame as a label, for a person to correct; frames without one get an empty one."""
    from experiments.vision import clips
    from robot_io.vision.detector import Detector as BallDetector

    opened = clips.open_clip(clip, camera)
    finder, labels = BallDetector(find_detector(detector), opened.rate, bayer=opened.bayer), {}
    for number, frame in enumerate(opened.frames()):
        found = finder.detect(frame)
        labels[number] = found[0].centre if found else None
    clips.write_labels(out, labels)
    balls = sum(place is not None for place in labels.values())
    make_console().print(f"{balls} balls in {len(labels)} frames: {out}; correct them before they judge a detector")


@app.command
def train(
    *,
    out: Annotated[Path, option("FOLDER", "where the detector goes, and its work; resumes there")],
    small: Annotated[bool, Parameter(help="a try-out of a minute, whose detector is poor")] = False,
    seed: Seed = 0,
) -> None:
    """Trains the detector from nothing: rendered crops, network, hard negatives, covariance, export."""
    options.check_writable(out)
    options.start_jax()
    from experiments.vision import pipeline

    screen = make_console()
    plan = replace(pipeline.Plan.small() if small else pipeline.Plan(), seed=seed)
    with error_context():
        figures = pipeline.train_detector(out, plan, print_stages(screen, "vision"), screen.print)
    screen.print(*(f"  {name:<10}{value:.4f}" for name, value in figures.items()), sep="\n")


@app.command
def evaluate(
    clip: Annotated[str | None, Parameter("CLIP", help="a video file or a recording; none: rendered flights")] = None,
    /,
    *,
    labels: Annotated[
        str | None, option("CSV", "frame,x,y of the clip's balls, or what TTNet, BlurBall, TT3D have")
    ] = None,
    detector: Detector = None,
    within: Annotated[float, option("PX", "distance from a label that counts as found (default: 10)")] = 10.0,
    camera: CameraName = None,
    flights: Flights = 20,
    empty: Annotated[float | None, option("S", "also S seconds of rendered play without a ball")] = None,
    rig: Rig = None,
    seed: Seed = 1000,
) -> None:
    """Counts what the detector finds, searching alone and guided by where the ball was."""
    from experiments.vision import clips, evaluation

    folder, screen = find_detector(detector), make_console()
    evaluation.use_one_core()
    if clip is not None:
        if labels is None:
            raise ConfigError(f"{clip}: expected --labels, a CSV with frame,x,y; got none")
        options.check_exists(clip, labels)
        opened, known = clips.open_clip(clip, camera), clips.read_labels(labels)
        for guided in (False, True):
            found = evaluation.evaluate_clip(folder, opened, known, guided, within)
            screen.print("guided" if guided else "search", *found.lines(), sep="\n  ")
        return
    options.start_jax()
    from experiments.vision.flights import fly_balls

    cameras, tracks = read_rig(rig).cameras, fly_balls(flights, seed)
    for guided in (False, True):
        rng = np.random.default_rng(seed)
        found = evaluation.evaluate_rendered(folder, cameras, tracks, rng, guided)
        screen.print("guided" if guided else "search", *found.lines(), sep="\n  ")
    if empty:
        pair = cameras[:2]
        ghosts = evaluation.evaluate_empty(folder, (pair[0], pair[1]), empty, np.random.default_rng(seed + 1))
        screen.print("no ball", *ghosts.lines(), sep="\n  ")
    rate = evaluation.measure_renderer(cameras[0], tracks[0], np.random.default_rng(seed))
    screen.print(f"the renderer makes {rate:.0f} whole frames a second of a core")


@app.command
def calibrate(
    recording: Annotated[
        Path, argument("MCAP", "a recording of all cameras: the cleared table, then balls", existing())
    ],
    /,
    *,
    out: Annotated[Path, option("YAML", "the calibrated rig; may be the file of --rig", suffixed(".yaml"))],
    bumped: Annotated[str | None, option("CAMERA", "only this camera's pose has changed")] = None,
    rig: Rig = None,
    detector: Detector = None,
) -> None:
    """Calibrates the rig's cameras by the table's lines and flying balls; --rig says roughly where they stand."""
    from experiments.vision.calibration import solve, watch
    from robot_io.vision import rig as rigs
    from robot_io.vision.detector import Detector as BallDetector

    described, folder, screen = read_rig(rig), find_detector(detector), make_console()
    names = [camera.name for camera in described.cameras]
    if bumped is not None and bumped not in names:
        raise ConfigError(f"--bumped: expected one of {', '.join(names)}, got {bumped!r}")
    with error_context(str(recording)):
        stills = watch.read_stills(recording, described)
        lens = bumped is None
        fitted = [
            solve.fit_edges(still, camera, lens) if bumped in (None, camera.name) else solve.see_edges(still, camera)
            for still, camera in zip(stills, described.cameras, strict=True)
        ]
        rough = replace(described, cameras=tuple(camera for camera, _ in fitted))
        detectors = [BallDetector(folder, described.rate, bayer=described.bayer) for _ in names]
        moments = watch.detect_all(watch.pair_frames(recording, described), detectors)
        flights = watch.find_flights(moments, rough)
        if bumped is not None and len(flights) < solve.FEWEST_FLIGHTS:
            flights = []
        found = solve.fit_rig(rough, [edges for _, edges in fitted], flights, bumped)
        rigs.write(out, found.rig)
    screen.print(f"{found.flights} flights; drag {found.drag:.3f} 1/m; {out}")
    for name, delay, residual in zip(names, found.rig.delays, found.rig.residuals, strict=True):
        screen.print(f"  {name}: residual {residual:.2f} px, delay {1e3 * delay:+.2f} ms")
    for name, deviation in found.deviations.items():
        doubt = "  not determined: record more flights" if name in found.undetermined else ""
        screen.print(f"  {name:<18} +- {deviation:.2g}{doubt}")


@app.command
def check(
    recording: Annotated[
        str | None, Parameter("MCAP", help="a recording of all cameras; none: rendered flights")
    ] = None,
    /,
    *,
    rig: Rig = None,
    detector: Detector = None,
    flights: Flights = 20,
    seed: Seed = 1000,
) -> None:
    """Says what is wrong with a recording's cameras, or how well rendered flights are tracked."""
    described, folder, screen = read_rig(rig), find_detector(detector), make_console()
    if recording is not None:
        options.check_exists(recording)
        from robot_io.vision import live, sources

        recorded = [sources.RecordedSource(recording, camera.name) for camera in described.cameras]
        with error_context(recording):
            summary = live.run(described, recorded, folder, None, screen.print, live=False)
        screen.print(*summary.lines(), "nothing is wrong" if not summary.problems else "", sep="\n")
        return
    options.start_jax()
    from experiments.vision import evaluation, tracking
    from experiments.vision.flights import fly_balls

    evaluation.use_one_core()
    tracks = fly_balls(flights, seed)
    found = tracking.evaluate_tracker(folder, described, described, tracks, np.random.default_rng(seed))
    screen.print(*found.lines(), sep="\n")


@app.command
def run(
    source: Annotated[str, Parameter("SOURCE", help="a recording, or pylon:SERIAL,SERIAL of the rig's cameras")],
    /,
    *,
    host: Annotated[str, option("ADDRESS", "where datagrams go (default: this machine)")] = "127.0.0.1",
    port: Annotated[int, option("PORT", "UDP port that the bridge listens on (default: 6520)")] = 6520,
    triggered: Annotated[bool, Parameter(help="the cameras wait for a trigger on line 1")] = False,
    rig: Rig = None,
    detector: Detector = None,
) -> None:
    """Runs the tracker: a process for each camera, datagrams to the bridge, and what is wrong as it happens."""
    from robot_io.vision import live, sources

    described, folder, screen = read_rig(rig), find_detector(detector), make_console()
    opened: list[sources.Source]
    if source.startswith("pylon:"):
        serials = source.removeprefix("pylon:").split(",")
        if len(serials) != len(described.cameras):
            raise ConfigError(f"SOURCE: expected {len(described.cameras)} serial numbers, got {len(serials)}")
        opened = [
            sources.PylonSource(serial, described.rate, described.exposure, camera.size, triggered)
            for serial, camera in zip(serials, described.cameras, strict=True)
        ]
    else:
        options.check_exists(source)
        start = monotonic() + live.START
        opened = [sources.RecordedSource(source, camera.name, True, start) for camera in described.cameras]
    with error_context(source):
        try:
            summary = live.run(described, opened, folder, (host, port), screen.print, live=True)
        except KeyboardInterrupt:
            return
    screen.print(*summary.lines(), sep="\n")


@app.command
def rally(
    artefact: Annotated[str, Parameter("ARTEFACT", help="folder of an exported policy, or of its run")],
    /,
    *,
    balls: Annotated[int, options.count("balls (default: 10)")] = 10,
    distribution: Annotated[str, option("NAME", "what is thrown (default: player3/M0)")] = "player3/M0",
    triangulated: Annotated[bool, Parameter(help="by the emulator's triangulation instead, to compare")] = False,
    rig: Rig = None,
    detector: Detector = None,
    seed: Seed = 0,
) -> None:
    """Plays on the emulated robot by what rendered cameras see, in lock-step."""
    options.start_jax()
    from experiments.vision import evaluation
    from experiments.vision import rally as rallies
    from robot_io.policy.artefact import load

    evaluation.use_one_core()
    folder, screen = artefact_of(artefact), make_console()
    with error_context():
        played = rallies.play(
            load(folder), read_rig(rig), find_detector(detector), balls, distribution, seed, not triangulated
        )
    screen.print(*played.lines(), sep="\n")
