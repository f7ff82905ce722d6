"""Blind evaluation: policies under code names, the key sealed until every rally is on the sheet.

Abeyruwan et al. 2022, Evaluation Methodology: all policies are tested in random order under names of a bijection, which
is revealed once all evaluations have been completed; a successful evaluation has at least 50 rallies that count.

A sealed file is encoded and carries a hash of its content. It is no secret to somebody who wants to read it: it keeps
the key from being read by chance, and from being changed after the rallies are known.
"""

from __future__ import annotations

import base64
import binascii
import csv
import hashlib
import itertools
import json
import secrets
import shutil
import string
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballmodel.files import replacing
from experiments.errors import ConfigError
from experiments.study import scoring

KEY, SHEET, POLICIES, OPENED, EVALUATIONS = "key.sealed", "sheet.csv", "policies", "key.json", "evaluations.csv"
BEGUN = ".begun"  # while an evaluation is being made
SHEET_COLUMNS = ("code", "rally", "length", "end")
SPARE = 10  # lines of a sheet beyond the pool, for rallies that will be filtered


# The bijection and its seal


def codes(count: int) -> tuple[str, ...]:
    """A, B, ... Z, AA, AB, ... in the order of testing."""
    lengths = (map("".join, itertools.product(string.ascii_uppercase, repeat=n)) for n in itertools.count(1))
    return tuple(itertools.islice(itertools.chain.from_iterable(lengths), count))


def draw(models, rng: np.random.Generator) -> dict[str, str]:
    """Code name of every model, one to one, in the order in which they are to be tested.

    The order is random and a code is only a place in it, so neither tells anything. Raises ValueError for a model that
    is given twice.
    """
    models = list(models)
    if len(set(models)) < len(models):
        raise ValueError(f"each model once, got {', '.join(models)}")
    return {models[k]: code for code, k in zip(codes(len(models)), rng.permutation(len(models)).tolist())}


def seal(path: Path, content: Any) -> str:
    """Writes plain JSON data so that it is not read by chance; returns the SHA-256 that commits to it."""
    plain = json.dumps({"nonce": secrets.token_hex(16), "content": content}).encode()
    digest = hashlib.sha256(plain).hexdigest()
    sealed = {
        "note": "Sealed: to be opened when all evaluations are done.",
        "sha256": digest,
        "sealed": base64.b64encode(zlib.compress(plain)).decode("ascii"),
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(sealed, indent=2) + "\n", encoding="utf-8")
    return digest


def unseal(path: Path) -> Any:
    """What ``seal`` was given. Raises ConfigError where the content is not what its hash commits to."""
    try:
        sealed = json.loads(Path(path).read_text(encoding="utf-8"))
        plain = zlib.decompress(base64.b64decode(sealed["sealed"], validate=True))
        if hashlib.sha256(plain).hexdigest() != sealed["sha256"]:
            raise ConfigError(f"{path}: its content is not what its hash commits to: it was changed after sealing")
        return json.loads(plain)["content"]
    except (ValueError, KeyError, TypeError, zlib.error, binascii.Error) as error:
        raise ConfigError(f"{path}: no sealed file: {error}") from None


# The protocol for people


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
    is in use or a policy that is not whole.
    """
    from robot_io import artefact

    folder = Path(folder)
    begun = folder / BEGUN
    if (folder / KEY).exists() or ((folder / POLICIES).exists() and not begun.exists()):
        raise ConfigError(f"{folder}: holds a blind evaluation already; choose another folder")
    found = {}
    for model, path in policies.items():
        path = Path(path)
        found[model] = path if (path / artefact.MANIFEST).exists() else path / "artefact"
        if not (found[model] / artefact.MANIFEST).exists():
            raise ConfigError(
                f"{model}: {path} is no artefact and no run with one; export it with `mjx-tt export {path}`"
            )
    digests = {model: artefact.load(path).digest for model, path in found.items()}
    key = draw(policies, np.random.default_rng())
    folder.mkdir(parents=True, exist_ok=True)
    if begun.exists():  # killed on the way: nobody has seen its codes
        shutil.rmtree(folder / POLICIES, ignore_errors=True)
    begun.touch()
    for model, code in key.items():
        shutil.copytree(found[model], folder / POLICIES / code)
    content = {"codes": key, "digests": digests, "trainer": trainer, "evaluator": evaluator, "seed": seed}
    blank_sheet(folder / SHEET, tuple(key.values()))
    seal(folder / KEY, content)
    begun.unlink()
    return tuple(key.values())


def blank_sheet(path: Path, tested: tuple[str, ...], rallies: int = scoring.POOL + SPARE) -> None:
    """A scoring sheet: the table of ends as comments, then a line for every rally."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        for line in instructions():
            file.write(f"# {line}\n")
        writer = csv.writer(file)
        writer.writerow(SHEET_COLUMNS)
        writer.writerows((code, rally, "", "") for code in tested for rally in range(1, rallies + 1))


