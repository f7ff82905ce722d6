"""The command line ``mjx-tt``. What a command needs is imported when it runs, so that --help answers at once."""

from __future__ import annotations

import argparse
import contextlib
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.errors import ConfigError, checked, explained

if TYPE_CHECKING:
    from rich.console import Console

DESCRIPTION = """\
From measured human balls to a trained, evaluated and exported table-tennis policy.

The usual way:
  mjx-tt balls                          which players and distributions there are
  mjx-tt train quickstart.yaml          train, evaluate, export: everything lands in runs/quickstart/
  mjx-tt evaluate runs/quickstart       play it again, on other balls if you like
  mjx-tt fit-human rallies.csv --out anna.yaml     a distribution of your own, for an experiment's key "balls"
"""
SHIPPED_HINT = (
    "\nA file name without a folder that is not in the current folder is looked up among the shipped experiments.\n"
)


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit status: 0 done, 1 failed with a message, 130 interrupted."""
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except KeyboardInterrupt as interruption:
        print(interruption or "interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if not explained(error):
            raise
        print(f"mjx-tt: error: {error}", file=sys.stderr)
        return 1


def train(options: argparse.Namespace) -> int:
    from experiments.config import experiment as config

    if options.select and not options.seeds:
        raise ConfigError("--select chooses among seeds: give them with --seeds, such as --seeds 0,1,2")

    paths = [_file(name, config.shipped()) for name in options.experiments]
    configs = [(str(path), config.load(path, tuple(options.set))) for path in paths]
    _start_jax(options.devices or _most_devices(configs))
    from experiments.training import sweep

    console = _console()
    planned = sweep.plan(configs, options.seeds, Path(options.out))
    ok = sweep.run_all(planned, console)
    if options.select and ok:
        for name in dict.fromkeys(job.config.name for job in planned):
            mine = [job for job in planned if job.config.name == name]
            sweep.select(Path(options.out) / name, mine, console)
    return 0 if ok else 1


def evaluate(options: argparse.Namespace) -> int:
    _start_jax(options.devices)
    from experiments.evaluation import evaluate as evaluation
    from experiments.runs import load_policy as policy
    from experiments.training import finalize

    console = _console()
    trained = policy.load(options.policy)
    experiment = _experiment_of(trained, options)
    settings = experiment.config.evaluation
    episodes, seed = options.episodes or settings.episodes, settings.seed if options.seed is None else options.seed
    bound = None if options.no_reachable else settings.reachable_balls
    played = evaluation.evaluate(experiment, trained, episodes, seed, bound)
    folder = Path(options.out) if options.out else _evaluation_folder(options)
    finalize.save_evaluation(folder, played, experiment.task.reward_weights)
    finalize.print_report(console, played.report, str(trained.source))
    console.print(f"  {folder}/evaluation.json, pictures in {folder}/plots", highlight=False, soft_wrap=True)
    return 0


def export(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.runs import load_policy as policy
    from experiments.runs.run_dir import Run
    from experiments.training import finalize

    console, run = _console(), Run(options.run)
    trained = policy.load(options.run)
    experiment = _experiment_of(trained, options)
    report = run.read_evaluation() if run.evaluation.exists() else None
    folder = Path(options.out) if options.out else run.artefact
    written = finalize.export_policy(folder, trained, experiment, report, console)
    if written:
        console.print(f"artefact: {folder}", highlight=False)
    return 0 if written else 1


def fit_human(options: argparse.Namespace) -> int:
    _start_jax(None)
    from experiments.commands import measurements

    measurements.fit(
        options.data, options.format, Path(options.out), options.name, options.eps, options.min_samples, _console()
    )
    return 0


def import_(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.commands import measurements

    measurements.convert(options.data, options.format, Path(options.out), _console())
    return 0


def render(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.evaluation import video as episodes
    from experiments.runs import load_policy as policy

    console = _console()
    trained = policy.load(options.policy)
    experiment = _experiment_of(trained, options)
    seed = experiment.config.evaluation.seed if options.seed is None else options.seed
    played = episodes.replay(experiment, trained, options.episodes, seed)
    for path in options.out:
        checked("", episodes.draw, Path(path), played, experiment.task.control_rate, options.camera)
        console.print(path, highlight=False)
    return 0


def curves(options: argparse.Namespace) -> int:
    from experiments.evaluation import figures

    found = [figures.read_curve(folder) for folder in options.runs]
    _console().print(str(checked("", figures.draw_curves, Path(options.out), found)), highlight=False, soft_wrap=True)
    return 0


def bench(options: argparse.Namespace) -> int:
    _start_jax(options.devices)
    from benchmarks.bench import main as run_benchmarks

    return run_benchmarks(_console(), json_path=options.json)


def run(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.deploy import session

    return session.run(
        Path(options.artefact),
        options.robot,
        options.balls,
        options.distribution,
        options.backend,
        Path(options.log),
        options.rig,
        options.seed,
        options.seconds,
        _console(),
    )


def finetune(options: argparse.Namespace) -> int:
    from experiments.config import finetuning

    settings = finetuning.load(options.settings, tuple(options.set))
    _start_jax(1)
    from experiments.deploy import session
    from experiments.runs.run_dir import Run

    run = Run(options.out or f"{Path(options.policy).resolve().name}-finetuned")
    report = session.finetune(
        options.policy,
        settings,
        run,
        options.robot,
        options.distribution,
        options.rig,
        options.backend,
        options.seed,
        _console(),
    )
    return 0 if report is not None else 130


def is2r(options: argparse.Namespace) -> int:
    from experiments.config import study as study_config

    study = study_config.load(_file(options.study, study_config.shipped()), tuple(options.set))
    devices = study.simulation.devices
    _start_jax(options.devices or (None if devices == "auto" else devices))
    from experiments.study import session, workers

    side_by_side = workers.choose(study, options.processes, options.devices)
    return 0 if session.run(study, Path(options.out) / study.name, _console(), side_by_side) else 130


def study_report(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.study.report import page as report

    _console().print(report.write(Path(options.study)), highlight=False, soft_wrap=True)
    return 0


def blind(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.study.blind import session

    session.run(options, _console())
    return 0


def compare(options: argparse.Namespace) -> int:
    from experiments.config import baselines as compare_config

    path = _file(options.comparison, compare_config.shipped())
    comparison, experiment = compare_config.load(path, tuple(options.set))
    _start_jax(1)
    from experiments.baselines import compare as comparing

    console = _console()
    folder = comparing.compare(comparison, experiment, str(path), Path(options.out), console)
    console.print(f"{folder}/comparison.md, with its pictures beside it", highlight=False, soft_wrap=True)
    return 0


def rig(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.deploy import session

    return session.rig(options.distribution, options.rig, options.seed, options.ports, Path(options.out), _console())


def log(options: argparse.Namespace) -> int:
    from experiments.commands import session_logs

    console = _console()
    if options.action == "list":
        session_logs.list_logs(Path(options.paths[0]), console)
    elif options.action == "check":
        return 1 if session_logs.check([Path(p) for p in options.paths], console) else 0
    else:
        act = session_logs.salvage if options.action == "salvage" else session_logs.export
        for path in options.paths:
            act(Path(path), Path(options.out) if options.out else None, console)
    return 0


def diagnose(options: argparse.Namespace) -> int:
    _start_jax(1)
    from experiments.commands import diagnose as diagnosis

    console, out = _console(), Path(options.out)
    without = tuple(name for part in options.without for name in part.split(",") if name)
    request = diagnosis.Request(
        tuple(options.logs),
        out,
        options.model,
        options.spin,
        without,
        options.seed,
        options.randomise,
        options.policy,
        options.retrain,
    )
    found = diagnosis.diagnose(request, console)
    extended = diagnosis.save(found, out)
    diagnosis.show(found, console)
    cost = None
    if options.policy:
        cost = diagnosis.play(extended, request, options.episodes, console)
    diagnosis.draw(found, out, ", ".join(Path(p).name for p in options.logs), console, cost)
    return 0


def schema(options: argparse.Namespace) -> int:
    import json

    from experiments.config import experiment as config

    print(json.dumps(config.json_schema(), indent=2))
    return 0


def balls(options: argparse.Namespace) -> int:
    from experiments.commands import measurements

    measurements.print_catalogue(_console())
    return 0


def _console() -> Console:
    """Where a command writes. A file or a pipe gets whole lines: only a terminal's width is one to break them at."""
    from rich.console import Console

    return Console(soft_wrap=not sys.stdout.isatty())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "mjx-tt", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    p = _command(
        commands,
        "train",
        train,
        "train experiments, evaluate them and export their policies",
        """\
  mjx-tt train quickstart.yaml
  mjx-tt train narrow.yaml medium.yaml --seeds 0,1,2        six runs: runs/narrow/seed0/ ... runs/medium/seed2/
  mjx-tt train player3_m2.yaml --seeds 0,1,2 --select       and name the best seed, as the paper does
  mjx-tt train my.yaml --set training.updates=500 --set balls=player1/M0

Run the same command again after an interruption: finished runs are skipped, others continue from their last
checkpoint, bit for bit. Ctrl-C saves a checkpoint first.
"""
        + SHIPPED_HINT,
    )
    p.add_argument("experiments", nargs="+", metavar="YAML")
    p.add_argument("--seeds", type=_seeds, default=(), metavar="0,1,2", help="one run per seed, in a folder of its own")
    p.add_argument("--select", action="store_true", help="play 50 episodes per seed and mark the best (needs --seeds)")
    p.add_argument("--out", default="runs", metavar="FOLDER", help="where runs go (default: runs)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change one key of every file")
    _add_devices(p)

    p = _command(
        commands,
        "evaluate",
        evaluate,
        "play a policy on fresh balls: rates, interval, pictures",
        """\
  mjx-tt evaluate runs/quickstart
  mjx-tt evaluate runs/quickstart --balls player1/M1 --episodes 5000
  mjx-tt evaluate artefacts/anna --model measured.yaml --out anna-on-measured

Without --out, a run on its own balls and model writes into its own folder; anything else into a folder beside it.
""",
    )
    _add_policy(p)
    p.add_argument("--episodes", type=_count, metavar="N", help="balls to play (default: the experiment's)")
    p.add_argument("--seed", type=int, metavar="K", help="another seed means other balls")
    p.add_argument(
        "--no-reachable", action="store_true", help="skip the minute that the bound on what is in reach takes"
    )
    p.add_argument("--out", metavar="FOLDER", help="for evaluation.json and plots/")
    _add_devices(p)

    p = _command(
        commands,
        "export",
        export,
        "write a run's policy as an artefact that a robot can run",
        """\
  mjx-tt export runs/quickstart
  mjx-tt export runs/quickstart --out artefacts/anna
""",
    )
    p.add_argument("run", metavar="RUN", help="folder of a run")
    p.add_argument("--out", metavar="FOLDER", help="default: RUN/artefact")
    p.set_defaults(balls=None, model=None)

    p = _command(
        commands,
        "fit-human",
        fit_human,
        "a human ball distribution from measured balls",
        """\
  mjx-tt fit-human rallies.csv --out anna.yaml
  mjx-tt fit-human monday.mcap tuesday.mcap --out anna.yaml --name anna
  mjx-tt fit-human rallies.json --out deepmind.yaml          (DeepMind's ball states)

Then write "balls: anna.yaml" in an experiment.
""",
    )
    p.add_argument("data", nargs="+", metavar="DATA", help=".csv, .mcap, .json (DeepMind) or .hdf5 (AIMY launcher)")
    p.add_argument("--out", required=True, metavar="YAML")
    p.add_argument("--name", default="", help="of the distribution (default: the name of the file written)")
    p.add_argument(
        "--eps", type=float, metavar="R", help="radius of DBSCAN in robust standard deviations (default: from the data)"
    )
    p.add_argument("--min-samples", type=_count, default=5, metavar="N", help="balls that make a cluster (default: 5)")
    _add_format(p)

    p = _command(
        commands,
        "import",
        import_,
        "convert measured trajectories to CSV or MCAP",
        """\
  mjx-tt import launcher.hdf5 --out launcher.csv
  mjx-tt import rallies.csv --out rallies.mcap
""",
    )
    p.add_argument("data", metavar="DATA")
    p.add_argument("--out", required=True, metavar="FILE", help=".csv or .mcap")
    _add_format(p)

    p = _command(
        commands,
        "render",
        render,
        "a picture or a video of a policy at play, without a display",
        """\
  mjx-tt render runs/quickstart --out episode.png --out episode.mp4
  mjx-tt render runs/quickstart --out rally.gif --episodes 4 --camera human
""",
    )
    _add_policy(p)
    p.add_argument("--out", action="append", required=True, metavar="FILE", help=".png, .mp4 or .gif; may be repeated")
    p.add_argument("--episodes", type=_count, default=2, metavar="N", help="episodes in a video (default: 2)")
    p.add_argument("--camera", default="side", help="side, robot_back, human or top (default: side)")
    p.add_argument("--seed", type=int, metavar="K", help="another seed means other balls")

    p = _command(
        commands,
        "curves",
        curves,
        "the learning curves of several trainings in one picture",
        """\
  mjx-tt curves runs/quickstart runs/paper --out curves.png
""",
    )
    p.add_argument("runs", nargs="+", metavar="RUN", help="folder of a run, finished or under way")
    p.add_argument("--out", default="curves.png", metavar="PNG", help="the picture (default: curves.png)")

    p = _command(
        commands,
        "run",
        run,
        "play: an exported policy on a robot, real or emulated",
        """\
  mjx-tt run runs/quickstart/artefact --robot rig --balls 30
  mjx-tt run runs/quickstart/artefact --robot robot.yaml
  mjx-tt run runs/quickstart/artefact --robot rig --rig worn.yaml --distribution player1/M1

The robot needs the operator: p prepares the axes, a arms, the space bar stops. The rig is switched on, armed and fed
with balls by itself. Read docs/concepts/safety.md and docs/how-to/run-on-the-robot.md before a real arm moves.
""",
    )
    p.add_argument("artefact", metavar="ARTEFACT", help="folder of an exported policy")
    p.add_argument("--robot", required=True, metavar="YAML", help='a robot.yaml, or "rig" for the emulated robot')
    p.add_argument("--balls", type=_count, metavar="N", help="end after N balls (default: when the operator quits)")
    p.add_argument("--seconds", type=float, metavar="S", help="end after S seconds")
    p.add_argument("--backend", choices=("numpy", "jit"), default="numpy", help="what computes the policy")
    p.add_argument("--log", default="runs/robot", metavar="FOLDER", help="for the MCAP log and the summary")
    _add_rig(p, None)

    p = _command(
        commands,
        "finetune",
        finetune,
        "fine-tune a policy on a robot while a person plays",
        """\
  mjx-tt finetune runs/quickstart --robot robot.yaml --out runs/anna
  mjx-tt finetune runs/quickstart --robot rig --out runs/rig             the emulated robot, in real time
  mjx-tt finetune runs/quickstart --robot lockstep --rig worn.yaml       as fast as this machine allows

Every ball is on disk before the next begins: the same command continues after an interruption, a crash or a power cut.
""",
    )
    p.add_argument("policy", metavar="RUN_OR_ARTEFACT", help="what to start from")
    p.add_argument("--robot", required=True, metavar="YAML", help='a robot.yaml, "rig" or "lockstep"')
    p.add_argument("--settings", metavar="YAML", help="settings (default: the paper's), docs/how-to/fine-tune.md")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change one setting")
    p.add_argument("--out", metavar="FOLDER", help="of the run (default: POLICY-finetuned)")
    p.add_argument("--backend", choices=("numpy", "jit"), default="numpy", help="what computes the policy")
    _add_rig(p, None)

    p = _command(
        commands,
        "is2r",
        is2r,
        "simulate, play, refine: the iterative loop and its study",
        """\
  mjx-tt is2r study_quick.yaml                              five virtual players, twenty minutes, ends in a report
  mjx-tt is2r study_full.yaml --set players=[player3]       the paper's number of balls
  mjx-tt is2r anna.yaml                                     with "robot: robot.yaml": docs/how-to/run-a-study.md

Every finished step is kept: the same command continues after an interruption, a crash, or when people have played.
A file name without a folder that is not in the current folder is looked up among the shipped studies.
""",
    )
    p.add_argument("study", metavar="YAML")
    p.add_argument("--out", default="runs", metavar="FOLDER", help="where the study's folder goes (default: runs)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change one key of the study")
    p.add_argument(
        "--processes",
        type=_count,
        metavar="N",
        help="how many do steps side by side, on a device each (default: one per processor core; one in all with --devices, "
        "on an accelerator or a robot)",
    )
    _add_devices(p)

    p = _command(
        commands,
        "study-report",
        study_report,
        "the report of a study, whole or under way: one HTML page",
        """\
  mjx-tt study-report runs/study-quick

Writes report/index.html with its pictures and tables: the paper's figures with ours beside them. What a study lacks is named.
""",
    )
    p.add_argument("study", metavar="FOLDER", help="folder of a study")

    p = _command(
        commands,
        "blind",
        blind,
        "policies under code names, for people who evaluate them",
        """\
  mjx-tt blind make anna-evaluates is2r-ft100=runs/a/artefact s2r-ft100=runs/b/artefact --trainer anna --evaluator anna
  mjx-tt run anna-evaluates/policies/A --robot robot.yaml          and fill in anna-evaluates/sheet.csv; then B, C, ...
  mjx-tt blind sheet anna-evaluates                                how many rallies count so far
  mjx-tt blind open anna-evaluates                                 when all are played: which was which, and the means

The key is sealed in FOLDER/key.sealed; it opens when every code has 50 rallies that count.
docs/how-to/evaluate-blind.md describes the procedure.
""",
    )
    p.add_argument("action", choices=("make", "sheet", "open"))
    p.add_argument("folder", metavar="FOLDER", help="of the blind evaluation")
    p.add_argument("policies", nargs="*", metavar="MODEL=POLICY", help="of make: a name and its artefact or run")
    p.add_argument("--trainer", default="", metavar="NAME", help="of make: who trained the policies")
    p.add_argument("--evaluator", default="", metavar="NAME", help="of make: who plays (default: the trainer)")
    p.add_argument(
        "--seed", type=int, default=0, metavar="K", help="of make: the study's seed that the policies belong to"
    )

    p = _command(
        commands,
        "compare",
        compare,
        "several learning algorithms on one task, also where none has trained",
        """\
  mjx-tt compare compare_quick.yaml                         BGS, ARS, PPO, SAC, QT-Opt: three minutes each
  mjx-tt compare mine.yaml --set budget.minutes=60 --set seeds=[0,1,2]

Algorithms and seeds that are finished are kept: the same command continues, and one with more of them adds to it.
A file name without a folder that is not in the current folder is looked up among the shipped comparisons.
""",
    )
    p.add_argument("comparison", metavar="YAML", help="docs/how-to/compare-algorithms.md explains it")
    p.add_argument("--out", default="runs", metavar="FOLDER", help="where its folder goes (default: runs)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change one key")

    p = _command(
        commands,
        "rig",
        rig,
        "the emulated robot alone, on real sockets",
        """\
  mjx-tt rig --out rig.yaml          and in another terminal:  mjx-tt run ARTEFACT --robot rig.yaml
""",
    )
    p.add_argument("--ports", type=_ports, default=(6510, 6520, 5021, 5022), metavar="ARM,TRACKER,X,Y")
    p.add_argument("--out", default="rig-robot.yaml", metavar="YAML", help="where its robot.yaml is written")
    _add_rig(p, "player3/M0")

    p = _command(
        commands,
        "log",
        log,
        "list, check, salvage or export the logs of a robot",
        """\
  mjx-tt log list runs/robot
  mjx-tt log check runs/robot/20261121-153000.mcap
  mjx-tt log salvage runs/robot/20261121-153000.mcap.part
  mjx-tt log export runs/robot/20261121-153000.mcap --out tables/
""",
    )
    p.add_argument("action", choices=("list", "check", "salvage", "export"))
    p.add_argument("paths", nargs="+", metavar="LOG", help="an .mcap or .mcap.part; for list a folder")
    p.add_argument("--out", metavar="PATH", help="of salvage: the file; of export: the folder")

    p = _command(
        commands,
        "diagnose",
        diagnose,
        "say what the simulation gets wrong about measured logs",
        """\
  mjx-tt diagnose session1.csv session2.mcap --out diagnosis
  mjx-tt diagnose robot/ --out diagnosis                    a folder with command.csv and state.csv
  mjx-tt diagnose session1.csv --policy runs/quickstart --out diagnosis          what the defect costs in play
  mjx-tt train my.yaml --set model=diagnosis/extended.yaml                       train with what was found

Writes report.html (look at it first), verdict.json, extended.yaml and plots. Ball logs: session,trajectory,t,x,y,z as
CSV, MCAP, or the launcher's HDF5; robot logs: command.csv (t,joint,velocity) and state.csv (t,joint,position).
""",
    )
    p.add_argument("logs", nargs="+", metavar="LOG", help="a file, or a folder of files")
    p.add_argument("--out", required=True, metavar="DIR", help="where report, verdict and extended model go")
    p.add_argument("--model", metavar="YAML", help="the model to judge; the nominal one by default")
    p.add_argument("--spin", choices=("none", "free"), default="none", help="whether the model's ball may spin (none)")
    p.add_argument(
        "--without", action="append", default=[], metavar="NAMES", help="effects to leave out of the catalogue"
    )
    p.add_argument("--randomise", action="store_true", help="extended.yaml draws what was fitted from its intervals")
    p.add_argument("--seed", type=int, default=0, help="of the bootstraps (0)")
    p.add_argument("--policy", metavar="POLICY", help="a run or artefact: what the defect costs it in play")
    p.add_argument(
        "--retrain", type=int, default=0, metavar="UPDATES", help="and what this much retraining brings back"
    )
    p.add_argument("--episodes", type=int, default=2000, help="of each evaluation (2000)")

    p = _command(
        commands,
        "bench",
        bench,
        "measure this machine: physics steps per second, time per update",
        """\
  mjx-tt bench
  mjx-tt bench --json bench.json
""",
    )
    p.add_argument("--json", metavar="FILE", help="write the figures as JSON")
    _add_devices(p)

    _command(
        commands,
        "schema",
        schema,
        "print the JSON schema of an experiment YAML, for your editor",
        """\
  mjx-tt schema > schema.json
and as the first line of a YAML:
  # yaml-language-server: $schema=schema.json
""",
    )
    _command(commands, "balls", balls, "list the paper's players and ball distributions", "  mjx-tt balls\n")
    return parser


