from __future__ import annotations

import hashlib
import json
import math
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import onnxruntime
import pytest

from robot_io import contract
from robot_io.limits import LIMITS
from robot_io.policy import artefact as artefacts
from robot_io.policy import export
from robot_io.policy.artefact import ArtefactError
from robot_io.policy.numpy_policy import StreamingPolicy
from robot_io.policy.policy import Policy
from tests.support.paths import ROOT

PROVENANCE = {"config": {"player": "narrow"}, "git": "0" * 40, "seed": 3, "return_rate": 0.95}


def _policy(seed=0):
    rng = np.random.default_rng(seed)
    return Policy(
        rng.normal(0, 0.3, contract.n_parameters()).astype(np.float32),
        rng.normal(0, 1, contract.N_OBSERVATION).astype(np.float32),
        rng.uniform(0.3, 4, contract.N_OBSERVATION).astype(np.float32),
    )


def _histories(count, seed=5):
    return np.random.default_rng(seed).normal(0, 1.5, (contract.HISTORY, contract.N_OBSERVATION, count))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("artefact") / "policy"
    return folder, export.write(folder, _policy(), PROVENANCE)


@pytest.fixture
def copy(exported, tmp_path):
    """A private copy of the artefact, to be damaged."""
    return shutil.copytree(exported[0], tmp_path / "policy")


def _rewrite_manifest(folder, change):
    """Forgery by somebody who knows the format: a changed manifest with a matching digest."""
    manifest = json.loads((folder / artefacts.MANIFEST).read_bytes())
    change(manifest)
    raw = json.dumps(manifest).encode()
    (folder / artefacts.MANIFEST).write_bytes(raw)
    (folder / artefacts.MANIFEST_DIGEST).write_bytes(artefacts.digest_line(raw))


def _replace_file(folder, name, content):
    (folder / name).write_bytes(content)
    _rewrite_manifest(folder, lambda m: m["files"].update({name: hashlib.sha256(content).hexdigest()}))


# --- the reference forward pass ---------------------------------------------------------------------------------------


def _forward_by_loops(theta, mean, inverse_scale, history):
    """The network written out number by number from docs/reference/artefact.md, with its own slicing of theta."""
    layers, start, inputs = [], 0, 11
    for outputs in (16, 24, 8):
        at = lambda k, i, o: theta[start + (k * inputs + i) * outputs + o]  # noqa: E731, B023
        kernel = [[[at(k, i, o) for o in range(outputs)] for i in range(inputs)] for k in (0, 1)]
        start += 2 * inputs * outputs
        layers.append((kernel, theta[start : start + outputs]))
        start += outputs
        inputs = outputs // 2
    x = [[(history[t][i] - mean[i]) * inverse_scale[i] for i in range(11)] for t in range(8)]
    for (kernel, bias), dilation, gated in zip(layers, (1, 2, 4), (True, True, False), strict=True):
        after = []
        for t in range(dilation, len(x)):
            z = [
                b
                + sum(
                    old[o] * x[t - dilation][i] + new[o] * x[t][i]
                    for i, (old, new) in enumerate(zip(*kernel, strict=True))
                )
                for o, b in enumerate(bias)
            ]
            half = len(z) // 2
            gate = lambda v: 1 / (1 + math.exp(-v))  # noqa: E731
            after.append(
                [math.tanh(z[o]) * gate(z[o + half]) for o in range(half)] if gated else [math.tanh(v) for v in z]
            )
        x = after
    assert len(x) == 1 and start == len(theta)
    return x[0]


def test_forward_equals_explicit_loops():
    policy = _policy().astype(np.float64)
    theta, mean, inverse_scale = policy.theta, policy.mean, policy.inv_std
    histories = _histories(3)
    actions = policy.apply(histories)
    assert actions.shape == (8, 3)
    for b in range(3):
        expected = _forward_by_loops(theta.tolist(), mean.tolist(), inverse_scale.tolist(), histories[:, :, b].tolist())
        np.testing.assert_allclose(actions[:, b], expected, atol=1e-13)
        single = policy.apply(histories[:, :, b])
        np.testing.assert_allclose(single, expected, atol=1e-13)


