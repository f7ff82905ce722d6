"""The simulation model: YAML there and back, drawing per episode, and errors that name what is wrong."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import yaml
from scipy import stats

from mjx_tt.sim import arguments, model, randomisation
from mjx_tt.sim.model import LATENCIES, BallSpinParams, LatencyParams, ModelFile, Range, Samples, SimModel


def test_yaml_keeps_every_parameter(tmp_path):
    """Every leaf gets its own value, so none can be lost or swapped."""
    values = {}
    for i, path in enumerate(path for path in model.paths() if path != "ball.flight.integrator"):
        low, high = np.clip(model.bounds(path), -200.0, 200.0)
        values[path] = float(low + (0.2 + 0.00307 * i) * (high - low))
    values["ball.flight.integrator"] = "midpoint"
    ranges = (Range("ball.table.restitution", 0.85, 0.95), Range("latency.abb_action", 0.06, 0.08))
    file = ModelFile(model.with_values(SimModel(), values), ranges, {"source": "diagnosis of session 3", "gain": 0.12})
    file.save(tmp_path / "a.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]
    read = ModelFile.load(tmp_path / "a.yaml")
    assert read == file
    assert model.paths(read.model) == values
    assert len(values) > 140 and len(set(values.values())) == len(values)


def test_what_is_drawn_keeps_the_order_of_the_file(tmp_path):
    """Each entry has a key of its own by its place: another order draws other worlds from the same seed."""
    paths = ["latency.abb_action", "ball.table.restitution", "ball.flight.mass"]
    lines = "".join(f"  {path}: {list(model.bounds(path))}\n" for path in paths)
    (tmp_path / "a.yaml").write_text(f"randomise:\n{lines}")
    assert [one.path for one in ModelFile.load(tmp_path / "a.yaml").randomise] == paths


def test_what_is_left_out_is_nominal(tmp_path):
    (tmp_path / "a.yaml").write_text("ball: {table: {restitution: 0.9}}\nsensing:\n  ball_offset_x: 0.01\n")
    read = ModelFile.load(tmp_path / "a.yaml")
    expected = model.paths() | {"ball.table.restitution": 0.9, "sensing.ball_offset_x": 0.01}
    assert model.paths(read.model) == expected
    assert read.randomise == () and read.provenance == {}
    (tmp_path / "empty.yaml").write_text("")
    assert ModelFile.load(tmp_path / "empty.yaml").model == SimModel()


@pytest.mark.parametrize("mean", [0.0, 30.0], ids=str)
def test_spin_is_gaussian_about_its_mean(mean):
    spin = BallSpinParams(mean_x=mean, mean_y=-5.0, std_x=20.0, std_z=2.0)
    drawn = np.asarray(model.draw_spin(jax.random.key(2), spin, (50, 80))).reshape(3, -1)
    assert stats.kstest(drawn[0], stats.norm(mean, 20.0).cdf).pvalue > 1e-3
    np.testing.assert_array_equal(drawn[1], -5.0)
    assert stats.kstest(drawn[2], stats.norm(0.0, 2.0).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(drawn[0], drawn[2])[0, 1]) < 4.5 / np.sqrt(4000)
    assert model.draw_spin(jax.random.key(2), BallSpinParams(), (50, 80)) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ball: {table: {restituton: 0.9}}", r"ball.table.restituton: expected .*; did you mean 'restitution'\?"),
        ("ball: {table: {restitution: high}}", "ball.table.restitution: expected a number from 0 to 1.5, got 'high'"),
        ("ball: {table: {restitution: 93}}", r"ball.table.restitution: expected .* from 0 to 1.5, got 93"),
        ("latency: {abb_action: 71}", r"latency.abb_action: expected a number from 0 to 1 s, got 71"),
        ("sensing: {ball_noise: 0.01, ball_noise: 0.02}", "key 'ball_noise' is given twice"),
        ("ball: {flight: {integrator: rk4}}", "ball.flight.integrator: expected 'paper' or 'midpoint', got 'rk4'"),
        ("drives: {joint_7: {lag: 0.02}}", r"drives.joint_7: expected .*; did you mean 'joint_[1-6]'\?"),
        ("randomise: {ball.table.restitution: [0.9, 0.8]}", r"expected numbers in ascending order, got \[0.9, 0.8\]"),
        ("randomise: {ball.table.friktion: [0, 1]}", r"randomise.ball.table.friktion: .* 'ball.table.friction'\?"),
        ("randomise: {samples: {ball.table.height: [0.0, 99]}}", r"samples.ball.table.height\[1\]: expected .* got 99"),
        ("randomise: {samples: {ball.table.height: [0.01], weight: [0]}}", "weight: expected a weight above 0"),
        (
            "randomise: {ball.table.height: [0, 0.01], samples: {ball.table.height: [0.01]}}",
            "randomise: ball.table.height: expected a range or samples, got both",
        ),
    ],
)
def test_mistakes_are_named_with_file_and_key(tmp_path, text, message):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        ModelFile.load(path)
    assert str(error.value).startswith(str(path))


def test_ranges_are_drawn_uniformly_and_apart():
    ranges = (Range("ball.table.restitution", 0.85, 0.95), Range("sensing.ball_offset_x", -0.01, 0.01))
    drawn = model.draw(jax.random.key(0), SimModel(), ranges, (50, 40))
    restitution, offset = np.asarray(drawn.ball.table.restitution), np.asarray(drawn.sensing.ball_offset_x)
    assert restitution.shape == offset.shape == (50, 40)
    assert stats.kstest(restitution.ravel(), "uniform", (0.85, 0.1)).pvalue > 1e-3
    assert stats.kstest(offset.ravel(), "uniform", (-0.01, 0.02)).pvalue > 1e-3
    assert abs(np.corrcoef(restitution.ravel(), offset.ravel())[0, 1]) < 4.5 / np.sqrt(2000)
    untouched = model.paths() | {"ball.table.restitution": None, "sensing.ball_offset_x": None}
    assert {k: None if np.ndim(v) else v for k, v in model.paths(drawn).items()} == untouched


def test_samples_are_drawn_row_by_row_and_by_weight(tmp_path):
    """From a file beside the model; frequencies against the weights, rows as they stand in the file."""
    rows = ["ball.table.restitution, drives.joint_2.lag, weight", "0.9, 0.01, 1", "0.92, 0.03, 3", "0.94, 0.02, 0"]
    (tmp_path / "posterior.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "a.yaml").write_text("randomise: {samples: posterior.csv, ball.table.height: [0.0, 0.01]}\n")
    file = ModelFile.load(tmp_path / "a.yaml")
    drawn = model.draw(jax.random.key(0), file.model, file.randomise, (40, 100))
    restitution, lag = np.asarray(drawn.ball.table.restitution), np.asarray(drawn.drives.joint_2.lag)
    pairs, counts = np.unique(np.stack([restitution.ravel(), lag.ravel()]), axis=1, return_counts=True)
    np.testing.assert_allclose(pairs, [[0.9, 0.92], [0.01, 0.03]], rtol=1e-6)
    assert stats.chisquare(counts, [1000, 3000]).pvalue > 1e-3
    assert stats.kstest(np.asarray(drawn.ball.table.height).ravel(), "uniform", (0.0, 0.01)).pvalue > 1e-3
    # It stands alone once it is saved, wherever that is.
    (tmp_path / "b").mkdir()
    file.save(tmp_path / "b" / "a.yaml")
    again = ModelFile.load(tmp_path / "b" / "a.yaml")
    same = model.draw(jax.random.key(0), again.model, again.randomise, (40, 100))
    np.testing.assert_array_equal(same.ball.table.restitution, restitution)
    assert randomisation.ends(file.randomise) == {
        "ball.table.restitution": [pytest.approx(0.9), pytest.approx(0.92)],
        "drives.joint_2.lag": [pytest.approx(0.01), pytest.approx(0.03)],
        "ball.table.height": [0.0, 0.01],
    }


def test_a_program_s_arguments_are_the_numbers_that_differ_and_are_not_drawn():
    height, friction = "ball.table.height", "ball.table.friction"
    world = model.with_values(SimModel(), {"ball.table.restitution": 0.9, height: 0.01, friction: 0.2})
    rows = Samples((friction,), np.array([[0.2], [0.3]]), np.array([1.0, 3.0]))
    found = arguments.arguments(world, (Range(height, 0.0, 0.02), rows))
    assert found.numbers == {"ball.table.restitution": np.float32(0.9)}
    np.testing.assert_allclose(found.drawing[1].share, [0.25, 1.0])
    plain = arguments.structure(world, (Range(height, 0.0, 0.02), rows))
    assert plain["changed"] == ["ball.table.restitution"] and plain["drawn"] == [{height: [0.0, 0.02]}, {friction: 2}]


def test_latencies_are_gaussian_in_seconds_and_cut():
    nominal = LatencyParams()
    seconds = np.asarray(model.draw_latencies(jax.random.key(1), nominal, (4000,), 1.0))
    assert seconds.shape == (5, 4000)
    for name, values in zip(LATENCIES, seconds, strict=True):
        gaussian = stats.norm(getattr(nominal, name), getattr(nominal, f"{name}_std"))
        assert stats.kstest(values, gaussian.cdf).pvalue > 1e-3
    assert np.abs(np.corrcoef(seconds) - np.eye(5)).max() < 4.5 / np.sqrt(4000)
    cut = np.asarray(model.draw_latencies(jax.random.key(1), nominal, (4000,), 0.05))
    np.testing.assert_array_equal(cut, np.clip(seconds, 0, np.float32(0.05)))


def test_a_failed_write_leaves_the_old_file(tmp_path):
    """The new content goes to another name first: a write that fails half way destroys nothing."""
    path = tmp_path / "a.yaml"
    ModelFile(SimModel()).save(path)
    before = path.read_text()
    with pytest.raises(yaml.representer.RepresenterError):  # half way through the text
        ModelFile(SimModel(), provenance={"new": object()}).save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]
    assert path.read_text() == before
    assert yaml.safe_load(before)["provenance"] == {}
