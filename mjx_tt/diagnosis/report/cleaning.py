"""Picture of what was taken out of the tracks: from the side and from above, by kind."""

from __future__ import annotations

import matplotlib
from matplotlib.figure import Figure

from mjx_tt.diagnosis.tracks import Record
from mjx_tt.diagnosis.tracks.clean import KINDS, MEANINGS
from mjx_tt.viz.html import FAINT, STYLE, WIDTH

MOST_TRACKS = 150  # drawn behind, spread over the log
COLOURS = matplotlib.colormaps["tab10"]


def taken_out(record: Record) -> Figure:
    """Samples that were taken out, over the tracks they came from."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
        views = figure.subplots(1, 2)
    for ax, (i, j), labels in zip(views, ((1, 2), (1, 0)), (("y [m]", "z [m]"), ("y [m]", "x [m]")), strict=True):
        for t in record.tracks[:: max(len(record.tracks) // MOST_TRACKS, 1)]:
            ax.plot(t.position[i], t.position[j], color=FAINT, lw=0.5, alpha=0.5)
        for kind in KINDS:
            found = [e for e in record.of(kind) if e.samples]
            for k, entry in enumerate(found):
                label = MEANINGS[kind].partition(";")[0] if k == 0 else None
                colour = COLOURS(KINDS.index(kind) % COLOURS.N)
                ax.plot(entry.position[i], entry.position[j], ".", ms=3.5, color=colour, label=label)
        ax.set(xlabel=labels[0], ylabel=labels[1])
    if any(e.samples for e in record.entries):
        figure.legend(*views[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    return figure