def instructions() -> list[str]:
    """How to fill in a sheet, with the paper's table (Rally score evaluation and end-of-rally attribution)."""
    lines = [
        "One line a rally, in the order of play. length: paddle touches of human and robot together, the human's first",
        "hit is 1. end: number of the row that says how the rally ended. Lines without a length are left out.",
    ]
    for number, (_, description, ended, filtered) in enumerate(scoring.ROWS, 1):
        who = (
            "not counted"
            if filtered
            else {True: "the robot ended it", False: "the human ended it", None: "open"}[ended]
        )
        lines.append(f"{number:>2}  {description} [{who}]")
    return lines


def read_sheet(path: Path) -> dict[str, tuple[list[int], list[int]]]:
    """Lengths and ends of each code's rallies, in the order of their numbers. Raises ConfigError naming the line."""
    played: dict[str, list[tuple[int, int, int]]] = {}
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not readable as UTF-8: {error}") from None
    rows = [
        (number, line)
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith(("#", '"#'))
    ]
    header = next(csv.reader([rows[0][1]])) if rows else []
    if tuple(name.strip() for name in header[:4]) != SHEET_COLUMNS:
        raise ConfigError(f"{path}: the first line must be {','.join(SHEET_COLUMNS)}, got {','.join(header)}")
    for number, line in rows[1:]:
        code, rally, length, end = ([cell.strip() for cell in next(csv.reader([line]))] + [""] * 4)[:4]
        where = f"{path}: line {number}"
        played.setdefault(code, [])
        if not length and not end:
            continue
        if not rally.isdigit() or not length.isdigit():
            raise ConfigError(f"{where}: rally and length are whole numbers, got {rally!r} and {length!r}")
        try:
            played[code].append((int(rally), int(length), int(scoring.end_of(end))))
        except ValueError as error:
            raise ConfigError(f"{where}: end: {error}") from None
        if played[code].count(played[code][-1]) > 1 or [r for r, *_ in played[code]].count(int(rally)) > 1:
            raise ConfigError(f"{where}: rally {rally} of {code} is there twice")
    return {
        code: ([length for _, length, _ in sorted(p)], [end for *_, end in sorted(p)]) for code, p in played.items()
    }


def progress(folder: Path) -> list[Progress]:
    """How far the sheet is, code by code; writes a blank one where there is none."""
    folder = Path(folder)
    tested = tuple(unseal(folder / KEY)["codes"].values())
    if not (folder / SHEET).exists():
        blank_sheet(folder / SHEET, tested)
    sheet = read_sheet(folder / SHEET)
    unknown = sorted(set(sheet) - set(tested))
    if unknown:
        raise ConfigError(f"{folder / SHEET}: code {', '.join(unknown)} is unknown; there are {', '.join(tested)}")
    out = []
    for code in tested:
        _, end = sheet.get(code, ([], []))
        out.append(Progress(code, len(end), sum(scoring.End(e) not in scoring.FILTERED for e in end)))
    return out


def open_key(folder: Path) -> scoring.Rallies:
    """Reveals which code was which model and writes evaluations.csv and key.json.

    Raises ConfigError while an evaluation lacks rallies that count, or where a policy or the key is not what was
    sealed.
    """
    from robot_io import artefact

    folder = Path(folder)
    key = unseal(folder / KEY)
    open_ones = [p for p in progress(folder) if not p.complete]
    if open_ones:
        missing = ", ".join(f"{p.code} has {p.counted}" for p in open_ones)
        raise ConfigError(
            f"{folder}: the key stays sealed until each code has {scoring.KEEP} rallies that count; {missing}"
        )
    sheet, parts = read_sheet(folder / SHEET), []
    for model, code in key["codes"].items():
        if artefact.load(folder / POLICIES / code).digest != key["digests"][model]:
            raise ConfigError(f"{folder / POLICIES / code}: is not the policy that was sealed under this code")
        parts.append(scoring.scored(key["seed"], key["trainer"], key["evaluator"], model, code, *sheet[code]))
    rallies = scoring.join(parts)
    scoring.write(folder / EVALUATIONS, rallies)
    with replacing(folder / OPENED) as temporary:
        temporary.write_text(json.dumps(key, indent=2) + "\n", encoding="utf-8")
    return rallies
