"""The command line ``mjx-tt``: what it does with its commands' ends and errors."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NoReturn

from cyclopts import CycloptsError

from experiments import interrupts
from experiments.commands import app
from experiments.errors import explained

for _module in ("training", "policies", "balls", "study", "robot", "log", "calibrate", "diagnose", "vision"):
    import_module(f"experiments.commands.{_module}")
COMMANDS = tuple(app[name] for name in app if not name.startswith("-"))
EXTRAS = {
    **{"cv2": "vision", "av": "vision", "viser": "view", "mjviser": "view"},
    **{"pyarrow": "lerobot", "dpkt": "capture", "parsl": "cluster"},
}


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit status: 0 done, 1 failed with a message, 2 not understood, 130 interrupted."""
    try:
        given = sys.argv[1:] if arguments is None else arguments
        function, bound, _ = app.parse_args(given, exit_on_error=False, print_error=False)
        return function(*bound.args, **bound.kwargs) or 0
    except CycloptsError as error:
        print(f"mjx-tt: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        print(str(interruption) or "interrupted", file=sys.stderr)
        return 130
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        print(f"mjx-tt: error: {error.name} is missing: pip install 'mjx-tt[{EXTRAS[error.name]}]'", file=sys.stderr)
        return 1
    except Exception as error:
        if not explained(error):
            raise
        print(f"mjx-tt: error: {error}", file=sys.stderr)
        return 1


def program() -> NoReturn:
    """Entry point of the shell."""
    interrupts.end_process(main())


if __name__ == "__main__":
    program()
