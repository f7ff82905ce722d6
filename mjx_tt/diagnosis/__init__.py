"""Measured against simulated: what the model gets wrong, why, how sure that is, and what to measure next."""

from __future__ import annotations

from mjx_tt.diagnosis.diagnose import Diagnosis, diagnose
from mjx_tt.diagnosis.logs import Logs, hashes, load_logs, longest
from mjx_tt.diagnosis.tracks.frame import align
from mjx_tt.diagnosis.verdict import Verdict

__all__ = ["Diagnosis", "Logs", "Verdict", "align", "diagnose", "hashes", "load_logs", "longest"]
