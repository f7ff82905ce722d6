"""``mjx-tt robot new``, ``list`` and ``place``: a robot of one's own in the simulation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from experiments.errors import ConfigError
from experiments.options import check_exists, check_suffix, command, count, option, start_jax
from experiments.progress import make_console

if TYPE_CHECKING:
    from mjx_tt.robot.robots import Robot

Balls = Annotated[str, option("NAME_OR_YAML", "balls to return (default: player3/M0)")]
SOME = 32  # balls whose motions are searched

new_app = command(
    "new",
    "write a first YAML for a robot's MJCF and check it",
    """\
  mjx-tt robot new my_arm/my_arm.xml                        writes my_arm/description.yaml and names what is wrong
  mjx-tt robot new my_arm/my_arm.xml --balls anna.yaml      again, once mended, with what is in reach of which balls
  mjx-tt robot new my_arm/my_arm.xml --picture home.png --no-reachable
  mjx-tt robot new my_arm/my_arm.xml --view                 and shows it at the table in the browser

A YAML that is there already is checked and never changed.
""",
)
list_app = command("list", "list the robots that come with the program", "  mjx-tt robot list\n")
place_app = command(
    "place",
    "find mounting and home pose for a ball distribution",
    """\
  mjx-tt robot place my_arm --balls anna.yaml           writes mount and home into my_arm/description.yaml
  mjx-tt robot place fr3_pedestal --out fr3.yaml        of a robot that comes with the program, into another file
""",
)


@new_app.default
def new(
    mjcf: Annotated[str, Parameter("MJCF", help="the robot alone, without table and ball")],
    /,
    *,
    balls: Balls = "player3/M0",
    no_reachable: Annotated[bool, Parameter(help="skip the bound on what is in reach, which takes minutes")] = False,
    picture: Annotated[str | None, option("PNG", "draw the robot at home, at the table")] = None,
    view: Annotated[bool, Parameter(help="show it in the browser (http://127.0.0.1:8080/)")] = False,
) -> int:
    """Returns 1 where the robot cannot be used as it is."""
    check_exists(mjcf)
    if picture is not None:
        check_suffix(picture, ".png")
    path = Path(mjcf)
    start_jax(None)
    from ballmodel.io.atomic_files import replacing
    from experiments.config import build
    from experiments.robots import draft
    from mjx_tt.robot import robots

    screen, file = make_console(), path.with_name(robots.YAML)
    if file.exists():
        screen.print(f"{file}: is there already; checked, not changed", soft_wrap=True)
    else:
        content = draft.text(path)
        with replacing(file) as temporary:
            temporary.write_text(content, encoding="utf-8")
        screen.print(f"{file}: written; look at every line that says guess", soft_wrap=True)
    distribution = None if no_reachable else build.distribution(balls, "--balls")
    try:
        robot = robots.load(file)
    except ValueError as error:
        mistakes = str(error).splitlines()
        for line in mistakes:
            screen.print(f"  {line}", soft_wrap=True)
        there = "this" if len(mistakes) == 1 else f"these {len(mistakes)}"
        screen.print(f"mend {there}, then: mjx-tt robot new {mjcf}", soft_wrap=True)
        return 1
    from experiments.robots import reach

    for line in reach.description(robot):
        screen.print(f"  {line}", soft_wrap=True)
    if picture is not None:
        reach.draw(robot, Path(picture))
        screen.print(f"  at home: {picture}", soft_wrap=True)
    if distribution is not None:
        found = reach.reachable(robot, distribution, SOME)
        screen.print(f"  in reach, at least: {found.rate:.0%} of {found.balls} balls of {balls}")
    screen.print(f"  use it: robot: {file.parent} in an experiment's YAML", soft_wrap=True)
    if view:
        _view(robot, balls)
    return 0


@list_app.default
def names() -> None:
    """Prints a line for each."""
    from mjx_tt.robot import robots

    screen = make_console()
    for name in robots.names():
        contract = robots.load_shipped(name).contract
        axes = ", ".join(contract.joints[i] for i in contract.carrying) or "no axis"
        screen.print(f"{name:<16}{len(contract.arm)} joints on {axes}")


@place_app.default
def place(
    robot: Annotated[str, Parameter("ROBOT", help="a robot's folder or YAML, or the name of a shipped one")],
    /,
    *,
    balls: Balls = "player3/M0",
    out: Annotated[str | None, option("YAML", "file for the result (default: the robot's YAML)")] = None,
    seed: Annotated[int, option("K", "seed of the search (default: 0)")] = 0,
    samples: Annotated[int, count("balls to place it for (default: 96)")] = 96,
) -> int:
    """Returns 1 where no better place was found."""
    if out is not None:
        check_suffix(out, ".yaml")
    start_jax(None)
    from experiments.config import build
    from experiments.errors import error_context
    from experiments.robots import placement
    from mjx_tt.robot import robots

    screen = make_console()
    with error_context():
        path = robots.yaml_path(robot)
        before = robots.load(path)
    if out is None and path.is_relative_to(robots.SHIPPED):
        raise ConfigError(f"{robot}: comes with the program and is not changed; name another file with --out")
    distribution = build.distribution(balls, "--balls")
    found = placement.search(before, distribution, samples, seed)
    if found.score <= found.before:
        screen.print(f"{path}: no better place found (score {found.before:.3f}); nothing written")
        return 1
    target = Path(out) if out else path
    placement.write(found.robot, path, target)
    for line in placement.description(before, found):
        screen.print(line, soft_wrap=True)
    screen.print(f"{target}: written", soft_wrap=True)
    return 0


def _view(robot: Robot, balls: str) -> None:
    """Serves the robot, standing at home while balls come, until it is interrupted."""
    import contextlib

    from experiments.robots import reach
    from experiments.view import auth
    from experiments.view.viewer import Viewer

    server = auth.Server(auth.LOCAL, 8080)
    viewer = Viewer(server, reach.standing(robot, balls))
    make_console().print(f"http://{auth.LOCAL}:{server.get_port()}/  (Ctrl+C ends it)")
    with contextlib.suppress(KeyboardInterrupt):
        viewer.run()
    server.stop()
