"""YAMLs of experiments, sites and fine-tunings: a mistake is named with its place and the way out."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import jsonschema
import pytest
import yaml

from ballmodel import registry
from ballmodel.io import validation
from experiments.config import build, experiment, files, finetuning, site
from experiments.config import experiment as config
from experiments.config.prior import PRIOR
from experiments.errors import ConfigError
from experiments.jobs.site import accelerators

SMALLEST = {"name": "a", "balls": "narrow"}


def with_value(path: str, value) -> dict:
    """The smallest experiment with one more value at a dotted path."""
    data = json.loads(json.dumps(SMALLEST))
    *parents, leaf = path.split(".")
    node = data
    for parent in parents:
        node = node.setdefault(parent, {})
    node[leaf] = value
    return data


def complaint(data: dict) -> str:
    with pytest.raises(ConfigError) as raised:
        build.experiment(config.parse(data, "my.yaml"), "my.yaml")
    return str(raised.value)


@pytest.mark.parametrize("path", files.shipped("train").values(), ids=files.shipped("train"))
def test_shipped_experiments_load_and_fit_the_schema(path):
    jsonschema.validate(files.read_yaml(path.read_text(), str(path)), validation.json_schema(config.Config))
    loaded = config.load(path)
    assert loaded.name == path.stem
    build.experiment(loaded, str(path))


@pytest.mark.parametrize(
    "path, value, place, hint",
    [
        ("trainin", {}, "trainin: expected one of the keys name, balls,", "did you mean 'training'?"),
        ("optimiser.pairs", 5, "optimiser.pairs: expected", "it is now called num_directions"),
        ("optimiser.rank", "singed", "rank: expected 'abs', 'signed' or 'max', got", "did you mean 'signed'?"),
        (
            "optimiser.step.schedule",
            {"kind": "piecewise", "changes": [{"update": 5, "rate": 0.1}]},
            "optimiser.step.schedule.changes[0].rate: expected one of the keys update, learning_rate",
            "changes[0].learning_rate: expected a number of more than 0, got nothing",
        ),
        ("task.rewards", {"styl": 1.0}, "task.rewards.styl: unknown reward term", "did you mean 'style'?"),
        ("training.later_rewards", {"after": 0.5, "rewards": {"x": 1}}, "later_rewards.rewards.x: unknown", "style"),
        ("task.sim_rate", 310.0, "task: sim_rate 310.0 Hz", "whole multiple"),
        ("balls", "player6/M0", "balls: expected a distribution, ", "got 'player6/M0'; did you mean 'player"),
        ("model", {"ball": {"table": {"restitutio": 0.9}}}, "model: ball.table.restitutio: expected", "'restitution'?"),
        ("initial_policy", "nowhere", "initial_policy: expected the folder of a run or an artefact, got nowhere", ""),
    ],
)
def test_a_mistake_is_named_with_file_path_and_hint(path, value, place, hint):
    text = complaint(with_value(path, value))
    assert text.startswith("my.yaml: ")
    assert place in text
    assert hint in text


def test_yaml_traps(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("name: a\nballs: narrow\noptimiser: {sigma: 25e-3}\n")
    assert config.load(file).optimiser.sigma == 0.025  # YAML 1.1 would call this text
    file.write_text("name: a\nballs: narrow\nname: b\n")
    with pytest.raises(ConfigError, match=r"key 'name' is given twice.*line 3"):
        config.load(file)
    file.write_text("name: [a\n")
    with pytest.raises(ConfigError, match="not valid YAML"):
        config.load(file)
    with pytest.raises(ConfigError, match="quickstart.yaml"):
        config.load(tmp_path / "quickstrt.yaml")


def test_a_looked_up_experiment_stands_alone(tmp_path):
    """Files that it names are taken in, relative to its own folder, so that a run can be read anywhere."""
    balls = registry.load("player2/M1").to_dict() | {"name": "anna"}
    (tmp_path / "anna.yaml").write_text(yaml.safe_dump(balls))
    (tmp_path / "model.yaml").write_text(
        "sensing: {ball_noise: 0.02}\nrandomise: {ball.table.restitution: [0.9, 0.95]}\n"
    )
    file = tmp_path / "a.yaml"
    file.write_text("name: a\nballs: anna.yaml\nmodel: model.yaml\n")
    first = build.experiment(config.load(file), str(file))
    for path in tmp_path.iterdir():
        path.unlink()
    again = build.experiment(config.parse(yaml.safe_load(yaml.safe_dump(first.config.to_dict())), "copy"), "copy")
    assert again.distribution == first.distribution == replace(registry.load("player2/M1"), name="anna")
    assert again.model == first.model
    assert again.model.model.sensing.ball_noise == 0.02
    assert again.config == first.config


def test_paths_of_the_file_are_relative_to_it_and_paths_of_overrides_to_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "there").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    file = tmp_path / "there" / "a.yaml"
    file.write_text("name: a\nballs: balls.yaml\nmodel: m.yaml\n")
    read = config.load(file, ("model=n.yaml", "initial_policy=runs/b"))
    assert read.balls == str(tmp_path / "there" / "balls.yaml")
    assert read.model == str(tmp_path / "here" / "n.yaml")
    assert read.initial_policy == str(tmp_path / "here" / "runs" / "b")


def test_paper_settings_are_the_papers():
    """The table of hyper-parameters in the paper's appendix."""
    built = build.experiment(config.load(files.find_shipped("paper", "train")), "paper")
    bgs = built.bgs
    assert (bgs.num_directions, bgs.sigma, bgs.elite_fraction, bgs.orthogonal, bgs.ema_decay) == (
        200,
        0.025,
        0.3,
        True,
        0.0,
    )
    paper = config.load(files.find_shipped("paper", "train"))
    assert paper.optimiser.repeats == 15
    assert built.task.sim_rate == 300 and built.task.contact_ends_episode
    assert built.model.model.ball.flight.integrator == "paper"
    drawn = {one.path: [one.low, one.high] for one in built.model.randomise}  # dynamics; latencies and noise as printed
    assert drawn["ball.table.restitution"] == [0.88, 0.98] and drawn["drives.joint_2.lag"] == [0.0, 0.025]
    assert len(drawn) == 4 + 2 * 8 and drawn.items() <= PRIOR.items()
    assert config.load(files.find_shipped("paper_mjx", "train"), ("task.engine=fused", "name=paper")) == paper
    assert config.load(files.find_shipped("paper_mjx", "train")).task.engine == "mjx"
    falling = config.load(files.find_shipped("quickstart", "train"), ("optimiser.sigma_fall={final: 0.01}",))
    sigma = build.experiment(falling, "quickstart").bgs.sigma
    assert (sigma(0), sigma(falling.training.updates)) == (0.025, pytest.approx(0.01))
    change, _ = bgs.step.update([1.0], bgs.step.init([0.0]))
    assert change == [pytest.approx(-0.00375)]


