"""``mjx-tt curves``: learning curves in one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.errors import error_context
from experiments.options import option
from experiments.runs.run_dir import Run

app = options.command(
    "curves",
    "draw the learning curves of several trainings in one picture",
    "  mjx-tt curves runs/quickstart runs/paper --out curves.png\n",
)


@app.default
def draw_curves(
    *runs: Annotated[str, Parameter("RUN", help="folder of a run, finished or under way", required=True)],
    out: Annotated[str, option("PNG", "the picture (default: curves.png)")] = "curves.png",
) -> None:
    """Draws them."""
    for folder in runs:
        Run(folder).config()
    from experiments.evaluation import learning_curves
    from experiments.progress import make_console

    found = [learning_curves.read_curve(folder) for folder in runs]
    with error_context():
        make_console().print(str(learning_curves.draw_curves(Path(out), found)), soft_wrap=True)
