"""Report of a diagnosis: one HTML page and its figures."""

from __future__ import annotations

from mjx_tt.diagnosis.report.page import Play, Rate, write_report

__all__ = ["Play", "Rate", "write_report"]
