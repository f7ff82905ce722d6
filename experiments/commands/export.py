"""``mjx-tt export``: a run's policy as an artefact."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.options import option
from experiments.runs.locate import run_of
from experiments.runs.run_dir import Run

app = options.command(
    "export",
    "write a run's policy as an artefact that a robot can run",
    """\
  mjx-tt export runs/quickstart
  mjx-tt export runs/quickstart --out artefacts/anna
""",
)


@app.default
def export(
    folder: Annotated[str, Parameter("RUN", help="folder of a run")],
    /,
    *,
    out: Annotated[str | None, option("FOLDER", "default: RUN/artefact")] = None,
) -> int:
    """Returns 1 for a policy that the robot cannot run."""
    run = Run(run_of(folder))
    artefact = Path(out) if out else run.artefact
    options.check_writable(artefact)
    options.start_jax(1)
    from experiments.progress import make_console
    from experiments.runs import load_policy
    from experiments.training import finalize

    screen = make_console()
    trained = load_policy.load(run.folder)
    report = run.read_evaluation() if run.evaluation.exists() else None
    if not finalize.export_policy(artefact, trained, options.PLAY.experiment(trained), report, screen):
        return 1
    screen.print(f"artefact: {artefact}")
    return 0
