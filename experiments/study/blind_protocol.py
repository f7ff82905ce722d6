"""Blind evaluation: policies under code names, the key sealed until every rally is on the sheet.

Abeyruwan et al. 2022, Evaluation Methodology: all policies are tested in random order under names of a bijection, which
is revealed once all evaluations have been completed; a successful evaluation has at least 50 rallies that count.

A sealed file is encoded and carries a hash of its content. It is no secret to somebody who wants to read it: it keeps
the key from being read by chance, and from being changed after the rallies are known.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import secrets
import shutil
import string
import zlib
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ballmodel.io.atomic_files import replacing
from experiments.errors import ConfigError, error_context
from experiments.runs import run_dir
from experiments.study.analysis import scoring
from mjx_tt.rally.end_reasons import ROWS, End

if TYPE_CHECKING:
    from robot_io.policy.artefact import Artefact

KEY, SHEET, POLICIES, OPENED, EVALUATIONS = "key.sealed", "sheet.csv", "policies", "key.json", "evaluations.csv"
BEGUN = ".begun"  # while an evaluation is being made
PAGE = "instructions.html"  # to print
SHEET_COLUMNS = ("code", "rally", "length", "end")
SEPARATORS = ",;\t"
SPARE = 10  # lines of a sheet beyond the pool, for rallies that will be filtered


# The bijection and its seal


def draw(models: Iterable[str], rng: np.random.Generator) -> dict[str, str]:
    """Code name A, B, ... of every model, one to one, in the order in which they are to be tested.

    The order is random and a code is only a place in it, so neither tells anything. Raises ValueError for a model that
    is given twice, and for more than there are letters.
    """
    models = list(models)
    if len(set(models)) < len(models) or len(models) > len(string.ascii_uppercase):
        raise ValueError(f"expected each model once, {len(string.ascii_uppercase)} at most, got {', '.join(models)}")
    order = rng.permutation(len(models)).tolist()
    return {models[k]: code for k, code in zip(order, string.ascii_uppercase, strict=False)}


def seal(path: Path, content: Any) -> str:
    """Writes plain JSON data so that it is not read by chance; returns the SHA-256 that commits to it."""
    plain = json.dumps({"nonce": secrets.token_hex(16), "content": content}).encode()
    digest = hashlib.sha256(plain).hexdigest()
    note, content = "Sealed: to be opened when all evaluations are done.", base64.b64encode(zlib.compress(plain))
    sealed = {"note": note, "sha256": digest, "sealed": content.decode("ascii")}
    run_dir.write_json(path, sealed)
    return digest


def unseal(path: Path) -> Any:
    """Content that ``seal`` was given. Raises ConfigError where its hash does not commit to it."""
    try:
        sealed = json.loads(Path(path).read_text(encoding="utf-8"))
        plain = zlib.decompress(base64.b64decode(sealed["sealed"], validate=True))
        genuine = hashlib.sha256(plain).hexdigest() == sealed["sha256"]
        content = json.loads(plain)["content"] if genuine else None
    except (ValueError, KeyError, TypeError, zlib.error) as error:
        raise ConfigError(f"{path}: no sealed file: {error}") from None
    if not genuine:
        raise ConfigError(f"{path}: its content is not what its hash commits to: it was changed after sealing")
    return content


# The protocol for people


@dataclass(frozen=True)
class Played:
    """A rally on the sheet: its number there, paddle touches, and how it ended."""

    rally: int
    length: int
    end: End


@dataclass(frozen=True)
class Progress:
    """Rallies on the sheet under one code: played, and those that count."""

    code: str
    played: int
    counted: int

    @property
    def complete(self) -> bool:
        return self.counted >= scoring.KEEP


def make(folder: Path, policies: dict[str, Path], trainer: str, evaluator: str, seed: int = 0) -> tuple[str, ...]:
    """Copies policies to folder/policies/CODE, writes a blank sheet, seals the key; returns the codes in order of
    testing.

    policies: model key to the folder of an artefact or of a run that was exported. Raises ConfigError for a folder that
    is in use, ArtefactError for one that is not whole.
    """
    from robot_io.policy import artefact

    folder = Path(folder)
    begun = folder / BEGUN
    if (folder / KEY).exists() or ((folder / POLICIES).exists() and not begun.exists()):
        raise ConfigError(f"{folder}: holds a blind evaluation already; choose another folder")
    loaded = {}
    for model, path in policies.items():
        found = [place for place in (path, path / "artefact") if (place / artefact.MANIFEST).exists()]
        if not found:
            raise ConfigError(
                f"{model}: {path} is no artefact and no run with one; export it with `mjx-tt export {path}`"
            )
        loaded[model] = artefact.load(found[0])
    key = draw(policies, np.random.default_rng())
    folder.mkdir(parents=True, exist_ok=True)
    if begun.exists():  # killed on the way: nobody has seen its codes
        shutil.rmtree(folder / POLICIES, ignore_errors=True)
    begun.touch()
    digests = {model: _copy(loaded[model], folder / POLICIES / code) for model, code in key.items()}
    originals, codes = {model: a.digest for model, a in loaded.items()}, tuple(key.values())
    write_blank_sheet(folder / SHEET, codes)
    write_page(folder / PAGE, codes)
    who = {"trainer": trainer, "evaluator": evaluator, "seed": seed}
    seal(folder / KEY, {"codes": key, "digests": digests, "originals": originals} | who)
    begun.unlink()
    return codes


def _copy(policy: Artefact, folder: Path) -> str:
    """Copies an artefact without what its manifest tells of its origin; returns the copy's own digest.

    Times of the files are those of the copy: the order in which policies were trained would tell them apart.
    """
    from robot_io.policy import artefact

    folder.mkdir(parents=True)
    for name in artefact.HASHED_FILES:
        shutil.copyfile(policy.folder / name, folder / name)
    manifest = json.dumps(policy.manifest | {"provenance": {}, "written_with": {}}, indent=2, allow_nan=False).encode()
    (folder / artefact.MANIFEST).write_bytes(manifest)
    (folder / artefact.MANIFEST_DIGEST).write_bytes(artefact.digest_line(manifest))
    return artefact.load(folder).digest


INSTRUCTIONS = (
    "One line a rally, in the order of play. length: paddle touches of human and robot together, the human's first",
    "hit is 1; 0 only where a rally is not counted. end: number of the row that says how the rally ended.",
    "Lines with neither length nor end are left out.",
)


def write_blank_sheet(path: Path, tested: tuple[str, ...], rallies: int = scoring.POOL + SPARE) -> None:
    """A scoring sheet: as comments the instructions and the paper's table of ends (Rally score evaluation and
    end-of-rally attribution), then a line for every rally."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        file.writelines(f"# {line}\n" for line in INSTRUCTIONS)
        file.writelines(f"# {number:>2}  {description} [{who}]\n" for number, description, who in list_ends())
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(SHEET_COLUMNS)
        writer.writerows((code, rally, "", "") for code in tested for rally in range(1, rallies + 1))


