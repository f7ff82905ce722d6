"""``mjx-tt schema``: the keys of an experiment's YAML, for an editor."""

from __future__ import annotations

import json

from experiments import options

app = options.command(
    "schema",
    "print the JSON schema of an experiment YAML, for your editor",
    """\
  mjx-tt schema > schema.json
and as the first line of a YAML:
  # yaml-language-server: $schema=schema.json
""",
)


@app.default
def print_schema() -> None:
    """Prints it."""
    from experiments.config import experiment as config

    print(json.dumps(config.json_schema(), indent=2))
