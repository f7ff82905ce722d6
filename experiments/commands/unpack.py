"""``mjx-tt unpack``: a packed policy, checked, as a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options
from experiments.options import option

app = options.command(
    "unpack",
    "check a packed policy and unpack it into a folder",
    """\
  mjx-tt unpack quickstart.mjxtt.zip
  mjx-tt unpack quickstart.mjxtt.zip --out runs/anna
  mjx-tt view runs/anna
""",
)


@app.default
def unpack(
    file: Annotated[str, Parameter("FILE", help="a packed policy")],
    /,
    *,
    out: Annotated[str | None, option("FOLDER", "default: the file's name, in the current folder")] = None,
) -> None:
    """Checks every byte before anything is written."""
    options.check_exists(file)
    from experiments.progress import make_console
    from experiments.sharing import packed

    path = Path(file)
    folder = Path(out or path.name.removesuffix(".zip").removesuffix(".mjxtt"))
    value, low, high, count, _ = packed.unpack(path, folder)["returned"]
    returned = f"{value:.1%} of {count:,} balls returned (95 % interval {low:.1%} to {high:.1%})"
    make_console().print(f"{folder}: {returned}; {folder}/README.md says where", soft_wrap=True)