def list_ends() -> list[tuple[int, str, str]]:
    """Number, description and meaning of each row of the table of ends."""
    who = {True: "the robot ended it", False: "the human ended it", None: "open"}
    return [
        (number, description, "not counted" if filtered else who[ended])
        for number, (_, description, ended, filtered) in enumerate(ROWS, 1)
    ]


def write_page(path: Path, tested: tuple[str, ...]) -> None:
    """Instructions to player and evaluator, safety, consent and a sheet by hand for each code, as one page to print."""
    told = resources.files("experiments.study.report").joinpath("templates/players.html").read_text(encoding="utf-8")
    ends = "".join(f"<li value={n}>{escape(text)} [{who}]</li>" for n, text, who in list_ends())
    lines = "<tr><td>&nbsp;<td><td></tr>" * (scoring.POOL + SPARE)
    sheets = "".join(
        f"<h2>{code}</h2><table border=1 width=100%><tr><th>rally<th>length<th>end</tr>{lines}</table>"
        for code in tested
    )
    with replacing(path) as temporary:
        temporary.write_text(
            '<!doctype html><meta charset="utf-8"><title>Instructions</title>'
            "<style>body{font:11pt sans-serif;max-width:18cm;margin:auto}table{page-break-after:always}</style>"
            f"{told}<h2>Ends of rallies</h2><ol>{ends}</ol>{sheets}\n",
            encoding="utf-8",
        )


