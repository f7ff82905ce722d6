"""``mjx-tt run``: an exported policy on a robot, real or emulated; ``mjx-tt rig``: the emulated robot alone."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter, Token

from experiments.commands.options import (
    RigFile,
    RigSeed,
    command,
    console,
    count,
    existing,
    option,
    start_jax,
    writable,
)
from experiments.errors import ConfigError
from experiments.runs.locate import artefact_of

Distribution = Annotated[str | None, option("NAME", "balls that are thrown (default: the policy's)")]
Player = Annotated[str | None, option("NAME", "virtual player on the rig, player1 to player5, who answers")]
Backend = Annotated[
    Literal["auto", "numpy", "jit"], Parameter(help="computes the policy; auto: JAX unless it is missing or slow")
]

app = command(
    "run",
    "play: an exported policy on a robot, real or emulated",
    """\
  mjx-tt run runs/quickstart --robot rig --balls 30
  mjx-tt run runs/quickstart --robot rig --rallies 20 --player player3
  mjx-tt run runs/quickstart/artefact --robot robot.yaml
  mjx-tt run runs/quickstart/artefact --robot rig --rig worn.yaml --distribution player1/M1

The robot needs the operator: p prepares the axes, a arms, the space bar stops. The rig is switched on, armed and fed
with balls by itself. Read docs/concepts/safety.md and docs/how-to/run-on-the-robot.md before a real arm moves.
""",
)
rig_app = command(
    "rig",
    "the emulated robot alone, on real sockets",
    """\
  mjx-tt rig --out rig.yaml          and in another terminal:  mjx-tt run ARTEFACT --robot rig.yaml
""",
)
robot_app = command(
    "robot",
    "a robot of your own in simulation (new, place, list); bring one into service (check, jog)",
    """\
  mjx-tt robot new my_arm/my_arm.xml                                a first YAML for an MJCF, checked
  mjx-tt robot check --robot robot.yaml                             tracker and arm are heard, nothing is sent
  mjx-tt robot check --robot robot.yaml --artefact runs/quickstart  and a policy plays the balls in thought
  mjx-tt robot jog --robot robot.yaml                               armed, slow, in small steps
  mjx-tt robot jog my_arm --robot robot.yaml                        a robot of your own; or one that comes with it

m notes where ball and joints are, for mjx-tt calibrate.
""",
)


@robot_app.default
def robot(
    action: Annotated[Literal["check", "jog"], Parameter("ACTION")],
    own: Annotated[
        str | None,
        Parameter("ROBOT", help="robot that stands there, by folder or name (default: the policy's, or the paper's)"),
    ] = None,
    /,
    *,
    robot: Annotated[str, option("YAML", "a robot.yaml")],
    artefact: Annotated[str | None, option("FOLDER", "of check: a policy, or its run")] = None,
    points: Annotated[str, option("CSV", "where points are noted")] = "points.csv",
    log: Annotated[str, option("FOLDER", "for the MCAP log")] = "runs/robot",
    seconds: Annotated[float | None, option("S", "end after S seconds")] = None,
) -> int:
    """Returns the exit status."""
    existing(robot, key="--robot")
    writable(log)
    if action == "jog" and artefact is not None:
        raise ConfigError(f"--artefact {artefact}: jog plays no balls; allowed with check only")
    folder = None if artefact is None else Path(artefact_of(artefact))
    start_jax(1)
    from experiments.deploy import commissioning

    if action == "check":
        return commissioning.check(Path(robot), folder, Path(log), Path(points), seconds, console(), own)
    return commissioning.jog(Path(robot), Path(log), Path(points), seconds, console(), own)


@app.default
def run(
    artefact: Annotated[str, Parameter("ARTEFACT", help="folder of an exported policy, or of its run")],
    /,
    *,
    robot: Annotated[str, option("YAML", 'a robot.yaml, or "rig" for the emulated robot')],
    balls: Annotated[int | None, count("end after N balls (default: when the operator quits)")] = None,
    rallies: Annotated[int | None, count("end after N rallies that count")] = None,
    player: Player = None,
    seconds: Annotated[float | None, option("S", "end after S seconds")] = None,
    backend: Backend = "auto",
    log: Annotated[str, option("FOLDER", "for the MCAP log and the summary")] = "runs/robot",
    distribution: Distribution = None,
    rig: RigFile = None,
    seed: RigSeed = 0,
) -> int:
    """Returns the exit status."""
    folder = artefact_of(artefact)
    existing(None if robot == "rig" else robot, key="--robot")
    existing(rig, key="--rig")
    known_player(player, robot, distribution)
    writable(log)
    start_jax(1)
    from experiments.deploy import session

    return session.run(
        Path(folder), robot, balls, distribution, backend, Path(log), rig, seed, seconds, console(), rallies, player
    )


def known_player(player: str | None, robot: str, distribution: str | None) -> None:
    """Raises ConfigError for a player who does not exist, has no rig to play in, or is to throw balls as well."""
    if player is None:
        return
    if robot not in ("rig", "lockstep"):
        raise ConfigError(f"--player {player}: virtual players play on the rig only; --robot is {robot}")
    if distribution is not None:
        raise ConfigError(
            f"--player {player}, --distribution {distribution}: a player has balls of their own; one of both"
        )
    folder = resources.files("mjx_tt") / "assets" / "virtual_players"
    names = sorted(Path(str(path)).stem for path in folder.iterdir() if str(path).endswith(".yaml"))
    if player not in names:
        raise ConfigError(f"--player {player}: unknown; allowed: {', '.join(names)}")


def _ports(_type: Any, tokens: Sequence[Token]) -> tuple[int, ...]:
    text = tokens[0].value
    parts = text.split(",")
    if not 2 <= len(parts) <= 8 or not all(part.isdigit() and 0 < int(part) < 65536 for part in parts):
        raise ValueError(f"{text!r}: a port for each device is needed, such as 6510,6520,5021,5022")
    return tuple(map(int, parts))


@rig_app.default
def rig(
    *,
    ports: Annotated[tuple[int, ...], option("ARM,TRACKER,AXES", "of the devices", converter=_ports)] = (
        6510,
        6520,
        5021,
        5022,
    ),
    robot: Annotated[
        str | None, option("NAME", "robot that stands there, by name or folder (default: the paper's)")
    ] = None,
    out: Annotated[str, option("YAML", "where its robot.yaml is written")] = "rig-robot.yaml",
    distribution: Annotated[str, option("NAME", "balls that are thrown (default: player3/M0)")] = "player3/M0",
    rig: RigFile = None,
    seed: RigSeed = 0,
) -> int:
    """Returns the exit status."""
    existing(rig, key="--rig")
    start_jax(1)
    from experiments.deploy import rig as emulated

    return emulated.rig(distribution, rig, seed, ports, Path(out), console(), robot)
