"""``mjx-tt render``: a policy at play as a picture or video; ``mjx-tt curves``: learning curves in one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments.commands.options import (
    Balls,
    BallSeed,
    Model,
    PolicyFolder,
    command,
    console,
    count,
    existing,
    experiment_of,
    option,
    start_jax,
    suffix,
)
from experiments.errors import checked
from experiments.runs.locate import find_policy
from experiments.runs.run_dir import Run

app = command(
    "render",
    "a picture or a video of a policy at play, without a display",
    """\
  mjx-tt render runs/quickstart --out episode.png --out episode.mp4
  mjx-tt render runs/quickstart --out rally.gif --episodes 4 --camera human
""",
)
curves_app = command(
    "curves",
    "the learning curves of several trainings in one picture",
    """\
  mjx-tt curves runs/quickstart runs/paper --out curves.png
""",
)


@app.default
def render(
    policy: PolicyFolder,
    /,
    *,
    balls: Balls = None,
    model: Model = None,
    out: Annotated[tuple[str, ...], option("FILE", ".png, .mp4 or .gif; may be repeated")],
    episodes: Annotated[int, count("episodes in a video (default: 2)")] = 2,
    camera: Annotated[str, Parameter(help="side, robot_back, human or top (default: side)")] = "side",
    seed: BallSeed = None,
) -> None:
    """Writes every file of ``out``."""
    find_policy(policy)
    existing(model, key="--model")
    for path in out:
        suffix(path, ".png", ".mp4", ".gif")
    start_jax(1)
    from experiments.evaluation import video
    from experiments.runs import load_policy

    screen = console()
    trained = load_policy.load(policy)
    experiment = experiment_of(trained, balls, model)
    played = video.replay(experiment, trained, episodes, experiment.config.evaluation.seed if seed is None else seed)
    for path in out:
        checked("", video.draw, Path(path), played, experiment.task.control_rate, camera)
        screen.print(path, highlight=False)


@curves_app.default
def curves(
    *runs: Annotated[str, Parameter("RUN", help="folder of a run, finished or under way", required=True)],
    out: Annotated[str, option("PNG", "the picture (default: curves.png)")] = "curves.png",
) -> None:
    """Draws them."""
    for folder in runs:
        Run(folder).config()
    from experiments.evaluation import figures

    found = [figures.read_curve(folder) for folder in runs]
    console().print(str(checked("", figures.draw_curves, Path(out), found)), highlight=False, soft_wrap=True)
