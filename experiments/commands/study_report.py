"""``mjx-tt study-report``: a study as one HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from experiments import options

app = options.command(
    "study-report",
    "write the report of a study, finished or not, as one HTML page",
    """\
  mjx-tt study-report runs/study_quick

Writes report/index.html with its pictures and tables: the paper's figures with ours beside them. What a study lacks is
named.
""",
)


@app.default
def write_report(folder: Annotated[str, Parameter("FOLDER", help="folder of a study")], /) -> None:
    """Prints where it is."""
    options.check_exists(folder)
    options.start_jax(1)
    from experiments.progress import make_console
    from experiments.study.report import page

    make_console().print(page.write(Path(folder)), soft_wrap=True)
