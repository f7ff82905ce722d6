"""Robots: ``mjx-tt run``, ``practise``, ``finetune``, ``robot`` (with ``new``, ``place`` and ``list``) and ``rig``."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from experiments import options
from experiments.commands import command, group
from experiments.config import finetuning
from experiments.errors import ConfigError, error_context
from experiments.options import argument, count, existing, option, suffixed
from experiments.progress import make_console
from experiments.runs.locate import artefact_of, find_policy
from experiments.runs.run_dir import Run

Balls = Annotated[str, option("NAME_OR_YAML", "balls to return (default: player3/M0)")]
SOME = 32  # balls whose motions are searched
PORT = 8080  # of the page that shows a new robot


@command(
    "run",
    """\
  mjx-tt run runs/quickstart --robot rig --balls 30
  mjx-tt run rallies --robot rig --rallies 20 --player player1
  mjx-tt run runs/quickstart/artefact --robot robot.yaml
  mjx-tt run runs/quickstart/artefact --robot rig --rig worn.yaml --distribution player1/M1

The robot needs the operator: p prepares the axes, a arms, the space bar stops. The rig is switched on, armed and fed
with balls by itself. Read docs/concepts/safety.md and docs/how-to/run-on-the-robot.md before a real arm moves.
""",
)
def run(
    artefact: Annotated[
        str, Parameter("ARTEFACT", help="folder of an exported policy or of its run, or a shipped one's name")
    ],
    /,
    *,
    robot: Annotated[str, option("YAML", 'a robot.yaml, or "rig" for the emulated robot')],
    balls: Annotated[int | None, count("end after N balls (default: when the operator quits)")] = None,
    rallies: Annotated[int | None, count("end after N rallies that count")] = None,
    seconds: Annotated[float | None, option("S", "end after S seconds")] = None,
    log: Annotated[Path, option("FOLDER", "folder of the MCAP log and the summary")] = Path("runs/robot"),
    setup: options.RobotOptions = options.ROBOT,
) -> int:
    """Plays with an exported policy on a robot, real or emulated."""
    folder = artefact_of(artefact)
    setup.check(robot)
    options.check_writable(log)
    options.start_jax()
    from experiments.deploy import play

    return play.run(folder, robot, log, make_console(), setup, balls, rallies, seconds)


@command(
    "finetune",
    """\
  mjx-tt finetune runs/quickstart --robot robot.yaml --out runs/anna
  mjx-tt finetune runs/quickstart --robot rig --out runs/rig             the emulated robot, in real time
  mjx-tt finetune runs/quickstart --robot lockstep --rig worn.yaml       as fast as this machine allows
  mjx-tt finetune runs/quickstart --robot lockstep --player player3      through rallies with a virtual player

Every ball is on disk before the next begins: the same command continues after an interruption, a crash or a power cut.
""",
)
def finetune(
    policy: Annotated[str, Parameter("RUN_OR_ARTEFACT", help="what to start from")],
    /,
    *,
    robot: Annotated[str, option("YAML", 'a robot.yaml, "rig" or "lockstep"')],
    settings: Annotated[
        str | None, option("YAML", "settings of the fine-tuning (default: docs/how-to/fine-tune.md)")
    ] = None,
    overrides: options.Overrides = (),
    out: Annotated[str | None, option("FOLDER", "folder of the run (default: POLICY-finetuned)")] = None,
    setup: options.RobotOptions = options.ROBOT,
) -> int:
    """Fine-tunes a policy on a robot while a person plays."""
    finetuning.load(settings, overrides)  # a mistake in it is told at once
    find_policy(policy)
    setup.check(robot)
    folder = out or f"{Path(policy).resolve().name}-finetuned"
    options.check_writable(folder)
    options.start_jax()
    from experiments.finetuning import on_robot
    from experiments.runs import load_policy

    screen, trained = make_console(), load_policy.load(policy).config
    chosen = finetuning.load(settings, overrides, trained)
    if finetuning.near(trained):
        rate = chosen.step.learning_rate
        screen.print(f"sigma {chosen.sigma}, step {rate}: the policy was trained by first-order gradients")
    report = on_robot.finetune(policy, chosen, Run(folder), robot, screen, setup)
    return 0 if report is not None else 130  # where it was stopped


@command(
    "practise",
    """\
  mjx-tt practise quickstart --robot rig --rig worn.yaml --seconds 600
  mjx-tt practise quickstart --robot lockstep --rig worn.yaml --balls 200    as fast as this machine allows
  mjx-tt practise quickstart --robot robot.yaml

