"""Tracks: what a tracker calls one ball, cleaned and parted into strokes, with a record of everything taken out."""

from mjx_tt.diagnosis.tracks.clean import Entry, Record, clean

__all__ = ["Entry", "Record", "clean"]
