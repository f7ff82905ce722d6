"""Report of a session at the robot: rates, rallies and times, as JSON and on the screen."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.progress import print_files
from experiments.sparse_reward import reward_of
from experiments.stats import t_interval, wilson
from robot_io.control.config import RobotConfig
from robot_io.control.episode import EpisodeSummary
from robot_io.control.messages import FaultReport, Status
from robot_io.control.rally import RallySummary
from robot_io.policy import artefact as artefacts


@dataclass
class PlayedSession:
    """Balls and rallies of a session, and the faults after which the rig was brought back."""

    episodes: list[EpisodeSummary] = field(default_factory=list)
    rallies: list[RallySummary] = field(default_factory=list)
    faults: list[FaultReport] = field(default_factory=list)

    def discard(self, number: int) -> None:
        """Mark the episode of that number as discarded; one whose outcome is open says so itself."""
        self.episodes = [replace(e, discarded=True) if e.number == number else e for e in self.episodes]

    @property
    def counted(self) -> list[RallySummary]:
        """Rallies that are not filtered out."""
        return [rally for rally in self.rallies if not rally.filtered]


def summary(
    loaded: artefacts.Artefact,
    config: RobotConfig,
    played: PlayedSession,
    status: Status | None,
    timings: dict[str, Any],
    log_file: Path | None,
) -> dict[str, Any]:
    """Everything that a session's JSON holds."""
    episodes = [episode for episode in played.episodes if not episode.discarded]
    returned = sum(e.outcome == "returned" for e in episodes)
    hit = sum(e.outcome != "missed" for e in episodes)
    report: dict[str, Any] = {
        "artefact": str(loaded.folder),
        "artefact_sha256": loaded.digest,
        "robot": config.name,
        "episodes": len(episodes),
        "discarded": len(played.episodes) - len(episodes),
        "returned": returned,
        "hit": hit,
        "selection_reward": reward_of(episodes),
    }
    if episodes:
        low, high = wilson(returned, len(episodes))
        report |= {"return_rate": returned / len(episodes), "low": low, "high": high, "hit_rate": hit / len(episodes)}
    if played.rallies:
        report["rallies"] = rally_report(played.counted) | {
            "filtered": len(played.rallies) - len(played.counted),
            "list": [asdict(rally) for rally in played.rallies],
        }
    evaluation = (loaded.manifest.get("provenance") or {}).get("evaluation")
    if evaluation and "return_rate" in evaluation:  # a fine-tuned policy was evaluated on the robot
        report["simulation"] = {k: evaluation[k] for k in ("return_rate", "low", "high", "episodes")}
        report["simulation"]["balls"] = evaluation["balls"]["name"]
    report["timings"] = timings or (status.timings if status else {})
    report["egm"] = status.egm if status else {}
    report |= {k: getattr(status, k, None) for k in ("axes_cycles", "axes_late", "tracker_counts", "log_dropped")}
    if not config.axes:  # nothing to exchange with
        report |= {"axes_cycles": None, "axes_late": None}
    report["log"] = None if log_file is None else str(log_file)
    return report


def rally_report(rallies: list[RallySummary]) -> dict[str, Any]:
    """Mean length with its 95 % interval by Student's t, the longest, and the ends by the paper's table."""
    if not rallies:
        return {"count": 0}
    lengths = np.array([rally.length for rally in rallies], float)
    mean, low, high = t_interval(lengths) if len(rallies) > 1 else (float(lengths[0]),) * 3
    return {
        "count": len(rallies),
        "mean": mean,
        "low": low,
        "high": high,
        "longest": int(lengths.max()),
        "ends": dict(Counter(rally.end for rally in rallies).most_common()),
    }


def show(console: Console, report: dict[str, Any], path: Path) -> None:
    """Print a session's summary and where its files are."""
    table = Table(title=f"{report['artefact']} on {report['robot']}", title_justify="left", show_header=False)
    if report["episodes"]:
        text = f"{report['return_rate']:.1%}  ({report['returned']} of {report['episodes']}, 95 % interval "
        table.add_row("return rate", text + f"{report['low']:.1%} to {report['high']:.1%})", style="bold")
    if report.get("rallies", {}).get("count"):
        r = report["rallies"]
        text = f"{r['mean']:.1f} touches ({r['count']} rallies, 95 % interval {r['low']:.1f} to {r['high']:.1f}), "
        table.add_row("rallies", f"{text}longest {r['longest']}", style="bold")
        table.add_row("ended by", ", ".join(f"{name.lower().replace('_', ' ')} {n}" for name, n in r["ends"].items()))
    if "simulation" in report:
        s = report["simulation"]
        table.add_row(
            "in simulation",
            f"{s['return_rate']:.1%}  ({s['episodes']:,} balls of {s['balls']}, {s['low']:.1%} to {s['high']:.1%})",
        )
    for name, t in report["timings"].items():
        if isinstance(t, dict):
            table.add_row(
                f"{name}, ms",
                f"p50 {t['p50_ms']:.3f}   p99 {t['p99_ms']:.3f}   p99.9 {t['p99.9_ms']:.3f}   max {t['max_ms']:.3f}",
            )
    if report["faults"]:
        table.add_row("faults, reset", ", ".join(fault["cause"] for fault in report["faults"]))
    table.add_row("ticks missed", str(report["timings"].get("missed_ticks", 0)))
    if report["egm"]:
        egm = report["egm"]
        table.add_row("EGM", f"{egm['accepted']:,} packets, {egm['replies']:,} answers, {egm['lost']:,} lost")
    if report["axes_cycles"] is not None:
        table.add_row("linear axes", f"{report['axes_cycles']:,} exchanges, {report['axes_late']:,} late")
    console.print(table)
    layout = report.get("layout") or resources.files("robot_io.log") / "layout.json"
    viewers = f"Foxglove or Lichtblick, with the layout {layout}" if report["log"] else None
    print_files(console, {"summary": path, "log": report["log"], "to see it": viewers})
