"""``mjx-tt render``: a policy at play as a picture or video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.errors import error_context
from experiments.options import count, option
from experiments.runs.locate import SHIPPED, find_policy

app = options.command(
    "render",
    "draw a picture or a video of a policy at play",
    """\
  mjx-tt render --out play.gif                     a policy that comes with the program
  mjx-tt render runs/quickstart --out episode.png --out episode.mp4
  mjx-tt render runs/quickstart --out balls.mp4 --episodes 4 --camera side
""",
)


@app.default
def render(
    policy: options.PolicyFolder = str(SHIPPED / "quickstart"),
    /,
    *,
    play: options.PlayOptions = options.PLAY,
    out: Annotated[tuple[str, ...], option("FILE", ".png, .mp4 or .gif; may be repeated")],
    episodes: Annotated[int, count("balls in a video (default: 2)")] = 2,
    camera: Annotated[str, Parameter(help="human, side, robot_back or top (default: human)")] = "human",
) -> None:
    """Writes every file of ``out``."""
    find_policy(policy)
    play.check()
    for path in out:
        options.check_suffix(path, ".png", ".mp4", ".gif")
    options.start_jax(1)
    from experiments.evaluation import video
    from experiments.progress import make_console
    from experiments.runs import load_policy

    trained = load_policy.load(policy)
    experiment = play.experiment(trained)
    played = video.record(experiment, trained, episodes, play.seed_of(experiment))
    for path in out:
        with error_context():
            video.draw(Path(path), played, camera, experiment.task.robot)
        make_console().print(path)
