"""``mjx-tt import``: measured trajectories as CSV or MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError
from experiments.options import option

app = options.command(
    "import",
    "convert measured trajectories to CSV or MCAP",
    """\
  mjx-tt import launcher.hdf5 --out launcher.csv
  mjx-tt import rallies.csv --out rallies.mcap
""",
)


@app.default
def import_measurements(
    data: Annotated[str, Parameter("DATA", help="trajectories")],
    /,
    *,
    out: Annotated[str, option("FILE", ".csv or .mcap")],
    format: options.Format = None,
    tracks: options.TrackFileOptions = options.TRACKS,
) -> None:
    """Raises ConfigError for another suffix or without trajectories."""
    options.check_exists(data)
    options.check_suffix(out, ".csv", ".mcap")
    options.start_jax(1)
    from ballmodel.io import write_mcap
    from experiments.measurements import read_trajectories, write_csv
    from experiments.progress import make_console

    path = Path(out)
    measured = read_trajectories([data], format, tracks.load(), tracks.frame)
    if path.exists() and path.samefile(data):
        raise ConfigError(f"--out {path}: is the file to be converted")
    path.parent.mkdir(parents=True, exist_ok=True)
    (write_csv if path.suffix == ".csv" else write_mcap)(path, measured)
    samples = sum(len(trajectory) for trajectory in measured)
    console = make_console()
    for note in measured.notes:
        console.print(note)
    console.print(f"{path}: {len(measured):,} trajectories, {samples:,} samples")