def test_streaming_equals_full_form():
    whole = _policy(1)
    policy = StreamingPolicy(whole)
    observations = np.random.default_rng(2).normal(size=(40, 11))
    for episode in (observations[:25], observations[25:]):
        policy.reset()
        history = [episode[0]] * contract.HISTORY  # the first observation fills the history
        for observation in episode:
            history = [*history[1:], observation]
            expected = whole.apply(np.stack(history))
            np.testing.assert_allclose(policy.step(observation), expected, rtol=0, atol=1e-12)


def test_streaming_refuses_a_bad_observation_and_forgets_it():
    good, bad = np.linspace(-1, 1, 11), np.zeros(11)
    bad[1] = np.nan
    disturbed, undisturbed = (StreamingPolicy(_policy()) for _ in range(2))
    for policy in (disturbed, undisturbed):
        policy.step(good)
    with pytest.raises(ValueError, match="ball_y"):
        disturbed.step(bad)
    with pytest.raises(ValueError, match=r"\(10,\).* 11 finite"):
        disturbed.step(bad[:10])
    np.testing.assert_array_equal(disturbed.step(-good), undisturbed.step(-good))


def test_history_of_another_shape_is_refused():
    for shape in ((11, 8), (8, 11, 2, 2), (11,)):
        with pytest.raises(ValueError, match="history has shape"):
            _policy().apply(np.zeros(shape))


# --- agreement of the four forms --------------------------------------------------------------------------------------


def test_four_forms_agree_on_1000_histories(exported):
    folder, report = exported
    assert set(report["from_reference"]) == {"jit", "onnxruntime", "jax_export"}
    assert report["largest_difference"] <= 1e-5
    assert export.verify(folder, seed=1)["largest_difference"] <= 1e-5


@pytest.mark.parametrize("batch", [1, 5])
def test_stored_forms_load_without_this_package_and_agree(exported, batch):
    folder, _ = exported
    histories = _histories(batch).astype(np.float32)
    expected = _policy().apply(histories)
    onnx_action = onnxruntime.InferenceSession(folder / artefacts.ONNX).run(None, {"history": histories})[0]
    stored = jax.export.deserialize(bytearray((folder / artefacts.JAX_EXPORT).read_bytes()))
    assert set(stored.platforms) >= {"cpu", "cuda"}
    np.testing.assert_allclose(onnx_action, expected, atol=1e-5)
    np.testing.assert_allclose(stored.call(histories), expected, atol=1e-5)


def test_the_onnx_file_says_what_its_numbers_are(exported):
    """By ONNX Runtime alone, against the paper's robot as the manifest has it."""
    session = onnxruntime.InferenceSession(exported[0] / artefacts.ONNX)
    found = session.get_modelmeta().custom_metadata_map
    manifest = json.loads((exported[0] / artefacts.MANIFEST).read_text())
    assert json.loads(found["contract"]) == manifest["contract"] and float(found["control_rate_hz"]) == 75.0
    assert found["observation_name"].split(",")[:3] == ["ball_x", "ball_y", "ball_z"]
    assert found["action_name"].split(",") == [row["name"] for row in manifest["contract"]["action"]]
    assert [float(x) for x in found["action_scale"].split(",")] == list(LIMITS.policy_velocity)
    assert found["action_unit"].split(",")[0] == "m/s"


@pytest.mark.parametrize("made", ["here", "shipped"])
def test_no_file_names_a_place_on_the_machine_that_wrote_it(exported, made):
    folder = exported[0] if made == "here" else ROOT / "experiments/shipped/policies/quickstart"
    for file in folder.iterdir():
        content = file.read_bytes()
        assert str(ROOT).encode() not in content and b".py" not in content, file.name


def test_constant_component_of_the_normaliser_has_no_effect(tmp_path):
    policy = _policy()
    policy.inv_std[4] = 0.0
    export.write(tmp_path / "policy", policy, {})
    history = _histories(1)[:, :, 0]
    loaded = artefacts.load(tmp_path / "policy")
    before = loaded.policy.apply(history)
    history[:, 4] += 10
    np.testing.assert_array_equal(loaded.policy.apply(history), before)


def test_forms_that_disagree_are_refused(copy):
    policy = _policy()
    policy.theta[3] += 1e-2
    other = export.onnx_model(policy).SerializeToString()
    _replace_file(copy, artefacts.ONNX, other)
    with pytest.raises(ArtefactError, match="differ by"):
        export.verify(copy)


