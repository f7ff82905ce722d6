"""``mjx-tt predict``: a log's balls some time ahead; ``mjx-tt bench-ball``: predictors compared on measured sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments.commands.options import Format, Model, command, console, existing, option, start_jax, suffix, writable
from experiments.errors import ConfigError, checked

app = command(
    "predict",
    "where a log's balls are some time after their last sample, with the uncertainty",
    """\
  mjx-tt predict rallies.csv --out predicted.csv
  mjx-tt predict rallies.csv --model diagnosis/extended.yaml --seen 0.15 --horizon 0.1 --horizon 0.3 --out predicted.csv

Writes session,trajectory,t,x,y,z and the deviations sd_x,sd_y,sd_z [m] and covariances of each stroke's prediction.
""",
)
bench_app = command(
    "bench-ball",
    "compare predictors of the ball on measured sets, where they lie",
    """\
  mjx-tt bench-ball launcher/topspin.hdf5 launcher/no_spin.hdf5 --out benchmark
  mjx-tt bench-ball rallies.csv --model diagnosis/extended.yaml --out benchmark

Sets: session,trajectory,t,x,y,z as CSV or MCAP, AIMY's HDF5, a folder in SpinDOE's form, a CSV of events in Ace's form.
Nothing is downloaded or copied. Writes benchmark.html (look at it first) and benchmark.csv.
""",
)


@app.default
def predict(
    *data: Annotated[str, Parameter("DATA", help=".csv, .mcap or .hdf5", required=True)],
    out: Annotated[str, option("CSV", "the file to write")],
    model: Model = None,
    horizon: Annotated[tuple[float, ...], option("S", "seconds after the last sample seen; may be repeated (0.3)")] = (
        0.3,
    ),
    seen: Annotated[float | None, option("S", "use the first seconds of each stroke only")] = None,
    format: Format = None,
) -> None:
    """Raises ConfigError for data that hold no strokes."""
    suffix(out, ".csv")
    existing(*data, model)
    if any(not 0.0 < h < 5.0 for h in horizon):
        raise ConfigError(f"--horizon {', '.join(f'{h:g}' for h in horizon)}: seconds above 0 and below 5 are wanted")
    start_jax(1)
    from ballmodel.trajectory import Dataset
    from experiments.evaluation import ball_predictions
    from experiments.measurements import read_all
    from mjx_tt.sim.model import ModelFile, SimModel

    measured = read_all(list(data), format)
    if not isinstance(measured, Dataset):
        raise ConfigError(f"{measured.source}: holds start states; measured trajectories are needed")
    world = checked("--model", ModelFile.load, model).model if model else SimModel()
    lines = ball_predictions.write(Path(out), measured, world, tuple(sorted(horizon)), seen)
    console().print(*lines, sep="\n", highlight=False)


@bench_app.default
def bench_ball(
    *data: Annotated[str, Parameter("SET", help="a file, or a folder in SpinDOE's form", required=True)],
    out: Annotated[str, option("DIR", "where page and table go")],
    model: Annotated[tuple[str, ...], option("YAML", "another model to compare; may be repeated")] = (),
) -> None:
    """Raises ConfigError for sets that cannot be read or are too small."""
    existing(*data, *model)
    writable(out)
    start_jax(1)
    from experiments.evaluation import ball_benchmark
    from mjx_tt.sim.model import ModelFile

    worlds = {Path(path).stem: checked("--model", ModelFile.load, path).model for path in model}
    found = ball_benchmark.score(data, worlds)
    screen = console()
    for b, licence in found:
        screen.print(f"{b.name}: {b.flights} flights ({licence})", style="bold", highlight=False)
        for s in b.scores:
            if s.across == "all":
                rms = " to ".join(f"{1e3 * v:.1f}" for v in s.rms[1:])
                text = f"{1e3 * s.rms[0]:6.1f} mm ({rms}), median {1e3 * s.median[0]:.1f}"
                screen.print(f"  {s.horizon:4.2f} s  {s.method:32} {text}", highlight=False)
    for path in ball_benchmark.write(Path(out), found)[:2]:
        screen.print(f"  {path}", highlight=False)
