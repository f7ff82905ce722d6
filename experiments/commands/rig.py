"""``mjx-tt rig``: the emulated robot alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Token

from experiments import options
from experiments.options import option

app = options.command(
    "rig",
    "run the emulated robot alone, on real sockets",
    "  mjx-tt rig --out rig.yaml          and in another terminal:  mjx-tt run ARTEFACT --robot rig.yaml\n",
)


def _parse_ports(_type: Any, tokens: Sequence[Token]) -> tuple[int, ...]:
    text = tokens[0].value
    parts = text.split(",")
    if not 2 <= len(parts) <= 8 or not all(part.isdigit() and 0 < int(part) < 65536 for part in parts):
        raise ValueError(f"expected a port for each device, such as 6510,6520,5021,5022, got {text!r}")
    return tuple(map(int, parts))


@app.default
def rig(
    *,
    ports: Annotated[tuple[int, ...], option("ARM,TRACKER,AXES", "ports of the devices", converter=_parse_ports)] = (
        (6510, 6520, 5021, 5022)
    ),
    robot: Annotated[
        str | None, option("NAME", "the installed robot, by name or folder (default: the paper's)")
    ] = None,
    out: Annotated[str, option("YAML", "where to write its robot.yaml")] = "rig-robot.yaml",
    distribution: Annotated[
        str, option("NAME", "distribution of the balls that are thrown (default: player3/M0)")
    ] = "player3/M0",
    rig: options.RigFile = None,
    seed: options.RigSeed = 0,
) -> int:
    """Returns the exit status."""
    options.check_exists(rig, key="--rig")
    options.start_jax(1)
    from experiments.deploy import rig as emulated
    from experiments.progress import make_console

    return emulated.serve(distribution, rig, seed, ports, Path(out), make_console(), robot)