def _command(commands, name: str, function, summary: str, examples: str) -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    p = commands.add_parser(
        name, help=summary, description=summary, epilog=f"examples:\n{examples}", formatter_class=raw
    )
    p.set_defaults(command=function)
    return p


def _add_devices(p: argparse.ArgumentParser) -> None:
    p.add_argument("--devices", type=_count, metavar="N", help="host devices to make (default: one per processor core)")


def _add_policy(p: argparse.ArgumentParser) -> None:
    p.add_argument("policy", metavar="RUN_OR_ARTEFACT", help="folder of a run or of an exported policy")
    p.add_argument("--balls", metavar="NAME_OR_YAML", help="other balls, such as player1/M1")
    p.add_argument("--model", metavar="YAML", help="another simulation model")


def _add_rig(p: argparse.ArgumentParser, distribution: str | None) -> None:
    trained = "the policy's" if distribution is None else distribution
    p.add_argument(
        "--distribution", default=distribution, metavar="NAME", help=f"balls that are thrown (default: {trained})"
    )
    p.add_argument("--rig", metavar="YAML", help="another rig: world, delays, network faults")
    p.add_argument("--seed", type=int, default=0, metavar="K", help="of the balls that are thrown")


def _add_format(p: argparse.ArgumentParser) -> None:
    p.add_argument("--format", metavar="NAME", help="csv, mcap, deepmind or aimy (default: from the suffix)")


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: a whole number of at least 1 is needed")
    return int(text)


