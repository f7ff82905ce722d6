"""Policies that come with the program are found by name from anywhere, but a folder of one's own comes first."""

from __future__ import annotations

import numpy as np
import onnxruntime
import pytest

from experiments.errors import RunError
from experiments.runs.locate import SHIPPED, artefact_of, find_policy
from robot_io.policy import artefact


@pytest.mark.parametrize("name", ["quickstart", "rallies"])
def test_a_shipped_policy_is_found_by_its_name_and_answers_as_it_was_exported(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = artefact_of(name)
    assert folder == SHIPPED / name
    golden = np.load(folder / "golden.npz")
    session = onnxruntime.InferenceSession(str(folder / "policy.onnx"), providers=["CPUExecutionProvider"])
    answer = session.run(None, {session.get_inputs()[0].name: golden["history"].astype(np.float32)})[0]
    np.testing.assert_allclose(answer, golden["action"], atol=1e-5)
    assert artefact.load(folder).policy.theta.size == 976  # its checksums are as they were
    (tmp_path / name).mkdir()
    with pytest.raises(RunError, match="neither a run"):
        find_policy(name)
