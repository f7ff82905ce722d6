"""``mjx-tt view``: a policy, a training, a session or a diagnosis in a browser."""

from __future__ import annotations

import contextlib
import re
import secrets
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError
from experiments.options import count, option
from experiments.runs.locate import SHIPPED, find_policy, is_exported

if TYPE_CHECKING:
    from experiments.view.playlist import Playlist

NEEDED = ("viser", "mjviser")
MOST = 4  # tables
SHORTEST_TOKEN = 8

app = options.command(
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


@app.default
def view(
    *what: Annotated[str, Parameter("WHAT", help="runs or artefacts (four at most), a session's .mcap, a diagnosis")],
    play: options.PlayOptions = options.PLAY,
    follow: Annotated[bool, Parameter(help="show each new checkpoint of the run")] = False,
    export: Annotated[str | None, option("HTML", "write a page that needs no server")] = None,
    entries: Annotated[int, count("balls in that page (default: 4)")] = 4,
    host: Annotated[str, option("ADDRESS", "address to listen on (default: 127.0.0.1); any other needs a token")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, option("PORT", "port to listen on (default: 8080)")] = 8080,
    token: Annotated[str | None, option("TEXT", "token that others need (default: generated and printed)")] = None,
) -> None:
    """Serves the page until it is interrupted."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        raise ConfigError(f"view needs {' and '.join(missing)}: pip install 'mjx-tt[view]'")
    if token is not None and not re.fullmatch(rf"[A-Za-z0-9_-]{{{SHORTEST_TOKEN},}}", token):
        raise ConfigError(f"--token: expected at least {SHORTEST_TOKEN} letters, digits, - or _, got {token!r}")
    if export is not None:
        options.check_suffix(export, ".html")
    play.check()
    recorded = len(what) == 1 and (is_session(Path(what[0])) or is_diagnosis(Path(what[0])))
    for folder in () if recorded else what:
        find_policy(folder)
    if len(what) > MOST:
        raise ConfigError(f"{len(what)} policies: {MOST} are the most that are shown side by side")
    if follow and (recorded or len(what) != 1 or is_exported(what[0])):
        raise ConfigError("--follow needs one run")
    options.start_jax(1)
    from experiments.progress import make_console
    from experiments.view import auth, viewer

    screen, is_local = make_console(), auth.is_local(host)
    if follow:
        viewer.wait_for_checkpoint(Path(what[0]), screen)
    playlist = _load_recording(Path(what[0]), play.model) if recorded else _load_policies(what, play)
    if export is not None:
        size = viewer.export(auth.Server(auth.LOCAL, 0), playlist, entries, Path(export))
        screen.print(f"{export}: {size / 1e6:.1f} MB")
        return
    token = None if is_local else token or secrets.token_urlsafe(16)
    server = auth.Server(host, port, token)
    shown = viewer.Viewer(server, playlist)
    if follow:
        viewer.follow_training(Path(what[0]), shown)
    address = f"http://{host}:{server.get_port()}/{'' if token is None else f'?token={token}'}"
    screen.print(f"{address}  (Ctrl+C ends it)")
    with contextlib.suppress(KeyboardInterrupt):  # which ends a page
        shown.run()
    server.stop()


def _load_recording(path: Path, model: str | None) -> Playlist:
    from experiments.view import measured

    return measured.load(path, model)


def _load_policies(folders: tuple[str, ...], play: options.PlayOptions) -> Playlist:
    from experiments.runs import load_policy
    from experiments.view import viewer

    trained = [load_policy.load(folder) for folder in folders or (SHIPPED / "quickstart",)]
    if len({one.policy.n_observation for one in trained}) > 1:
        raise ConfigError("policies of robots with different joints are not shown side by side; view them one by one")
    if len({one.policy.network for one in trained}) > 1:
        raise ConfigError("policies of different networks are not shown side by side; view them one by one")
    experiment = play.experiment(trained[0])
    return viewer.play_policies(experiment, trained, play.seed_of(experiment))


def is_session(path: Path) -> bool:
    """True for a log of a session at the robot."""
    return path.is_file() and path.suffix == ".mcap"


def is_diagnosis(path: Path) -> bool:
    """True for a folder that ``mjx-tt diagnose`` has written."""
    return all((path / name).is_file() for name in ("verdict.json", "extended.yaml"))
