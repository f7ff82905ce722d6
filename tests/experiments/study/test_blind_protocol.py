"""Blind evaluation: the bijection, the seal, and the protocol from the command line with real artefacts."""

from __future__ import annotations

import base64
import csv
import html
import json
import zlib

import numpy as np
import pytest
from scipy.stats import chisquare

from experiments import cli
from experiments.errors import ConfigError
from experiments.study import blind_protocol
from experiments.study.analysis import scoring
from mjx_tt.rally import end_reasons
from robot_io.policy import artefact, export
from robot_io.policy.policy import Policy

MODELS = ("is2r-ft100", "s2r-ft100", "oracle-ft")


def test_codes_are_one_to_one_and_the_order_is_random():
    rng = np.random.default_rng(0)
    places = np.zeros((4, 4), int)
    for _ in range(2000):
        key = blind_protocol.draw("abcd", rng)
        assert list(key.values()) == ["A", "B", "C", "D"] and set(key) == set("abcd")
        for place, model in enumerate(key):
            places["abcd".index(model), place] += 1
    assert chisquare(places.ravel()).pvalue > 1e-3
    with pytest.raises(ValueError, match="expected each model once"):
        blind_protocol.draw(["a", "a"], rng)


def test_a_sealed_file_does_not_show_and_cannot_be_changed(tmp_path):
    path = tmp_path / "key.sealed"
    content = {"codes": {"is2r-ft100": "A"}, "number": 0.1}
    digest = blind_protocol.seal(path, content)
    text = path.read_text()
    assert "is2r" not in text and "codes" not in text and digest in text
    assert blind_protocol.unseal(path) == content
    assert (
        blind_protocol.seal(tmp_path / "again", content) != digest
    )  # the hash alone does not tell the content by trying
    sealed = json.loads(text)
    plain = zlib.decompress(base64.b64decode(sealed["sealed"])).replace(b"ft100", b"ft065")
    path.write_text(json.dumps(sealed | {"sealed": base64.b64encode(zlib.compress(plain)).decode()}))
    with pytest.raises(ConfigError, match="changed after sealing"):
        blind_protocol.unseal(path)
    path.write_text("{}")
    with pytest.raises(ConfigError, match="no sealed file"):
        blind_protocol.unseal(path)


@pytest.fixture(scope="module")
def artefacts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    for k, model in enumerate(MODELS):
        theta = np.random.default_rng(k).normal(0.0, 0.1, 976)
        export.write(folder / model / "artefact", Policy(theta, np.zeros(11), np.ones(11)), {"model": model})
    return folder


def fill(sheet, lengths, skip=()):
    """Writes lengths and ends, robot_missed as row 13, into the lines of a sheet, and leaves out what ``skip`` says."""
    lines = sheet.read_text().splitlines()
    comments = [line for line in lines if line.startswith("#")]
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    for row in rows[1:]:
        code, rally = row[0], int(row[1])
        if (code, rally) not in skip:
            row[2:] = [str(lengths[code][rally - 1]), "13"]
    sheet.write_text("\n".join([*comments, *(",".join(row) for row in rows)]) + "\n")


def test_people_evaluate_without_knowing_what(tmp_path, artefacts, capsys):
    folder = tmp_path / "blind"
    given = [f"{model}={artefacts / model}" for model in MODELS]
    assert (
        cli.main(["blind", "make", str(folder), *given, "--trainer", "anna", "--evaluator", "ben", "--seed", "2"]) == 0
    )
    assert sorted(p.name for p in (folder / "policies").iterdir()) == ["A", "B", "C"]
    shown = capsys.readouterr().out + (folder / "sheet.csv").read_text() + (folder / "key.sealed").read_text()
    assert not any(model in shown for model in MODELS)
    assert cli.main(["blind", "make", str(folder), *given]) == 1  # never over an evaluation that has begun
    content = (folder / "sheet.csv").read_bytes()
    assert b"\r" not in content
    sheet = content.decode()
    assert (
        all(f"# {number:>2}  " in sheet for number in range(1, 16)) and "Human hit the first ball to the net." in sheet
    )

    rng = np.random.default_rng(5)
    lengths = {code: rng.integers(2, 40, 70) for code in "ABC"}
    late = {("B", rally) for rally in range(40, 71)}
    fill(folder / "sheet.csv", lengths, late)
    assert [(p.code, p.counted, p.complete) for p in blind_protocol.count_progress(folder)] == [
        ("A", 70, True),
        ("B", 39, False),
        ("C", 70, True),
    ]
    assert cli.main(["blind", "open", str(folder)]) == 1
    message = capsys.readouterr().err
    assert "stays sealed" in message and "B has 39" in message and not any(model in message for model in MODELS)
    assert not (folder / "evaluations.csv").exists()

    fill(folder / "sheet.csv", lengths)
    assert cli.main(["blind", "sheet", str(folder)]) == 0
    assert cli.main(["blind", "open", str(folder)]) == 0
    rallies = scoring.read(folder / "evaluations.csv")
    assert set(zip(rallies.seed.tolist(), rallies.trainer.tolist(), rallies.evaluator.tolist(), strict=True)) == {
        (2, "anna", "ben")
    }
    for model in MODELS:
        mine = rallies.take(rallies.model == model)
        code = str(mine.blind[0])
        # The code is the folder whose policy is this model's: its numbers say so.
        played, original = (artefact.load(f) for f in (folder / "policies" / code, artefacts / model / "artefact"))
        np.testing.assert_array_equal(played.policy.theta, original.policy.theta)
        assert mine.rally.tolist() == list(range(1, 71))  # as on the sheet
        assert mine.length.tolist() == lengths[code].tolist()
        assert sorted(mine.length[mine.selected]) == sorted(lengths[code][:60])[-50:]


