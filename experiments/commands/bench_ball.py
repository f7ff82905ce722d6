"""``mjx-tt bench-ball``: predictors of the ball compared on measured sets."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.options import option

app = options.command(
    "bench-ball",
    "compare predictors of the ball on measured sets",
    """\
  mjx-tt bench-ball launcher/topspin.hdf5 launcher/no_spin.hdf5 --out benchmark
  mjx-tt bench-ball rallies.csv --model diagnosis/extended.yaml --out benchmark

Sets: session,trajectory,t,x,y,z as CSV or MCAP, AIMY's HDF5, a folder in SpinDOE's form, a CSV of events in Ace's form.
Nothing is downloaded or copied. Writes benchmark.html (look at it first) and benchmark.csv.
""",
)


@app.default
def bench_ball(
    *data: Annotated[str, Parameter("SET", help="a file, or a folder in SpinDOE's form", required=True)],
    out: Annotated[str, option("DIR", "where page and table go")],
    model: Annotated[tuple[str, ...], option("YAML", "another model to compare; may be repeated")] = (),
) -> None:
    """Raises ConfigError for sets that cannot be read or are too small."""
    options.check_exists(*data, *model)
    options.check_writable(out)
    options.start_jax(1)
    from experiments.evaluation import ball_benchmark
    from experiments.progress import make_console

    worlds = {Path(path).stem: options.load_model(path) for path in model}
    found = ball_benchmark.score(data, worlds)
    screen = make_console()
    for b, licence in found:
        screen.print(f"{b.name}: {b.flights} flights ({licence})", style="bold")
        for s in b.scores:
            if s.across == "all":
                rms = " to ".join(f"{1e3 * v:.1f}" for v in s.rms[1:])
                inside = "" if math.isnan(s.inside) else f", {s.inside:.0%} in 90 % regions"
                text = f"{1e3 * s.rms[0]:6.1f} mm ({rms}), median {1e3 * s.median[0]:.1f}{inside}"
                screen.print(f"  {s.horizon:4.2f} s  {s.method:32} {text}")
    for path in ball_benchmark.write(Path(out), found)[:2]:
        screen.print(f"  {path}")
