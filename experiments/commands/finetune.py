"""``mjx-tt finetune``: a policy fine-tuned on a robot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.options import option
from experiments.runs.locate import find_policy

app = options.command(
    "finetune",
    "fine-tune a policy on a robot while a person plays",
    """\
  mjx-tt finetune runs/quickstart --robot robot.yaml --out runs/anna
  mjx-tt finetune runs/quickstart --robot rig --out runs/rig             the emulated robot, in real time
  mjx-tt finetune runs/quickstart --robot lockstep --rig worn.yaml       as fast as this machine allows
  mjx-tt finetune runs/quickstart --robot lockstep --player player3      through rallies with a virtual player

Every ball is on disk before the next begins: the same command continues after an interruption, a crash or a power cut.
""",
)


@app.default
def finetune(
    policy: Annotated[str, Parameter("RUN_OR_ARTEFACT", help="what to start from")],
    /,
    *,
    robot: Annotated[str, option("YAML", 'a robot.yaml, "rig" or "lockstep"')],
    settings: Annotated[
        str | None, option("YAML", "settings of the fine-tuning (default: docs/how-to/fine-tune.md)")
    ] = None,
    overrides: options.Overrides = (),
    out: Annotated[str | None, option("FOLDER", "folder of the run (default: POLICY-finetuned)")] = None,
    setup: options.RobotOptions = options.ROBOT,
) -> int:
    """Returns 130 where it was stopped."""
    from experiments.config import finetuning

    finetuning.load(settings, overrides)  # a mistake in it is told at once
    find_policy(policy)
    setup.check(robot)
    folder = out or f"{Path(policy).resolve().name}-finetuned"
    options.check_writable(folder)
    options.start_jax(1)
    from experiments.finetuning import on_robot
    from experiments.progress import make_console
    from experiments.runs import load_policy
    from experiments.runs.run_dir import Run

    screen, trained = make_console(), load_policy.load(policy).config
    chosen = finetuning.load(settings, overrides, trained)
    if finetuning.near(trained):
        rate = chosen.step.learning_rate
        screen.print(f"sigma {chosen.sigma}, step {rate}: the policy was trained by first-order gradients")
    report = on_robot.finetune(policy, chosen, Run(folder), robot, screen, setup)
    return 0 if report is not None else 130