def read_sheet(path: Path) -> dict[str, list[Played]]:
    """Each code's rallies in the order of their numbers. Raises ConfigError naming the line.

    Cells may be separated by commas, semicolons or tabs: what a spreadsheet writes depends on its country.
    """
    with error_context(str(path)):
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    filled = [(n, x) for n, x in enumerate(lines, 1) if x.strip() and not x.lstrip().startswith(("#", '"#'))]
    head = filled[0][1] if filled else ""
    separator = next((s for s in SEPARATORS if tuple(_cells(head, s)[:4]) == SHEET_COLUMNS), None)
    if separator is None:
        raise ConfigError(f"{path}: expected the first line {','.join(SHEET_COLUMNS)}, got {head.strip()}")
    played: dict[str, list[Played]] = {}
    for number, line in filled[1:]:
        code, rally, length, end = (_cells(line, separator) + [""] * 4)[:4]
        if not any((code, rally, length, end)):
            continue
        rallies = played.setdefault(code, [])
        if length or end:
            with error_context(f"{path}: line {number}"):
                one = Played(int(rally), int(length), scoring.parse_end(end))
                if any(p.rally == one.rally for p in rallies):
                    raise ValueError(f"rally {rally} of {code} is there twice")
                if one.length < 0 or not one.length and one.end not in scoring.FILTERED:
                    raise ValueError(f"length {length}: the human's first hit is 1, and a rally with end {end} counts")
                rallies.append(one)
    return {code: sorted(rallies, key=lambda p: p.rally) for code, rallies in played.items()}


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]


def count_progress(folder: Path) -> list[Progress]:
    """Progress of the sheet, code by code; writes a blank one where there is none."""
    folder = Path(folder)
    tested = tuple(unseal(folder / KEY)["codes"].values())
    if not (folder / SHEET).exists():
        write_blank_sheet(folder / SHEET, tested)
    sheet = read_sheet(folder / SHEET)
    unknown = sorted(set(sheet) - set(tested))
    if unknown:
        raise ConfigError(f"{folder / SHEET}: code {', '.join(unknown)} is unknown; there are {', '.join(tested)}")
    rallies = {code: sheet.get(code, []) for code in tested}
    return [Progress(code, len(p), sum(x.end not in scoring.FILTERED for x in p)) for code, p in rallies.items()]


def open_key(folder: Path) -> scoring.Rallies:
    """Reveals which code was which model and writes evaluations.csv and key.json.

    Raises ConfigError while an evaluation lacks rallies that count, or where a policy or the key is not what was
    sealed.
    """
    from robot_io.policy import artefact

    folder = Path(folder)
    key = unseal(folder / KEY)
    open_ones = [p for p in count_progress(folder) if not p.complete]
    if open_ones:
        missing = ", ".join(f"{p.code} has {p.counted}" for p in open_ones)
        raise ConfigError(
            f"{folder}: the key stays sealed until each code has {scoring.KEEP} rallies that count; {missing}"
        )
    sheet, parts = read_sheet(folder / SHEET), []
    for model, code in key["codes"].items():
        if artefact.load(folder / POLICIES / code).digest != key["digests"][model]:
            raise ConfigError(f"{folder / POLICIES / code}: is not the policy that was sealed under this code")
        rally, length, end = zip(*map(astuple, sheet[code]), strict=True)
        who = (key["seed"], key["trainer"], key["evaluator"], model, code)
        parts.append(scoring.score_rallies(*who, length, end, rally))
    rallies = scoring.join(parts)
    scoring.write(folder / EVALUATIONS, rallies)
    run_dir.write_json(folder / OPENED, key)
    return rallies