Plays as `mjx-tt run` does. Beside the control loop a process of low priority scores every ball about the world that is
believed. After a change it identifies the world anew, trains on from the policy in play, and hands the new policy over
between two balls where it is better. See docs/concepts/practice.md.
""",
)
def practise(
    policy: options.PolicyFolder,
    /,
    *,
    robot: Annotated[str, option("YAML", 'a robot.yaml, or "rig" or "lockstep" for the emulated one')],
    balls: Annotated[int | None, count("end after N balls (default: when the operator quits)")] = None,
    rallies: Annotated[int | None, count("end after N rallies that count")] = None,
    seconds: Annotated[float | None, option("S", "end after S seconds")] = None,
    updates: Annotated[int, count("of each training")] = 300,
    out: Annotated[Path, option("FOLDER", "folder of log, journal, worlds and trainings")] = Path("runs/practice"),
    setup: options.RobotOptions = options.ROBOT,
) -> int:
    """Plays, notices what has changed, learns it and plays on."""
    find_policy(policy)
    setup.check(robot)
    options.check_writable(out)
    options.start_jax()
    from experiments.practice import on_robot

    return on_robot.practise(policy, robot, out, make_console(), setup, updates, balls, rallies, seconds)


robots_app = group(
    "robot",
    "Defines a robot (new, place, list), or brings one into service (check, jog, commission).",
    """\
  mjx-tt robot new my_arm/my_arm.xml                                a first YAML for an MJCF, checked
  mjx-tt robot check --robot robot.yaml                             tracker and arm are heard, nothing is sent
  mjx-tt robot check --robot robot.yaml --artefact runs/quickstart  and a policy plays the balls, simulated
  mjx-tt robot jog --robot robot.yaml                               armed, slow, in small steps
  mjx-tt robot jog my_arm --robot robot.yaml                        a robot of your own; or one that comes with it
  mjx-tt robot commission --robot robot.yaml --artefact runs/quickstart  the first day, step by step; resumes

m notes where ball and joints are, for mjx-tt calibrate.
""",
)


@robots_app.default
def commission(
    action: Annotated[Literal["check", "jog", "commission"], Parameter("ACTION")],
    name: Annotated[
        str | None,
        Parameter("ROBOT", help="the installed robot, by folder or name (default: the policy's, or the paper's)"),
    ] = None,
    /,
    *,
    robot: Annotated[Path, option("YAML", "a robot.yaml", existing("--robot"))],
    artefact: Annotated[str | None, option("FOLDER", "check, commission: a policy, or its run")] = None,
    points: Annotated[Path, option("CSV", "file that points are added to")] = Path("points.csv"),
    log: Annotated[Path, option("FOLDER", "folder of the MCAP log")] = Path("runs/robot"),
    seconds: Annotated[float | None, option("S", "end after S seconds")] = None,
) -> int:
    """Brings a robot into service."""
    options.check_writable(log)
    if action == "jog" and artefact is not None:
        raise ConfigError(f"--artefact {artefact}: jog plays no balls; allowed with check and commission")
    policy = None if artefact is None else artefact_of(artefact)
    options.start_jax()
    from experiments.deploy import commissioning, first_day

    if action == "commission":
        return first_day.commission(robot, log, make_console(), policy, name)
    job = commissioning.Commissioning(robot, log, points, seconds, name)
    return job.check(make_console(), policy) if action == "check" else job.jog(make_console())


@command(
    "new",
    """\
  mjx-tt robot new my_arm/my_arm.xml                        writes my_arm/description.yaml and names what is wrong
  mjx-tt robot new my_arm/my_arm.xml --balls anna.yaml      again, once mended, with what is in reach of which balls
  mjx-tt robot new my_arm/my_arm.xml --picture home.png --no-reachable
  mjx-tt robot new my_arm/my_arm.xml --view                 and shows it at the table in the browser

