"""``mjx-tt predict``: a log's balls some time ahead."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError
from experiments.options import option

app = options.command(
    "predict",
    "predict a log's balls some time ahead, with the uncertainty",
    """\
  mjx-tt predict rallies.csv --out predicted.csv
  mjx-tt predict rallies.csv --model diagnosis/extended.yaml --seen 0.15 --horizon 0.1 --horizon 0.3 --out predicted.csv

Writes session,trajectory,t,x,y,z and the deviations sd_x,sd_y,sd_z [m] and covariances of each stroke's prediction.
""",
)


@app.default
def predict(
    *data: Annotated[str, Parameter("DATA", help="tracks of any form", required=True)],
    out: Annotated[str, option("CSV", "the file to write")],
    model: options.Model = None,
    horizon: Annotated[
        tuple[float, ...], option("S", "seconds after the last sample used; may be repeated (default: 0.3)")
    ] = (0.3,),
    seen: Annotated[float | None, option("S", "use only the first S seconds of each stroke")] = None,
    format: options.Format = None,
    tracks: options.TrackFileOptions = options.TRACKS,
) -> None:
    """Raises ConfigError for data that hold no strokes."""
    options.check_suffix(out, ".csv")
    options.check_exists(*data, model)
    if any(not 0.0 < h < 5.0 for h in horizon):
        raise ConfigError(f"--horizon {', '.join(f'{h:g}' for h in horizon)}: seconds above 0 and below 5 are wanted")
    options.start_jax(1)
    from experiments.evaluation import ball_predictions
    from experiments.measurements import read_trajectories
    from experiments.progress import make_console

    measured = read_trajectories(data, format, tracks.load(), tracks.frame or "auto")
    lines = ball_predictions.write(Path(out), measured, options.load_model(model), tuple(sorted(horizon)), seen)
    make_console().print(*measured.notes, *lines, sep="\n")
