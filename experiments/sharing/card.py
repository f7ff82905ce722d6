"""The card of a policy: what it is, how well it plays and where that was measured, how to run it. Markdown."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError

from experiments.errors import RunError
from experiments.stats import wilson
from robot_io.policy.artefact import Artefact

# Name -> value, lower and upper end of its 95 % interval, count and unit of what it was measured on.
Rates = dict[str, tuple[float, float, float, int, str]]

_METHODS = {"zeroth_order": "Blackbox Gradient Sensing", "first_order": "first-order gradients"}  # optimiser.gradient
_TEMPLATES = Environment(
    loader=PackageLoader("experiments.sharing"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


def write(artefact: Artefact, config: dict[str, Any], evaluation: dict[str, Any], licence: str | None = None) -> str:
    """The card's text. Raises RunError for an artefact or an evaluation that does not say what the card has to."""
    manifest = artefact.manifest
    balls = config["balls"] if isinstance(config["balls"], str) else config["balls"].get("name", "of `config.yaml`")
    try:
        return filled(
            "card.md",
            **manifest,
            config=config,
            balls=balls,
            method=_METHODS[(config.get("optimiser") or {}).get("gradient", "zeroth_order")],
            evaluation=evaluation,
            rates=rates(evaluation),
            percent=_percent,
            digest=artefact.digest,
            licence=licence,
        )
    except (LookupError, TypeError, UndefinedError) as error:
        raise RunError(f"{artefact.folder}: its evaluation or manifest lacks what a card says: {error}") from None


def filled(template: str, **values: Any) -> str:
    """One of this folder's templates with its values. Raises UndefinedError where one is missing."""
    return _TEMPLATES.get_template(template).render(values)


def rates(evaluation: dict[str, Any]) -> Rates:
    """Shares with their intervals, of a simulated evaluation or of one after fine-tuning on a robot."""
    if "after" in evaluation:
        after = evaluation["after"]
        returned = (after["return_rate"], after["return_rate_low"], after["return_rate_high"], after["balls"], "balls")
        return {"returned": returned}
    episodes, bound = evaluation["episodes"], evaluation["reachable"]
    hits = episodes - evaluation["outcomes"]["missed"]
    found: Rates = {
        "returned": (evaluation["return_rate"], evaluation["low"], evaluation["high"], episodes, "balls"),
        "hit": (hits / episodes, *wilson(hits, episodes), episodes, "balls"),
    }
    if bound is not None:
        found["in reach, at least"] = (bound["return_rate"], bound["low"], bound["high"], bound["balls"], "of them")
    return found


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