def test_the_prior_is_drawn_where_a_model_names_it(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("name: a\nballs: narrow\nmodel: {sensing: {ball_offset_x: 0.001}, randomise: prior}\n")
    made = build.experiment(config.load(file), str(file))
    assert {one.path: [one.low, one.high] for one in made.model.randomise} == PRIOR
    assert made.model.model.sensing.ball_offset_x == 0.001
    assert made.config.model["randomise"] == PRIOR  # the run keeps the numbers, whatever the program's become
    plain = build.experiment(config.load(file, ("model={}",)), str(file))
    unknown = build.unknown_worlds(plain)
    assert plain.model.randomise == () and {one.path for one in unknown.model.randomise} == set(PRIOR)
    file.write_text("name: a\nballs: narrow\nrobot: ur10e_rail\nmodel: {randomise: prior}\n")
    other = config.load(file)
    with pytest.raises(ConfigError, match="model.randomise: .* got prior, whose ranges are of the paper's robot"):
        build.experiment(other, str(file))
    file.write_text("name: a\nballs: narrow\nrobot: ur10e_rail\n")
    assert build.unknown_worlds(build.experiment(config.load(file), str(file))) is None


CORES = len(os.sched_getaffinity(0))
SLURM = {"provider": {"kind": "slurm", "walltime": "01:30:00"}, "workers_per_node": 16}
LOCAL = {"provider": {"kind": "local"}, "workers_per_node": 1}


def write(folder, data):
    path = folder / "cluster.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


@pytest.mark.parametrize(
    "data, message",
    [
        (SLURM | {"worker_per_node": 2}, r"worker_per_node: expected .*; did you mean 'workers_per_node'\?"),
        (SLURM | {"provider": {"kind": "slurn"}}, r"kind: expected .*'local'.*, got 'slurn'; did you mean 'slurm'"),
        (
            SLURM | {"provider": {"kind": "slurm", "walltime": "90"}},
            r"provider\.walltime: expected hours:minutes:seconds in quotes.*, got '90'",
        ),
        (LOCAL | {"workers_per_node": 4096}, rf"workers_per_node 4096 x cores_per_worker 1: .*at most {CORES}"),
        (LOCAL | {"blocks": 2}, r"blocks 2: .*allowed: 1 with provider\.kind local"),
        ("- slurm", r"cluster.yaml: expected a mapping, got \['slurm'\]"),
    ],
)
def test_a_mistake_is_named(tmp_path, data, message):
    path = write(tmp_path, data)
    with pytest.raises(ConfigError, match=message) as error:
        site.load(path)
    assert all("cluster.yaml" in line for line in str(error.value).splitlines())


def test_workers_of_a_host_see_accelerators_of_their_own(tmp_path):
    two = site.load(write(tmp_path, SLURM | {"workers_per_node": 2, "accelerators_per_worker": 2}))
    assert accelerators(two) == ["0,1", "2,3"]
    assert accelerators(site.load(write(tmp_path, SLURM))) == []


def shipped(name: str) -> experiment.Config:
    return experiment.load(files.find_shipped(name, "train"))


def test_defaults_are_the_papers_but_for_policies_by_first_order_gradients():
    for trained in (None, shipped("quickstart")):
        settings = finetuning.load(trained=trained)
        assert (settings.sigma, settings.step.learning_rate) == (0.025, 0.00375)
    settings = finetuning.load(trained=shipped("robust"))
    assert (settings.sigma, settings.step.learning_rate) == (0.01, 0.0015)
    # The step of both is the same share of the perturbation, and all else is alike.
    assert settings.sigma / settings.step.learning_rate == pytest.approx(0.025 / 0.00375)
    assert settings.model_copy(update={"sigma": 0.025, "step": finetuning.FineTuning().step}) == finetuning.FineTuning()


def test_own_settings_come_before_both(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("sigma: 0.02\n")
    settings = finetuning.load(path, ("step.learning_rate=0.001",), shipped("robust"))
    assert (settings.sigma, settings.step.learning_rate) == (0.02, 0.001)
