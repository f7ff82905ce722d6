"""Trained policies: ``mjx-tt evaluate``, ``export``, ``pack``, ``unpack``, ``render`` and ``view``."""

from __future__ import annotations

import contextlib
import re
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from experiments import options
from experiments.commands import command
from experiments.errors import ConfigError, error_context
from experiments.interrupts import interruptible
from experiments.options import argument, count, option, suffixed
from experiments.progress import make_console, print_stages
from experiments.runs.locate import SHIPPED, find_policy, is_exported, run_of
from experiments.runs.run_dir import CONFIG, Run

if TYPE_CHECKING:
    from experiments.view.playlist import Playlist

MOST = 4  # tables
SHORTEST_TOKEN = 8


@command(
    "evaluate",
    """\
  mjx-tt evaluate runs/quickstart
  mjx-tt evaluate runs/quickstart --balls player1/M1 --episodes 5000
  mjx-tt evaluate artefacts/anna --model measured.yaml --out anna-on-measured

Without --out, a run on its own balls and model writes into its own folder; anything else into a folder beside it.
""",
)
def evaluate(
    policy: options.PolicyFolder,
    /,
    *,
    play: options.PlayOptions = options.PLAY,
    episodes: Annotated[int | None, count("balls to play (default: the experiment's)")] = None,
    no_reachable: Annotated[bool, Parameter(help="skip the bound on what is in reach, which takes a minute")] = False,
    out: Annotated[Path | None, option("FOLDER", "folder of evaluation.json and plots/")] = None,
    ranks: options.DistributedOptions = options.ALONE,
) -> None:
    """Plays a policy on fresh balls: rates, interval, pictures."""
    find_policy(policy)
    folder = out or default_folder(Path(policy), play.balls, play.model)
    options.check_writable(folder)
    options.start_jax(ranks.devices or (1 if ranks.distributed else None))
    import jax

    from experiments.evaluation import evaluate as evaluation
    from experiments.runs import load_policy
    from experiments.training import finalize
    from experiments.training.ranks import join

    screen = make_console()
    together = join(ranks.distributed, ranks.processes, ranks.process)
    screen.quiet = not together.is_first
    trained = load_policy.load(policy)
    experiment = play.experiment(trained)
    settings = experiment.config.evaluation
    stage = print_stages(screen, str(trained.source))
    with interruptible(), together.failing_fast():
        played = evaluation.evaluate(
            experiment,
            trained,
            episodes or settings.episodes,
            play.seed_of(experiment),
            None if no_reachable else settings.reachable_balls,
            stage,
            jax.device_count(),
        )
        together.disconnect()
        if not together.is_first:
            return
        with stage("drawing pictures"):
            finalize.save_evaluation(folder, played, experiment)
    finalize.print_report(screen, played.report, str(trained.source))
    screen.print(f"  {folder}/evaluation.json, pictures in {folder}/plots", soft_wrap=True)


def default_folder(policy: Path, *others: str | None) -> Path:
    """Folder of an evaluation without --out; ``others``: balls and model that are not the policy's own."""
    changed = [Path(text).with_suffix("").as_posix().replace("/", "-") for text in others if text]
    if (policy / CONFIG).exists() and not is_exported(policy):
        return policy / f"evaluation-{'-'.join(changed)}" if changed else policy
    # An artefact holds its own files only, a run that was passed on those that it came with.
    policy = policy if policy.name else policy.absolute()
    return policy.with_name("-".join([f"{policy.name}-evaluation", *changed]))


@command(
    "export",
    """\
  mjx-tt export runs/quickstart
  mjx-tt export runs/quickstart --out artefacts/anna
""",
)
def export(
    folder: Annotated[str, Parameter("RUN", help="folder of a run")],
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", "default: RUN/artefact")] = None,
) -> int:
    """Writes a run's policy as an artefact that a robot can run."""
    run = Run(run_of(folder))
    artefact = out or run.artefact
    options.check_writable(artefact)
    options.start_jax()
    from experiments.runs import load_policy
    from experiments.training import finalize

    screen = make_console()
    trained = load_policy.load(run.folder)
    report = run.read_evaluation() if run.evaluation.exists() else None
    if not finalize.export_policy(artefact, trained, options.PLAY.experiment(trained), report, screen):
        return 1
    screen.print(f"artefact: {artefact}")
    return 0


@command(
    "pack",
    """\
  mjx-tt pack runs/quickstart
  mjx-tt pack runs/quickstart --out anna.mjxtt.zip --licence CC-BY-4.0
""",
)
def pack(
    policy: options.PolicyFolder,
    /,
    *,
    out: Annotated[
        Path | None, option("FILE", "default: the run's name with .mjxtt.zip, in the current folder", suffixed(".zip"))
    ] = None,
    licence: Annotated[str | None, option("NAME", "for the card, such as CC-BY-4.0")] = None,
) -> None:
    """Packs a policy into one file: artefact, configuration, evaluation, a card."""
    folder = run_of(policy)
    from experiments.sharing import packed

    path = out or Path(f"{folder.absolute().name}{packed.SUFFIX}")
    options.check_writable(path.parent)
    digest = packed.pack(folder, path, licence)
    make_console().print(f"{path}: {path.stat().st_size:,} bytes, SHA-256 {digest}", soft_wrap=True)