def test_a_start_that_was_cut_off_begins_anew(tmp_path, artefacts, monkeypatch):
    folder, policies = tmp_path / "blind", {model: artefacts / model for model in MODELS[:2]}

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(blind_protocol, "seal", killed)  # the policies are copied, the key is not yet there
        blind_protocol.make(folder, policies, "anna", "anna")
    assert (folder / "policies" / "A").exists() and not (folder / "key.sealed").exists()
    assert blind_protocol.make(folder, policies, "anna", "anna") == ("A", "B")
    assert sorted(path.name for path in folder.iterdir()) == [
        "instructions.html",
        "key.sealed",
        "policies",
        "sheet.csv",
    ]


def test_a_swapped_policy_is_found(tmp_path, artefacts):
    folder = tmp_path / "blind"
    folder.mkdir()
    blind_protocol.make(folder, {model: artefacts / model for model in MODELS[:2]}, "anna", "anna")
    fill(folder / "sheet.csv", {code: np.full(70, 4) for code in "AB"})
    (folder / "policies" / "A").rename(folder / "policies" / "swap")
    (folder / "policies" / "B").rename(folder / "policies" / "A")
    (folder / "policies" / "swap").rename(folder / "policies" / "B")
    with pytest.raises(ConfigError, match="not the policy that was sealed"):
        blind_protocol.open_key(folder)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("A,1,5,99", "no end of a rally; 1 to"),
        ("A,1,five,13", "invalid literal"),
        ("A,1,5,13\nA,1,6,13", "rally 1 of A is there twice"),
        ("A,1,0,14\nA,2,0,13", "length 0: the human's first hit is 1"),  # the first is a dummy ball, not counted
    ],
)
def test_a_bad_line_of_a_sheet_is_named(tmp_path, line, says):
    (tmp_path / "sheet.csv").write_text("code,rally,length,end\n" + line + "\n")
    with pytest.raises(ConfigError, match=f"sheet.csv: line .*{says}"):
        blind_protocol.read_sheet(tmp_path / "sheet.csv")


def test_a_folder_without_a_policy_and_an_evaluation_without_a_trainer_are_refused(tmp_path, artefacts, capsys):
    with pytest.raises(ConfigError, match="mjx-tt export"):
        blind_protocol.make(tmp_path / "b", {"m": tmp_path, "n": tmp_path}, "a", "a")
    assert cli.main(["blind", "make", str(tmp_path / "b"), *(f"{model}={artefacts / model}" for model in MODELS)]) == 1
    assert "--trainer" in capsys.readouterr().err and not (tmp_path / "b").exists()


def test_a_copy_does_not_say_which_model_it_is(tmp_path, artefacts):
    folder = tmp_path / "blind"
    blind_protocol.make(folder, {model: artefacts / model for model in MODELS}, "anna", "anna")
    key = blind_protocol.unseal(folder / "key.sealed")
    for model, code in key["codes"].items():
        copy = folder / "policies" / code
        for path in copy.iterdir():
            assert model.encode() not in path.read_bytes()
            assert path.stat().st_mtime >= (artefacts / model / "artefact" / path.name).stat().st_mtime
        loaded = artefact.load(copy)  # whole: what runs it accepts it
        assert (loaded.manifest["provenance"], loaded.manifest["written_with"]) == ({}, {})
        assert loaded.digest == key["digests"][model]
        assert artefact.load(artefacts / model / "artefact").digest == key["originals"][model]
    times = [(folder / "policies" / code / "params.npz").stat().st_mtime for code in "ABC"]
    assert times == sorted(times)


@pytest.mark.parametrize("separator, encoding", [(";", "utf-8-sig"), ("\t", "utf-8"), (",", "utf-8")])
def test_a_sheet_is_read_as_spreadsheets_save_it(tmp_path, separator, encoding):
    path = tmp_path / "sheet.csv"
    blind_protocol.write_blank_sheet(path, ("A", "B"), 3)
    lines = [line if line.startswith("#") else line.replace(",", separator) for line in path.read_text().splitlines()]
    lines = [line.replace(f"A{separator}2{separator * 2}", f"A{separator}2{separator}5{separator}13") for line in lines]
    lines = [f'"{line}"{separator * 3}' if line.startswith("#") else line for line in lines] + [separator * 3]
    path.write_bytes("\r\n".join(lines).encode(encoding))
    assert blind_protocol.read_sheet(path) == {"A": [blind_protocol.Played(2, 5, scoring.End.ROBOT_MISSED)], "B": []}


def test_the_page_to_print_has_instructions_ends_and_a_sheet_for_each_code(tmp_path):
    path = tmp_path / blind_protocol.PAGE
    blind_protocol.write_page(path, ("A", "B"))
    text = path.read_text(encoding="utf-8")
    for said in (
        "right quadrant",
        "the same one",
        "played again",
        "rest every twenty minutes",
        "emergency stop",
    ):
        assert said in text
    for _, description, *_ in end_reasons.ROWS:
        assert html.escape(description) in text
    assert text.count("<table") == 2 and text.index("<h2>A</h2>") < text.index("<h2>B</h2>")
    assert text.count("<tr><td>") == 2 * 70  # 60 are pooled, ten may be filtered
