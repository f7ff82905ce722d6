"""Places that the tests read from."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]  # the repository
MEASURED = ROOT.parent / "shared" / "data"  # measured balls, which are not part of the repository
SCENE = ROOT / "mjx_tt" / "assets" / "scene.xml"