def _ports(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if len(parts) != 4 or not all(part.isdigit() and 0 < int(part) < 65536 for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r}: four ports are needed, such as 6510,6520,5021,5022")
    return tuple(map(int, parts))


def _seeds(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if not all(part.strip().isdigit() for part in parts) or len(set(map(int, parts))) < len(parts):
        raise argparse.ArgumentTypeError(
            f"{text!r}: different whole numbers separated by commas are needed, such as 0,1,2"
        )
    return tuple(map(int, parts))


def _file(name: str, shipped: dict[str, Path]) -> Path:
    """The file of that name, or the one of that name that comes with the program."""
    path = Path(name)
    return path if path.exists() or path.parent != Path() else shipped.get(path.stem, path)


def _most_devices(configs) -> int | None:
    """As many host devices as the experiment with the most asks for; None where all leave it open."""
    return max((c.training.devices for _, c in configs if c.training.devices != "auto"), default=None)


def _start_jax(devices: int | None) -> None:
    from mjx_tt import platform

    # Called from a process that runs JAX already, a command takes the devices that are there.
    with contextlib.suppress(RuntimeError):
        platform.configure(devices)
    # JAX warns of every fork, but git and ffmpeg are started by fork and exec at once, which its threads do not mind.
    warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called", category=RuntimeWarning)


def _experiment_of(trained, options: argparse.Namespace):
    """The experiment that trained a policy, with the balls and model of the command line in place of its own."""
    from experiments.config import build

    config = trained.config
    if config is None:
        raise ConfigError(f"{trained.source}: does not say how it was trained; evaluate the run that it came from")
    if options.balls:
        config = config.model_copy(update={"balls": options.balls})
    if options.model:
        config = config.model_copy(update={"model": options.model})
    return build.experiment(config.model_copy(update={"initial_policy": None}), str(trained.source))


def _evaluation_folder(options: argparse.Namespace) -> Path:
    from experiments.runs.run_dir import CONFIG

    policy = Path(options.policy)
    changed = [
        Path(text).with_suffix("").as_posix().replace("/", "-") for text in (options.balls, options.model) if text
    ]
    if changed and (policy / CONFIG).exists():
        return policy / f"evaluation-{'-'.join(changed)}"
    if (policy / CONFIG).exists():
        return policy
    return policy.with_name("-".join([f"{policy.name}-evaluation", *changed]))  # an artefact holds its own files only


if __name__ == "__main__":
    sys.exit(main())