# --- loading ----------------------------------------------------------------------------------------------------------


def test_loaded_artefact_is_what_was_written(exported):
    folder, report = exported
    loaded = artefacts.load(folder)
    for name in ("theta", "mean", "inv_std"):
        np.testing.assert_array_equal(getattr(loaded.policy, name), getattr(_policy(), name))
    assert loaded.manifest["provenance"] == PROVENANCE
    assert [joint["name"] for joint in loaded.manifest["contract"]["action"]] == list(contract.JOINT_NAMES)
    assert loaded.digest == report["digest"] == hashlib.sha256((folder / "manifest.json").read_bytes()).hexdigest()
    assert sorted(os.listdir(folder)) == sorted(artefacts.FILES)
    assert (folder / "manifest.sha256").read_text() == f"{loaded.digest}  manifest.json\n"  # as sha256sum has it
    observation = np.linspace(-1, 1, 11)
    constant = np.tile(observation, (8, 1))
    np.testing.assert_allclose(loaded.streaming().step(observation), loaded.policy.apply(constant), atol=1e-12)


def test_loading_needs_no_jax():
    code = (
        "import sys, robot_io.policy.artefact; sys.exit(any(m in sys.modules for m in ('jax', 'onnx', 'onnxruntime')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("name", artefacts.FILES)
def test_a_flipped_bit_anywhere_is_refused(copy, name):
    path = copy / name
    original = path.read_bytes()
    n_bits = 8 * len(original)
    random_bits = np.random.default_rng(len(name)).integers(0, n_bits, 60).tolist()
    for bit in [0, 7, n_bits - 8, n_bits - 1, *random_bits]:
        damaged = bytearray(original)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with pytest.raises(ArtefactError, match="manifest.json: SHA-256" if "manifest" in name else f"{name}: SHA-256"):
            artefacts.load(copy)
    path.write_bytes(original)
    artefacts.load(copy)


@pytest.mark.parametrize("name", artefacts.FILES)
def test_truncated_missing_and_extra_files_are_refused(copy, name):
    content = (copy / name).read_bytes()
    (copy / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(ArtefactError, match="SHA-256"):
        artefacts.load(copy)
    (copy / name).unlink()
    with pytest.raises(ArtefactError, match=f"{name} missing"):
        artefacts.load(copy)
    (copy / name).write_bytes(content)
    (copy / "notes.txt").write_text("x")
    with pytest.raises(ArtefactError, match="holds notes.txt"):
        artefacts.load(copy)


def test_program_in_the_documentation_reproduces_the_golden_outputs(copy):
    page = (ROOT / "docs" / "reference" / "artefact.md").read_text()
    program = page.split("```python\n")[1].split("```")[0]
    command = [sys.executable, "-c", program]
    subprocess.run(command, cwd=copy, check=True)
    _rewrite_manifest(copy, lambda m: m["normaliser"]["mean"].__setitem__(0, 0.1))
    assert "AssertionError" in subprocess.run(command, cwd=copy, check=False, capture_output=True, text=True).stderr


def test_no_folder(tmp_path):
    with pytest.raises(ArtefactError, match="no such folder"):
        artefacts.load(tmp_path / "nothing")


def _swap_joints(manifest):
    action = manifest["contract"]["action"]
    action[2], action[3] = action[3], action[2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_swap_joints, r"contract\.action\[2\]\.name: found 'joint_2', expected 'joint_1'"),
        (lambda m: m["contract"]["observation"][0].update(unit="mm"), r"observation\[0\]\.unit: found 'mm', exp"),
        (lambda m: m["contract"].update(control_rate_hz=100.0), r"contract\.control_rate_hz: found 100\.0, exp"),
        (lambda m: m["contract"].update(version=2), r"contract\.version: found 2, expected 1"),
        (lambda m: m["contract"]["limits"]["upper"].__setitem__(0, 9.0), r"contract\.limits\.upper\[0\]: found 9\.0"),
        (lambda m: m["contract"].pop("frame"), r"contract\.frame: missing"),
        (lambda m: m["contract"].update(extra=1), r"contract\.extra: found 1, not expected"),
        (lambda m: m["architecture"].update(dilations=[1, 1, 1]), r"architecture\.dilations\[1\]: found 1, expected 2"),
        (lambda m: m.update(schema_version=2), "schema_version: found 2, expected 1"),
        (lambda m: m.pop("provenance"), "keys are"),
        (lambda m: m["normaliser"].update(formula="x"), "normaliser.formula"),
        (lambda m: m["normaliser"].update(mean=[0.0] * 10), "normaliser.mean"),
        (lambda m: m["normaliser"].update(mean=["a"] * 11), "normaliser.mean"),
        (lambda m: m["normaliser"]["mean"].__setitem__(0, 0.1), "golden.npz.*differs from the golden outputs"),
        (lambda m: m.update(golden=None), "golden: found None"),
        (lambda m: m["golden"].update(count=3), r"golden.npz: history is float32 \(8, 11, 64\)"),
    ],
)
def test_mismatch_names_the_field(copy, change, message):
    _rewrite_manifest(copy, change)
    with pytest.raises(ArtefactError, match=message):
        artefacts.load(copy)


