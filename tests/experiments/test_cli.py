"""The command line as a person meets it, on a tiny experiment."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from importlib import metadata
from io import StringIO

import imageio.v2 as imageio
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ballmodel.distribution import load_distribution
from bgs import normalizer
from experiments import cli
from experiments.evaluation import video
from experiments.runs import checkpoint, load_policy
from experiments.training import finalize, sweep
from robot_io.policy import artefact
from tests.support.paths import ROOT
from tests.support.tiny_experiment import write_tiny

COMMANDS = [command.name[0] for command in cli.COMMANDS]


def mjx_tt(*arguments) -> subprocess.CompletedProcess:
    """One command in this process."""
    given = list(map(str, arguments))
    with contextlib.redirect_stdout(StringIO()) as out, contextlib.redirect_stderr(StringIO()) as err:
        status = cli.main(given)
    return subprocess.CompletedProcess(given, status, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module", autouse=True)
def short_videos():
    """Of one episode and small: without a graphics card, pictures take longer than everything else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finalize, "EPISODES_SHOWN", 1)
        patch.setattr(video, "VIDEO_SIZE", (160, 90))
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(experiment YAML, folder of runs, output) of one whole ``mjx-tt train``."""
    folder = tmp_path_factory.mktemp("cli")
    yaml = write_tiny(folder, evaluate_every=2)
    done = mjx_tt("train", yaml, "--out", folder / "runs", "--devices", 1)
    assert done.returncode == 0, done.stdout + done.stderr
    return yaml, folder / "runs", done.stdout


def test_help_teaches_by_examples_and_neither_it_nor_refusals_wait_for_jax(tmp_path):
    """Of commands that refuse what they are given, 1 or 2 is the status; 0 of those that only show something."""
    (tmp_path / "file").write_text("")
    refused = {
        1: """train nowhere.yaml; train quickstart.yaml --out file; evaluate nowhere; export nowhere; render nowhere
        --out a.png; render . --out a.txt; fit-human a.csv --out a.txt; fit-human a.csv --out a.yaml; import a.csv
        --out a.csv; run nowhere --robot rig; finetune nowhere --robot rig; is2r nowhere.yaml; compare nowhere.yaml;
        study-report nowhere; evaluate . --model nowhere.yaml; curves nowhere; pack nowhere; unpack nowhere.zip;
        log lerobot nowhere --out a; fit-human file --fit nelder-mead --model file --out a.yaml""",
        2: """trian; train; evaluate . --episodes 0; evaluate . --episodes 2.5; rig --ports 1; log close a.mcap;
        run . --robot rig --backend tpu; fit-human file --fit simplex --out a.yaml""",
        0: "--version; --help",
    }
    lines = [([command, "--help"], 0) for command in COMMANDS]
    lines += [(line.split(), code) for code, text in refused.items() for line in text.split(";")][::-1]
    check = f"""
import sys
from experiments import cli
for arguments, code in {lines!r}:
    assert cli.main(arguments) == code, arguments
    assert "jax" not in sys.modules, arguments