A YAML that is there already is checked and never changed.
""",
    robots_app,
)
def new(
    mjcf: Annotated[Path, argument("MJCF", "the robot alone, without table and ball", existing())],
    /,
    *,
    balls: Balls = "player3/M0",
    no_reachable: Annotated[bool, Parameter(help="skip the bound on what is in reach, which takes minutes")] = False,
    picture: Annotated[
        Path | None, option("PNG", "draw the robot at home, at the table", suffixed(".png", key="--picture"))
    ] = None,
    view: Annotated[bool, Parameter(help=f"show it in the browser (http://127.0.0.1:{PORT}/)")] = False,
) -> int:
    """Writes a first YAML for a robot's MJCF and checks it."""
    options.start_jax(None)
    from ballmodel.io.atomic_files import replacing
    from experiments.config import build
    from experiments.robots import draft, reach
    from mjx_tt.robot import robots

    screen, file = make_console(), mjcf.with_name(robots.YAML)
    if file.exists():
        screen.print(f"{file}: is there already; checked, not changed", soft_wrap=True)
    else:
        content = draft.text(mjcf)
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
    for line in reach.description(robot):
        screen.print(f"  {line}", soft_wrap=True)
    if picture is not None:
        reach.draw(robot, picture)
        screen.print(f"  at home: {picture}", soft_wrap=True)
    if distribution is not None:
        found = reach.reachable(robot, distribution, SOME)
        screen.print(f"  in reach, at least: {found.rate:.0%} of {found.balls} balls of {balls}")
    screen.print(f"  use it: robot: {file.parent} in an experiment's YAML", soft_wrap=True)
    if view:
        from experiments.view import auth
        from experiments.view.viewer import Viewer

        server = auth.Server(auth.LOCAL, PORT)
        viewer = Viewer(server, reach.standing(robot, balls))
        screen.print(f"http://{auth.LOCAL}:{server.get_port()}/  (Ctrl+C ends it)")
        with contextlib.suppress(KeyboardInterrupt):
            viewer.run()
        server.stop()
    return 0


@command(
    "place",
    """\
  mjx-tt robot place my_arm --balls anna.yaml           writes mount and home into my_arm/description.yaml
  mjx-tt robot place fr3_pedestal --out fr3.yaml        of a robot that comes with the program, into another file
""",
    robots_app,
)
def place(
    robot: Annotated[str, Parameter("ROBOT", help="a robot's folder or YAML, or the name of a shipped one")],
    /,
    *,
    balls: Balls = "player3/M0",
    out: Annotated[
        Path | None, option("YAML", "file for the result (default: the robot's YAML)", suffixed(".yaml"))
    ] = None,
    seed: Annotated[int, option("K", "seed of the search (default: 0)")] = 0,
    samples: Annotated[int, count("balls to place it for (default: 96)")] = 96,
) -> int:
    """Finds mounting and home pose for a ball distribution."""
    options.start_jax(None)
    from experiments.config import build
    from experiments.robots import placement
    from mjx_tt.robot import robots

    screen = make_console()
    with error_context():
        path = robots.yaml_path(robot)
        before = robots.load(path)
    if out is None and path.is_relative_to(robots.SHIPPED):
        raise ConfigError(f"{robot}: comes with the program and is not changed; name another file with --out")
    now, score, old = placement.search(before, build.distribution(balls, "--balls"), samples, seed)
    if score <= old:
        screen.print(f"{path}: no better place found (score {old:.3f}); nothing written")
        return 1
    placement.write(now, path, out or path)
    screen.print(f"score {old:.3f} -> {score:.3f} (share of balls that can be met in time)", soft_wrap=True)
    for line in placement.description(before, now):
        screen.print(line, soft_wrap=True)
    screen.print(f"{out or path}: written", soft_wrap=True)
    return 0


@command("list", "  mjx-tt robot list\n", robots_app)
def names() -> None:
    """Lists the robots that come with the program."""
    from mjx_tt.robot import robots

    for name in robots.names():
        contract = robots.load_shipped(name).contract
        axes = ", ".join(contract.joints[i] for i in contract.carrying) or "no axis"
        make_console().print(f"{name:<16}{len(contract.arm)} joints on {axes}")


@command("rig", "  mjx-tt rig --out rig.yaml          and in another terminal:  mjx-tt run ARTEFACT --robot rig.yaml\n")
def rig(
    *,
    ports: Annotated[
        tuple[int, ...],
        options.numbers(
            "ARM,TRACKER,AXES",
            "ports of the devices",
            "a port for each device, such as 6510,6520,5021,5022",
            lambda ports: 2 <= len(ports) <= 8 and all(0 < port < 65536 for port in ports),
        ),
    ] = (6510, 6520, 5021, 5022),
    robot: Annotated[
        str | None, option("NAME", "the installed robot, by name or folder (default: the paper's)")
    ] = None,
    out: Annotated[Path, option("YAML", "where to write its robot.yaml")] = Path("rig-robot.yaml"),
    distribution: Annotated[
        str, option("NAME", "distribution of the balls that are thrown (default: player3/M0)")
    ] = "player3/M0",
    rig: options.RigFile = None,
    seed: options.RigSeed = 0,
) -> int:
    """Runs the emulated robot alone, on real sockets."""
    options.start_jax()
    from experiments.deploy import rig as emulated

    return emulated.serve(distribution, rig, seed, ports, out, make_console(), robot)
