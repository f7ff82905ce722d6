"""``mjx-tt render``: a policy at play as a picture or video; ``mjx-tt view``: in a browser; ``mjx-tt curves``: learning
curves in one picture."""

from __future__ import annotations

import contextlib
import re
import secrets
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments.commands.options import (
    Balls,
    BallSeed,
    Model,
    PolicyFolder,
    command,
    console,
    count,
    existing,
    experiment_of,
    option,
    start_jax,
    suffix,
)
from experiments.errors import ConfigError, checked
from experiments.runs.locate import find_policy, is_exported
from experiments.runs.run_dir import Run

SHIPPED = Path(__file__).parents[1] / "shipped" / "policies" / "quickstart"
NEEDED = ("viser", "mjviser")
MOST = 4  # tables
SHORTEST_TOKEN = 8

app = command(
    "render",
    "a picture or a video of a policy at play, without a display",
    """\
  mjx-tt render --out play.gif                     a policy that comes with the program
  mjx-tt render runs/quickstart --out episode.png --out episode.mp4
  mjx-tt render runs/quickstart --out balls.mp4 --episodes 4 --camera side
""",
)
view_app = command(
    "view",
    "look at a policy, a training, a session or a diagnosis in a browser",
    """\
  mjx-tt view                                     a policy that comes with the program
  mjx-tt view runs/quickstart                     another one, or several at tables side by side:
  mjx-tt view runs/quickstart runs/mine --balls player5/M0
  mjx-tt view runs/mine --follow                  the newest checkpoint of a training that goes on
  mjx-tt view runs/robot/20261121-153000.mcap     a session at the robot
  mjx-tt view diagnosis/                          nominal and extended model beside the measured balls
  mjx-tt view --export page.html                  a page that needs no server
""",
)
curves_app = command(
    "curves",
    "the learning curves of several trainings in one picture",
    """\
  mjx-tt curves runs/quickstart runs/paper --out curves.png
""",
)


@app.default
def render(
    policy: PolicyFolder = str(SHIPPED),
    /,
    *,
    balls: Balls = None,
    model: Model = None,
    out: Annotated[tuple[str, ...], option("FILE", ".png, .mp4 or .gif; may be repeated")],
    episodes: Annotated[int, count("balls in a video (default: 2)")] = 2,
    camera: Annotated[str, Parameter(help="human, side, robot_back or top (default: human)")] = "human",
    seed: BallSeed = None,
) -> None:
    """Writes every file of ``out``."""
    find_policy(policy)
    existing(model, key="--model")
    for path in out:
        suffix(path, ".png", ".mp4", ".gif")
    start_jax(1)
    from experiments.evaluation import video
    from experiments.runs import load_policy

    screen = console()
    trained = load_policy.load(policy)
    experiment = experiment_of(trained, balls, model)
    played = video.replay(experiment, trained, episodes, experiment.config.evaluation.seed if seed is None else seed)
    for path in out:
        checked("", video.draw, Path(path), played, camera, experiment.task.robot)
        screen.print(path, highlight=False)


@curves_app.default
def curves(
    *runs: Annotated[str, Parameter("RUN", help="folder of a run, finished or under way", required=True)],
    out: Annotated[str, option("PNG", "the picture (default: curves.png)")] = "curves.png",
) -> None:
    """Draws them."""
    for folder in runs:
        Run(folder).config()
    from experiments.evaluation import learning_curves

    found = [learning_curves.read_curve(folder) for folder in runs]
    console().print(str(checked("", learning_curves.draw_curves, Path(out), found)), highlight=False, soft_wrap=True)


@view_app.default
def view(
    *what: Annotated[str, Parameter("WHAT", help="runs or artefacts (four at most), a session's .mcap, a diagnosis")],
    balls: Balls = None,
    model: Model = None,
    seed: BallSeed = None,
    follow: Annotated[bool, Parameter(help="show each new checkpoint of the run")] = False,
    export: Annotated[str | None, option("HTML", "write a page that needs no server, and end")] = None,
    entries: Annotated[int, count("balls in that page (4)")] = 4,
    host: Annotated[str, option("ADDRESS", "where to listen (127.0.0.1); others than this machine need a token")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, option("PORT", "where to listen (8080)")] = 8080,
    token: Annotated[str | None, option("TEXT", "what others give to look in (made up and printed)")] = None,
) -> None:
    """Serves the page until it is interrupted."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise ConfigError(f"view needs {' and '.join(missing)}: pip install 'mjx-tt[view]'")
    if token is not None and not re.fullmatch(rf"[A-Za-z0-9_-]{{{SHORTEST_TOKEN},}}", token):
        raise ConfigError(f"--token {token!r}: at least {SHORTEST_TOKEN} letters, digits, - or _ are needed")
    if export is not None:
        suffix(export, ".html")
    session, diagnosis = len(what) == 1 and is_session(Path(what[0])), len(what) == 1 and is_diagnosis(Path(what[0]))
    existing(model, key="--model")
    if not session and not diagnosis:
        for folder in what:
            find_policy(folder)
    if len(what) > MOST:
        raise ConfigError(f"{len(what)} policies: {MOST} are the most that are shown side by side")
    if follow and (session or diagnosis or len(what) != 1 or is_exported(what[0])):
        raise ConfigError("--follow needs one run")
    start_jax(1)
    from experiments.runs import load_policy
    from experiments.view import guard, show
    from experiments.view.programme import Play, Programme

    screen, local = console(), guard.is_local(host)
    programme: Programme
    if session or diagnosis:
        programme = show.recorded(Path(what[0]), model)
    else:
        if follow:
            show.wait_for_checkpoint(Path(what[0]), screen)
        trained = [load_policy.load(folder) for folder in what or (SHIPPED,)]
        if len({one.policy.n_observation for one in trained}) > 1:
            raise ConfigError("policies of robots with different joints are not shown side by side; one by one")
        if len({one.policy.network for one in trained}) > 1:
            raise ConfigError("policies of different networks are not shown side by side; look at them one by one")
        experiment = experiment_of(trained[0], balls, model)
        programme = show.play(experiment, trained, experiment.config.evaluation.seed if seed is None else seed)
    serves = local and export is None
    server = guard.Server(host if serves else guard.LOCAL, port if serves else 0)
    if export is not None:
        size = show.export(server, programme, entries, Path(export))
        screen.print(f"{export}: {size / 1e6:.1f} MB", highlight=False)
        return
    viewer = show.viewer(server, programme)
    if follow and isinstance(programme, Play):
        show.Followed(Path(what[0]), viewer, programme)
    gate = None if local else guard.Gate(host, port, token := token or secrets.token_urlsafe(16), server.get_port())
    address = f"http://{host}:{server.get_port() if gate is None else gate.port}/"
    screen.print(f"{address}{'' if gate is None else f'?token={token}'}  (Ctrl+C ends it)", highlight=False)
    with contextlib.suppress(KeyboardInterrupt):  # the way in which a page ends
        viewer.run()
    server.stop()


def is_session(path: Path) -> bool:
    """True for a log of a session at the robot."""
    return path.is_file() and path.suffix == ".mcap"


def is_diagnosis(path: Path) -> bool:
    """True for a folder that ``mjx-tt diagnose`` has written."""
    return all((path / name).is_file() for name in ("verdict.json", "extended.yaml"))
