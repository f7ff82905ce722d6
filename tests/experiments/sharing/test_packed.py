"""Packed policies: the same run gives the same bytes, every other byte is refused, and a folder is whole or absent.

Their card says what was measured, with its interval, and of which kind of evaluation it is.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import shutil
import stat
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import yaml

from experiments import cli
from experiments.config.experiment import parse
from experiments.runs.locate import SHIPPED
from experiments.sharing import card, packed
from experiments.sharing.packed import MEMBERS, SUMS, PackError, pack, read, unpack, zipped
from experiments.stats import wilson
from robot_io.policy import artefact as artefacts


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run as training leaves it, but for its checkpoints and pictures: of the policy that comes with the program."""
    folder = tmp_path_factory.mktemp("runs") / "anna"
    shutil.copytree(SHIPPED / "quickstart", folder / "artefact")
    provenance = json.loads((SHIPPED / "quickstart" / "manifest.json").read_text())["provenance"]
    (folder / "config.yaml").write_text(yaml.safe_dump(provenance["config"]))
    (folder / "evaluation.json").write_text(json.dumps(provenance["evaluation"]))
    return folder


@pytest.fixture(scope="module")
def file(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("packed") / "anna.mjxtt.zip"
    digest = pack(run, path)
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    return path


def test_the_same_run_gives_the_same_bytes_and_so_does_what_was_unpacked(run, file, tmp_path):
    again, unpacked = tmp_path / "again.zip", tmp_path / "unpacked"
    pack(run, again)
    assert again.read_bytes() == file.read_bytes()
    unpack(file, unpacked)
    pack(unpacked, again)
    assert again.read_bytes() == file.read_bytes()
    pack(run, again, licence="CC-BY-4.0")
    assert again.read_bytes() != file.read_bytes()


def test_the_bytes_do_not_depend_on_this_python():
    """The digest is that of Python 3.11; another one here would refuse every file that was packed before."""
    expected = "b97c1abaf247343786559eec931c3249b11d794b56e03fa2da02b68e0c1c66ae"
    assert hashlib.sha256(zipped({"a.txt": b"a", "b/c": bytes(range(256))})).hexdigest() == expected


def test_unpacked_files_are_those_of_the_run_and_check_without_the_program(run, file, tmp_path):
    figures = unpack(file, tmp_path / "deep" / "anna")
    folder = tmp_path / "deep" / "anna"
    found = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert found == set(MEMBERS) and [p.name for p in folder.parent.iterdir()] == ["anna"]
    for name in artefacts.FILES:
        assert (folder / "artefact" / name).read_bytes() == (run / "artefact" / name).read_bytes()
    assert figures["returned"][0] == pytest.approx(0.972, abs=5e-4)
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert json.loads((folder / "evaluation.json").read_text()) == evaluation
    # The shipped policy's configuration is older than some keys; written anew it says their defaults.
    configurations = [yaml.safe_load((place / "config.yaml").read_text()) for place in (folder, run)]
    assert configurations[0] == parse(configurations[1], "config.yaml").to_dict()
    rows = [line.split("  ") for line in (folder / SUMS).read_text().splitlines()[1:]]
    assert {n: hashlib.sha256((folder / n).read_bytes()).hexdigest() for n in MEMBERS[:-1]} == {n: h for h, n in rows}


def test_the_cards_code_runs_with_numpy_alone(file, tmp_path):
    unpack(file, tmp_path / "anna")
    (code,) = re.findall(r"```python\n(.*?)```", (tmp_path / "anna" / "README.md").read_text(), re.DOTALL)
    code += "\nimport sys; assert not {'jax', 'robot_io', 'scipy'} & sys.modules.keys()"
    done = subprocess.run([sys.executable, "-I", "-c", code], cwd=tmp_path / "anna", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) < 1e-9


def test_a_flipped_bit_anywhere_is_refused(file, tmp_path):
    """At random places of every member, and of all that is not a member: headers and directory."""
    raw, random, damaged = file.read_bytes(), np.random.default_rng(0), tmp_path / "damaged.zip"
    outside = np.ones(len(raw), bool)
    with zipfile.ZipFile(file) as archive:
        for i in archive.infolist():
            outside[i.header_offset + 30 + len(i.filename) :][: i.file_size] = False
    for byte in np.r_[np.flatnonzero(outside)[::12], random.integers(0, len(raw), 60)]:
        content = bytearray(raw)
        content[byte] ^= 1 << int(random.integers(0, 8))
        damaged.write_bytes(content)
        with pytest.raises(PackError, match="damaged.zip: .*copy the file again"):
            read(damaged)


def crafted(path, changes=(), leave=(), compression=zipfile.ZIP_STORED):
    """A zip with other members than the packed file has."""
    contents = {name: content for name, content in read(path).items() if name not in leave} | dict(changes)
    out = path.with_name("crafted.zip")
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return out


@pytest.mark.parametrize(
    ("changes", "leave", "words"),
    [
        ({"../evil": b""}, (), "'../evil' does not belong in it"),
        ({"artefact/../../evil": b""}, (), "does not belong in it"),
        ({}, ("README.md", SUMS), "'README.md', 'SHA256SUMS' missing"),
        ({"README.md": b"other"}, (), "README.md: SHA-256 is not"),
        ({SUMS: b""}, (), None),
    ],
)
def test_other_members_are_refused(file, changes, leave, words, tmp_path):
    shutil.copy(file, tmp_path / "a.zip")
    if words is None:  # a proper archive of the right members, in another order
        changes, words = {SUMS: read(file)[SUMS]}, "not as it was packed"
    with pytest.raises(PackError, match=re.escape(words)):
        unpack(crafted(tmp_path / "a.zip", changes, leave), tmp_path / "out")
    assert {p.name for p in tmp_path.iterdir()} == {"a.zip", "crafted.zip"}


def test_compressed_repeated_linked_cut_and_long_files_are_refused(file, tmp_path):
    shutil.copy(file, path := tmp_path / "a.zip")
    contents, raw = read(path), file.read_bytes()
    with pytest.raises(PackError, match="README.md: .* by method 8"):
        read(crafted(path, compression=zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("README.md", contents["README.md"])
    with pytest.raises(PackError, match="'README.md' there more than once"):
        read(path)
    link = zipfile.ZipInfo("README.md")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            archive.writestr(link if name == "README.md" else name, content)
    with pytest.raises(PackError, match="not as it was packed"):
        read(path)
    for content in (raw[:-1], raw[:5000], raw + b"\0", b"\0" + raw, b"", b"PK"):
        path.write_bytes(content)
        with pytest.raises(PackError):
            read(path)
    with open(path, "wb") as sparse:
        sparse.truncate(packed.LARGEST + 1)
    with pytest.raises(PackError, match="at most"):
        read(path)


def test_a_policy_whose_golden_vectors_do_not_come_out_is_refused(file, tmp_path):
    """All hashes agree; only playing the policy tells."""
    contents = {name: content for name, content in read(file).items() if name != SUMS}
    golden = dict(np.load(io.BytesIO(contents["artefact/golden.npz"])))
    golden["action"] += 1e-3
    np.savez(buffer := io.BytesIO(), **golden)
    contents["artefact/golden.npz"] = buffer.getvalue()
    manifest = json.loads(contents["artefact/manifest.json"])
    manifest["files"]["golden.npz"] = artefacts.sha256(buffer.getvalue())
    contents["artefact/manifest.json"] = json.dumps(manifest).encode()
    contents["artefact/manifest.sha256"] = artefacts.digest_line(contents["artefact/manifest.json"])
    path = tmp_path / "other.zip"
    path.write_bytes(zipped(contents))
    with pytest.raises(PackError, match=r"other.zip: artefact/golden.npz: .* differs from the golden outputs by 0.001"):
        unpack(path, tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["other.zip"]


def test_commands(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["pack", str(run / "artefact"), "--licence", "CC-BY-4.0"]) == 0  # stands for its run
    digest = hashlib.sha256((tmp_path / "anna.mjxtt.zip").read_bytes()).hexdigest()
    assert digest in capsys.readouterr().out
    assert cli.main(["unpack", "anna.mjxtt.zip"]) == 0
    assert "anna: 97.2% of 2,048 balls returned (95 % interval 96.4% to 97.8%)" in capsys.readouterr().out
    card = (tmp_path / "anna" / "README.md").read_text()
    assert card.startswith('---\nlicense: "cc-by-4.0"\n') and "| licence | CC-BY-4.0 |" in card
    assert cli.main(["unpack", "anna.mjxtt.zip"]) == 1
    assert "not an empty folder" in capsys.readouterr().err
    assert cli.main(["pack", str(run), "--out", "a.tar"]) == 1
    assert "allowed: .zip" in capsys.readouterr().err
    assert cli.main(["unpack", "none.zip"]) == 1
    assert cli.main(["pack", "none"]) == 1


@pytest.fixture(scope="module")
def artefact():
    return artefacts.load(SHIPPED / "quickstart")


def write(artefact, evaluation) -> str:
    return card.write(artefact, artefact.manifest["provenance"]["config"], evaluation)


def row(text: str, name: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_figures_come_with_their_intervals_and_conditions(artefact):
    evaluation = artefact.manifest["provenance"]["evaluation"]
    text = write(artefact, evaluation)
    n, counts = evaluation["episodes"], evaluation["outcomes"]
    for name, k in (("returned", counts["returned"]), ("hit", counts["returned"] + counts["hit"])):
        low, high = wilson(k, n)
        expected = [f"{100 * k / n:.1f} %", f"{100 * low:.1f} % to {100 * high:.1f} %", f"{n:,} balls"]
        assert row(text, name) == expected
    assert row(text, "in reach, at least")[2] == "256 of them"
    for words in ("balls of player3/M0", "seed 1000", "engine fused, 300 Hz", "nominal model", "without randomisation"):
        assert words in " ".join(text.split())
    assert artefact.digest in text and "not stated" in text and "license:" not in text


def test_an_evaluation_after_fine_tuning_names_the_robot(artefact):
    after = {"return_rate": 0.5, "return_rate_low": 0.4, "return_rate_high": 0.6, "balls": 80, "mean_return": 1.0}
    text = write(artefact, {"after": after, "updates": 12, "robot": {"robot": "the rig", "balls": 3}})
    assert row(text, "returned") == ["50.0 %", "40.0 % to 60.0 %", "80 balls"]
    assert "fine-tuned for 12 updates on the rig" in text and "Played there" in text
    assert "on no robot" not in text and "2,600 updates" not in text