@command(
    "unpack",
    """\
  mjx-tt unpack quickstart.mjxtt.zip
  mjx-tt unpack quickstart.mjxtt.zip --out runs/anna
  mjx-tt view runs/anna
""",
)
def unpack(
    file: Annotated[Path, argument("FILE", "a packed policy", options.existing())],
    /,
    *,
    out: Annotated[Path | None, option("FOLDER", "default: the file's name, in the current folder")] = None,
) -> None:
    """Checks a packed policy and unpacks it into a folder."""
    from experiments.sharing import packed

    folder = out or Path(file.name.removesuffix(".zip").removesuffix(".mjxtt"))
    value, low, high, count, _ = packed.unpack(file, folder)["returned"]
    returned = f"{value:.1%} of {count:,} balls returned (95 % interval {low:.1%} to {high:.1%})"
    make_console().print(f"{folder}: {returned}; {folder}/README.md says where", soft_wrap=True)


@command(
    "render",
    """\
  mjx-tt render --out play.gif                     a policy that comes with the program
  mjx-tt render runs/quickstart --out episode.png --out episode.mp4
  mjx-tt render runs/quickstart --out balls.mp4 --episodes 4 --camera side
""",
)
def render(
    policy: options.PolicyFolder = str(SHIPPED / "quickstart"),
    /,
    *,
    play: options.PlayOptions = options.PLAY,
    out: Annotated[
        tuple[Path, ...], option("FILE", ".png, .mp4 or .gif; may be repeated", suffixed(".png", ".mp4", ".gif"))
    ],
    episodes: Annotated[int, count("balls in a video (default: 2)")] = 2,
    camera: Annotated[str, Parameter(help="human, side, robot_back or top (default: human)")] = "human",
) -> None:
    """Draws a picture or a video of a policy at play."""
    find_policy(policy)
    options.start_jax()
    from experiments.evaluation import video
    from experiments.runs import load_policy

    trained = load_policy.load(policy)
    experiment = play.experiment(trained)
    played = video.record(experiment, trained, episodes, play.seed_of(experiment))
    for path in out:
        with error_context():
            video.draw(path, played, camera, experiment.task.robot)
        make_console().print(path)


@command(
    "view",
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
def view(
    *what: Annotated[Path, Parameter("WHAT", help="runs or artefacts (four at most), a session's .mcap, a diagnosis")],
    play: options.PlayOptions = options.PLAY,
    follow: Annotated[bool, Parameter(help="show each new checkpoint of the run")] = False,
    export: Annotated[
        Path | None, option("HTML", "write a page that needs no server", suffixed(".html", key="--export"))
    ] = None,
    entries: Annotated[int, count("balls in that page (default: 4)")] = 4,
    host: Annotated[str, option("ADDRESS", "address to listen on (default: 127.0.0.1); any other needs a token")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, option("PORT", "port to listen on (default: 8080)")] = 8080,
    token: Annotated[str | None, option("TEXT", "token that others need (default: generated and printed)")] = None,
) -> None:
    """Shows a policy, a training, a session or a diagnosis in a browser."""
    if token is not None and not re.fullmatch(rf"[A-Za-z0-9_-]{{{SHORTEST_TOKEN},}}", token):
        raise ConfigError(f"--token: expected at least {SHORTEST_TOKEN} letters, digits, - or _, got {token!r}")
    recorded = len(what) == 1 and (_is_session(what[0]) or _is_diagnosis(what[0]))
    for folder in () if recorded else what:
        find_policy(folder)
    if len(what) > MOST:
        raise ConfigError(f"{len(what)} policies: {MOST} are the most that are shown side by side")
    if follow and (recorded or len(what) != 1 or is_exported(what[0])):
        raise ConfigError("--follow needs one run")
    options.start_jax()
    from experiments.view import auth, measured, viewer

    screen, is_local = make_console(), auth.is_local(host)
    if follow:
        viewer.wait_for_checkpoint(what[0], screen)
    playlist = measured.load(what[0], play.model) if recorded else _load_policies(what, play)
    if export is not None:
        size = viewer.export(auth.Server(auth.LOCAL, 0), playlist, entries, export)
        screen.print(f"{export}: {size / 1e6:.1f} MB")
        return
    token = None if is_local else token or secrets.token_urlsafe(16)
    server = auth.Server(host, port, token)
    shown = viewer.Viewer(server, playlist)
    if follow:
        viewer.follow_training(what[0], shown)
    address = f"http://{host}:{server.get_port()}/{'' if token is None else f'?token={token}'}"
    screen.print(f"{address}  (Ctrl+C ends it)")
    with contextlib.suppress(KeyboardInterrupt):  # which ends a page
        shown.run()
    server.stop()


def _load_policies(folders: tuple[Path, ...], play: options.PlayOptions) -> Playlist:
    from experiments.runs import load_policy
    from experiments.view import viewer

    trained = [load_policy.load(folder) for folder in folders or (SHIPPED / "quickstart",)]
    if len({one.policy.n_observation for one in trained}) > 1:
        raise ConfigError("policies of robots with different joints are not shown side by side; view them one by one")
    if len({one.policy.network for one in trained}) > 1:
        raise ConfigError("policies of different networks are not shown side by side; view them one by one")
    experiment = play.experiment(trained[0])
    return viewer.play_policies(experiment, trained, play.seed_of(experiment))


def _is_session(path: Path) -> bool:
    return path.is_file() and path.suffix == ".mcap"


def _is_diagnosis(path: Path) -> bool:
    return all((path / name).is_file() for name in ("verdict.json", "extended.yaml"))
