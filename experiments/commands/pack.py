"""``mjx-tt pack``: a policy as one file to pass on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from experiments import options
from experiments.options import option
from experiments.runs.locate import run_of

app = options.command(
    "pack",
    "pack a policy into one file: artefact, configuration, evaluation, a card",
    """\
  mjx-tt pack runs/quickstart
  mjx-tt pack runs/quickstart --out anna.mjxtt.zip --licence CC-BY-4.0
""",
)


@app.default
def pack(
    policy: options.PolicyFolder,
    /,
    *,
    out: Annotated[str | None, option("FILE", "default: the run's name with .mjxtt.zip, in the current folder")] = None,
    licence: Annotated[str | None, option("NAME", "for the card, such as CC-BY-4.0")] = None,
) -> None:
    """Writes the file and prints its SHA-256."""
    folder = run_of(policy)
    from experiments.progress import make_console
    from experiments.sharing import packed

    path = Path(out or f"{folder.absolute().name}{packed.SUFFIX}")
    options.check_suffix(path, ".zip")
    options.check_writable(path.parent)
    digest = packed.pack(folder, path, licence)
    make_console().print(f"{path}: {path.stat().st_size:,} bytes, SHA-256 {digest}", soft_wrap=True)
