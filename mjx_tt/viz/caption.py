"""Line of text below a picture: which ball it is, what became of it, how fast it was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

BACKGROUND, PLAIN, FAINT = (20, 24, 32), (255, 255, 255), (176, 186, 200)
GOOD, POOR = (122, 222, 142), (255, 160, 122)
HEIGHT = 1 / 13  # of the picture's


@dataclass(frozen=True)
class Caption:
    """Text from the left: ``title``, ``text`` in ``colour`` (RGB, 0 to 255); ``note`` at the right end."""

    title: str
    text: str = ""
    note: str = ""
    colour: tuple[int, int, int] = PLAIN

    def written_on(self, frame: np.ndarray) -> np.ndarray:
        """Copy of a picture (height, width, 3) uint8 with the text over its lowest thirteenth."""
        image = Image.fromarray(frame)
        bar = max(1, round(image.height * HEIGHT))
        top, gap = image.height - bar, 0.45 * bar
        pen = ImageDraw.Draw(image)
        pen.rectangle((0, top, image.width, image.height), fill=BACKGROUND)
        parts = ((self.title, PLAIN), (self.text, self.colour), (self.note, FAINT))
        font = ImageFont.load_default(0.55 * bar)
        widths = [pen.textlength(text, font) for text, _ in parts]
        room = image.width - gap * (1 + sum(bool(text) for text, _ in parts))
        if sum(widths) > room:  # all of it, in a smaller size
            font = ImageFont.load_default(0.55 * bar * room / sum(widths))
            widths = [pen.textlength(text, font) for text, _ in parts]
        x = gap
        for (text, colour), width in zip(parts[:2], widths[:2], strict=True):
            if text:
                pen.text((x, top + bar / 2), text, colour, font, anchor="lm")
                x += width + gap
        pen.text((image.width - gap, top + bar / 2), self.note, FAINT, font, anchor="rm")
        return np.asarray(image)