"""
    done = subprocess.run([sys.executable, "-c", check], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert metadata.version("mjx-tt") in done.stdout and done.stdout.count("examples:") >= len(COMMANDS)
    assert all(f"mjx-tt {command} " in done.stdout for command in COMMANDS)


def test_a_missing_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "dpkt", None)
    (tmp_path / "arm.pcap").write_text("")
    done = mjx_tt("log", "replay", tmp_path / "arm.pcap")
    assert done.returncode == 1
    assert done.stderr == "mjx-tt: error: dpkt is missing: pip install 'mjx-tt[capture]'\n"


@pytest.mark.smoke
def test_train_leaves_evaluation_artefact_pictures_and_measurements(trained):
    _, runs, output = trained
    run = runs / "tiny"
    report = json.loads((run / "evaluation.json").read_text())
    assert {"return_rate", "low", "high", "hit_rate", "episodes", "reachable"} <= report.keys()
    assert 0 <= report["low"] <= report["return_rate"] <= report["high"] <= 1
    assert sum(report["outcomes"].values()) == report["episodes"] == 8
    arrays, notes = checkpoint.read_latest(run / "checkpoints")
    exported = artefact.load(run / "artefact")
    np.testing.assert_array_equal(exported.policy.theta, arrays["bgs.average"])
    assert exported.manifest["provenance"]["config"]["name"] == "tiny"
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == [1, 2, 3] and notes["update"] == 3
    assert ["evaluation/return_rate" in row for row in rows] == [False, True, False]
    assert {path.stem for path in (run / "plots").glob("*.png")} == {
        "landing_map",
        "return_rate_map",
        "rewards",
        "joint_speeds",
        "training",
    }
    for path in (run / "evaluation.json", run / "plots", run / "artefact"):
        assert str(path) in output.replace("\n", "")


def test_train_skips_what_is_done_and_one_failing_job_does_not_stop_the_others(trained, tmp_path):
    yaml, runs, _ = trained
    before = (runs / "tiny" / "evaluation.json").stat().st_mtime_ns
    (tmp_path / "broken.yaml").write_text("name: broken\nballs: player9/M0\n")
    again = mjx_tt("train", tmp_path / "broken.yaml", yaml, "--out", runs)
    assert again.returncode == 1
    assert "got 'player9/M0'; did you mean" in again.stdout
    assert "done before, skipped" in again.stdout
    assert (runs / "tiny" / "evaluation.json").stat().st_mtime_ns == before
    summary = again.stdout[again.stdout.index("Summary") :]
    assert "failed" in summary and "done" in summary


def test_evaluate_artefact_on_other_balls_leaves_the_artefact_alone(trained):
    """The policy plays on as exported; the pictures go beside it, since no other file belongs into an artefact."""
    _, runs, _ = trained
    folder = runs / "tiny" / "artefact"
    done = mjx_tt("evaluate", folder, "--balls", "narrow", "--episodes", 8, "--no-reachable", "--devices", 1)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((runs / "tiny" / "artefact-evaluation-narrow" / "evaluation.json").read_text())
    assert report["balls"]["name"] == "narrow"
    artefact.load(folder)


@pytest.mark.slow
def test_seeds_get_folders_of_their_own_and_the_best_is_selected(trained, tmp_path, monkeypatch):
    """Without evaluation, pictures and export, which come before the choice."""
    monkeypatch.setattr(sweep, "finish", lambda *_: {"return_rate": 0.5, "low": 0.4, "high": 0.6})
    done = mjx_tt("train", trained[0], "--out", tmp_path, "--seeds", "7", "--select", "--devices", 1)
    assert done.returncode == 0, done.stdout + done.stderr
    selection = json.loads((tmp_path / "tiny" / "selection.json").read_text())
    assert selection["best"] == "seed7" and -2 <= selection["scores"]["seed7"] <= 2
    assert "seed: 7" in (tmp_path / "tiny" / "seed7" / "config.yaml").read_text() and selection["robot"] is None


def test_policy_is_the_same_from_run_artefact_and_packed_file(trained, tmp_path):
    """An artefact keeps the normaliser, not the statistics: what training continues from gives the same normaliser."""
    folder, unpacked = trained[1] / "tiny", tmp_path / "unpacked"
    for arguments in (("pack", folder, "--out", tmp_path / "a.zip"), ("unpack", tmp_path / "a.zip", "--out", unpacked)):
        done = mjx_tt(*arguments)
        assert done.returncode == 0, done.stderr
    assert (unpacked / "evaluation.json").read_bytes() == (folder / "evaluation.json").read_bytes()
    run = load_policy.load(folder).policy
    for place in (folder, folder / "artefact", unpacked):
        loaded = load_policy.load(place).policy
        theta, statistics = load_policy.load_statistics(place)
        np.testing.assert_array_equal(loaded.theta, run.theta)
        np.testing.assert_array_equal(theta, run.theta)
        for mean, inverse_scale in ((loaded.mean, loaded.inv_std), normalizer.normaliser(statistics)):
            np.testing.assert_allclose(mean, run.mean, rtol=1e-6)
            np.testing.assert_allclose(inverse_scale, run.inv_std, rtol=1e-5)


def test_render(trained, tmp_path):
    """The video drawn after training plays; a picture can be asked for; a camera that is not there is named."""
    _, runs, _ = trained
    done = mjx_tt("render", runs / "tiny", "--out", tmp_path / "a.png", "--camera", "human")
    if "no OpenGL back end" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stdout + done.stderr
    assert imageio.imread(tmp_path / "a.png").std() > 10
    with imageio.get_reader(runs / "tiny" / "episode.mp4") as film:
        assert film.get_meta_data()["fps"] == 30.0 and film.get_meta_data()["duration"] > 0.8
        assert sum(1 for _ in film) > 30
    refused = mjx_tt("render", runs / "tiny", "--out", tmp_path / "a.png", "--camera", "nowhere")
    assert refused.returncode == 1 and "robot_back" in refused.stderr


def drag_only(_, state):
    """Abeyruwan et al. 2022: C_d 0.47, rho 1.29, A 1.256e-3, m 0.0027."""
    velocity = state[3:]
    drag = 0.47 * 1.29 * 1.256e-3 / (2 * 0.0027) * np.linalg.norm(velocity)
    return np.concatenate([velocity, [0, 0, -9.81] - drag * velocity])


def test_import_and_fit_human(tmp_path):
    """Balls flown by SciPy with the paper's drag come back as the box they were thrown from, by way of CSV and MCAP."""
    rng = np.random.default_rng(0)
    lines, n, times = ["trajectory,t,x,y,z"], 12, np.arange(0, 0.3, 1 / 125)
    starts = np.array([0.3, 1.3, 0.3, 0.0, -5.5, 1.2]) + rng.uniform(-0.05, 0.05, (n, 6))
    for i, start in enumerate(starts):
        flight = solve_ivp(drag_only, (0, 0.3), start, t_eval=times, rtol=1e-9, atol=1e-9)
        lines += [f"{i},{t},{x},{y},{z}" for t, (x, y, z) in zip(times, flight.y[:3].T, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    converted = mjx_tt("import", tmp_path / "a.csv", "--out", tmp_path / "a.mcap")
    assert converted.returncode == 0, converted.stderr
    back = mjx_tt("import", tmp_path / "a.mcap", "--out", tmp_path / "b.csv")
    assert f"{n} trajectories" in back.stdout, back.stderr
    fitted = mjx_tt("fit-human", tmp_path / "b.csv", "--fit", "gauss-newton", "--out", tmp_path / "anna.yaml")
    assert fitted.returncode == 0, fitted.stdout + fitted.stderr
    assert "player3/M2" in fitted.stdout and "anna" in fitted.stdout
    distribution = load_distribution(tmp_path / "anna.yaml")
    box = np.array(
        [distribution.position_min + distribution.velocity_min, distribution.position_max + distribution.velocity_max]
    )
    np.testing.assert_allclose(box, [starts.min(axis=0), starts.max(axis=0)], atol=0.01)


@pytest.mark.parametrize(
    "command, given, says",
    [
        ("train", "study_quick.yaml", "the shipped study_quick.yaml is a study: use `mjx-tt is2r study_quick.yaml`"),
        ("is2r", "{shipped}/train/narrow.yaml", "got an experiment with the key balls; use `mjx-tt train"),
        ("train", "wrong.yaml", "mjx-tt: error: wrong.yaml: trainin: expected one of the keys name, balls, "),
    ],
)
def test_a_mistake_ends_with_one_line_that_knows_files_of_other_commands(
    command, given, says, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong.yaml").write_text("name: a\nballs: narrow\ntrainin: {}\n")
    shipped = ROOT / "experiments" / "shipped"
    assert cli.main([command, given.format(shipped=shipped)]) == 1
    said = capsys.readouterr().err
    assert says.format(shipped=shipped) in said and len(said.splitlines()) == 1