def test_well_hashed_but_wrong_contents_are_refused(copy, tmp_path):
    arrays = dict(np.load(copy / artefacts.PARAMETERS))
    wrong = [
        ({**arrays, "conv2/bias": np.full(24, np.nan, np.float32)}, "conv2/bias has a non-finite number"),
        ({**arrays, "conv2/bias": np.zeros(12, np.float32)}, r"conv2/bias is float32 \(12,\), expected .* \(24,\)"),
        ({**arrays, "conv2/bias": np.zeros(24)}, "conv2/bias is float64"),
        ({**arrays, "conv4/bias": np.zeros(1)}, "holds"),
        ({**arrays, "conv2/bias": np.array([None] * 24)}, "not a NumPy archive"),  # a pickle
    ]
    for contents, message in wrong:
        np.savez(tmp_path / "wrong.npz", **contents)
        _replace_file(copy, artefacts.PARAMETERS, (tmp_path / "wrong.npz").read_bytes())
        with pytest.raises(ArtefactError, match=f"params.npz: .*{message}|params.npz: {message}"):
            artefacts.load(copy)


# --- writing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_numbers_are_not_exported(tmp_path, index, bad):
    policy, name = _policy(), ("theta", "mean", "inv_std")[index]
    getattr(policy, name)[7] = bad
    with pytest.raises(ArtefactError, match=rf"{name}\[7\] is {bad}"):
        export.write(tmp_path / "policy", policy, PROVENANCE)
    assert not list(tmp_path.iterdir())


def test_arrays_of_a_wrong_size_are_not_exported(tmp_path):
    policy = replace(_policy(), theta=_policy().theta[:-1])
    with pytest.raises(ArtefactError, match=r"theta has shape \(975,\), expected \(976,\)"):
        export.write(tmp_path / "policy", policy, PROVENANCE)


@pytest.mark.parametrize("value", [math.nan, object()])
def test_provenance_must_be_json(tmp_path, value):
    with pytest.raises(ArtefactError, match="provenance is not plain JSON"):
        export.write(tmp_path / "policy", _policy(), {"return_rate": value})
    assert not list(tmp_path.iterdir())


def test_existing_artefact_is_replaced_only_on_demand(copy):
    before = artefacts.load(copy).digest
    with pytest.raises(ArtefactError, match="already exists"):
        export.write(copy, _policy(1), PROVENANCE)
    assert artefacts.load(copy).digest == before
    report = export.write(copy, _policy(1), PROVENANCE, overwrite=True)
    assert artefacts.load(copy).digest == report["digest"] != before
    assert os.listdir(copy.parent) == ["policy"]


def test_a_folder_of_something_else_is_never_overwritten(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(ArtefactError, match="holds thesis.tex"):
        export.write(tmp_path, _policy(), PROVENANCE, overwrite=True)
    assert (tmp_path / "thesis.tex").exists()


def test_existing_artefact_survives_a_disk_that_fills_up(copy):
    before = artefacts.load(copy).digest
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))  # params.npz is larger
    try:
        with pytest.raises(OSError, match="File too large"):
            export.write(copy, _policy(1), PROVENANCE, overwrite=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert artefacts.load(copy).digest == before
    assert os.listdir(copy.parent) == ["policy"]
