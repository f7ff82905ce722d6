"""A policy as one file to pass on: artefact, configuration, evaluation, a card, and the SHA-256 of each of them.

The file is a zip without compression whose every byte follows from its members, so that the same run gives the same
file and every other bit is damage. Hashes guard against damage and mix-ups; they are no signature.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import yaml

from ballmodel.io.atomic_files import placing, replacing
from experiments.errors import ConfigError, ExperimentError, RunError
from experiments.runs.locate import artefact_of, find_policy
from experiments.runs.run_dir import CONFIG, Run
from experiments.sharing import card
from robot_io.policy import artefact as artefacts
from robot_io.policy.artefact import ArtefactError, sha256

SUFFIX = ".mjxtt.zip"
LARGEST = 16 * 2**20  # [bytes] of a packed file; one of the paper's network has 80 kB
CARD, EVALUATION, SUMS = "README.md", "evaluation.json", "SHA256SUMS"
MEMBERS = (CARD, CONFIG, EVALUATION, *(f"artefact/{name}" for name in artefacts.FILES), SUMS)
HEADER = "# mjx-tt pack, format 1\n"  # first line of SUMS, which sha256sum takes for a comment
_RECOPY = "copy the file again from where it was packed"
# What zipfile raises for archives that are damaged or of another kind.
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, LookupError, RuntimeError, ValueError)


class PackError(ExperimentError):
    """A packed file must not be used: the message names file and member, what is wrong, and what to do."""


def pack(policy: str | Path, path: Path, licence: str | None = None) -> str:
    """Writes a run or an artefact as one file; returns its SHA-256.

    Raises RunError for a run that was not exported or not evaluated, or whose artefact is not of its last update;
    ArtefactError for a damaged one; OSError when the disk refuses.
    """
    content = zipped(_members(Path(policy), licence))
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return sha256(content)


def unpack(path: Path, folder: Path) -> card.Rates:
    """Checks a packed file, plays its artefact's golden vectors, and puts its members into ``folder``; its figures.

    Raises PackError for a file in which anything is not as it was packed, FileExistsError for a folder that is not
    empty, OSError when the disk refuses. The folder is whole or absent.
    """
    contents = read(path)
    with placing(folder) as staging:
        for name, content in contents.items():
            (staging / name).parent.mkdir(exist_ok=True)
            (staging / name).write_bytes(content)
        try:
            artefacts.load(staging / "artefact")
            _without_code(Run(staging).config().to_dict(), path)
            figures = card.rates(Run(staging).read_evaluation())
        except (ArtefactError, ConfigError) as error:
            raise PackError(str(error).replace(f"{staging}/", f"{path}: ")) from None
        except (LookupError, TypeError, ValueError) as error:
            raise PackError(f"{path}: {EVALUATION}: no evaluation of this program ({error!r}); update mjx-tt") from None
    return figures


def read(path: Path) -> dict[str, bytes]:
    """Members of a packed file by name, every byte of it checked. Raises PackError, OSError."""
    size = path.stat().st_size
    if size > LARGEST:
        raise PackError(f"{path}: {size:,} bytes, a packed policy has at most {LARGEST:,}")
    raw = path.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            _check_names(path, archive.namelist())
            for info in archive.infolist():
                if info.compress_type != zipfile.ZIP_STORED or info.file_size > LARGEST:
                    given = f"{info.file_size:,} bytes by method {info.compress_type}"
                    raise PackError(f"{path}: {info.filename}: {given}; {_RECOPY}")
            contents = {name: archive.read(name) for name in archive.namelist()}
    except _DAMAGE as error:
        raise PackError(f"{path}: no packed policy, or a damaged one ({error}); {_RECOPY}") from None
    head, *rows = contents[SUMS].decode("ascii", "replace").splitlines(keepends=True)
    if head != HEADER:
        raise PackError(f"{path}: {SUMS}: begins with {head!r}, expected {HEADER!r}; {_RECOPY}, or update mjx-tt")
    stated = {row[66:-1]: row[:64] for row in rows}
    for name in MEMBERS[:-1]:
        if sha256(contents[name]) != stated.get(name):
            raise PackError(f"{path}: {name}: SHA-256 is not the one that {SUMS} states; {_RECOPY}")
    packed = zipped({name: contents[name] for name in MEMBERS[:-1]})
    if packed != raw:
        pairs = enumerate(zip(packed, raw, strict=False))
        place = next((i for i, (wanted, found) in pairs if wanted != found), min(len(packed), len(raw)))
        raise PackError(f"{path}: {_member_at(packed, place)}: byte {place} is not as it was packed; {_RECOPY}")
    return contents


def _without_code(config: dict[str, Any], where: Path) -> None:
    """Raises PackError for a policy whose configuration holds Python, which whoever evaluates it would run."""
    if config.get("definitions"):
        raise PackError(
            f"{where}: its configuration holds Python of its own (the key definitions), which evaluating it would run; "
            "such policies are not packed. Pass on the YAML with its .py file, which people read before they run it"
        )


def zipped(contents: dict[str, bytes]) -> bytes:
    """The file of members in their order, with SUMS as the last; the same members give the same bytes everywhere."""
    sums = HEADER + "".join(f"{sha256(content)}  {name}\n" for name, content in contents.items())
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in {**contents, SUMS: sums.encode()}.items():
            member = zipfile.ZipInfo(name)  # of 1980-01-01, stored
            member.create_system, member.create_version, member.extract_version = 3, 20, 20
            member.external_attr = 0o100644 << 16
            archive.writestr(member, content)
    return file.getvalue()


def _members(policy: Path, licence: str | None) -> dict[str, bytes]:
    place = find_policy(policy)
    artefact = artefacts.load(artefact_of(place))
    provenance = artefact.manifest["provenance"]
    if not isinstance(provenance, dict) or not isinstance(provenance.get("config"), dict):
        raise RunError(f"{artefact.folder}: does not say how it was trained; pack the run that it came from")
    config, evaluation = provenance["config"], provenance.get("evaluation")
    if (place / CONFIG).is_file():
        run = Run(place)
        config = run.config().to_dict()
        evaluation = run.read_evaluation() if run.evaluation.is_file() else None
        newest = max((int(path.stem) for path in run.checkpoints.glob("[0-9]*.npz")), default=provenance.get("update"))
        updates = {newest, provenance.get("update"), (evaluation or {}).get("update", newest)}
        if evaluation is not None and len(updates) > 1:
            raise RunError(
                f"{place}: checkpoint, artefact and evaluation are of different updates ({sorted(map(str, updates))}); "
                f"`mjx-tt evaluate {place}`, then `mjx-tt export {place}`"
            )
    _without_code(config, place)
    if not isinstance(evaluation, dict):
        raise RunError(f"{place}: was not evaluated yet: `mjx-tt evaluate {place}`")
    files = {f"artefact/{file}": (artefact.folder / file).read_bytes() for file in artefacts.FILES}
    return {
        CARD: card.write(artefact, config, evaluation, licence).encode(),
        CONFIG: yaml.safe_dump(config, sort_keys=False).encode(),
        EVALUATION: (json.dumps(evaluation, indent=2) + "\n").encode(),
        **files,
    }


def _check_names(path: Path, names: list[str]) -> None:
    """Raises PackError unless every member is there once and no other."""
    missing, foreign = [n for n in MEMBERS if n not in names], [n for n in names if n not in MEMBERS]
    twice = sorted({n for n in names if names.count(n) > 1})
    complaints = [
        f"{', '.join(map(repr, found))} {said}"
        for found, said in ((foreign, "does not belong in it"), (missing, "missing"), (twice, "there more than once"))
        if found
    ]
    if complaints:
        raise PackError(f"{path}: {'; '.join(complaints)}; {_RECOPY}")


def _member_at(packed: bytes, place: int) -> str:
    """Name of the member in which a byte of a packed file lies."""
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        if place >= archive.start_dir:
            return "table of contents"
        return max((i for i in archive.infolist() if i.header_offset <= place), key=lambda i: i.header_offset).filename
