"""Several pictures in one PNG, to be looked at together."""

import os
import textwrap
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from jaxvol import jobs
from jaxvol.image import tone_map


def write_beside(path: str | os.PathLike, pictures: Sequence[np.ndarray], titles: Sequence[str], *, exposure: float) -> None:
    """Pictures `[H, W, 3]` of one height side by side in one PNG, each under its title, with one exposure; atomically."""
    space, line = 4, 14
    width = sum(np.shape(picture)[1] for picture in pictures) + space * (len(pictures) - 1)
    height = np.shape(pictures[0])[0]
    titles = [_wrapped(title, np.shape(picture)[1]) for title, picture in zip(titles, pictures, strict=True)]
    top = line * max(title.count("\n") + 1 for title in titles) + space
    sheet = Image.new("RGB", (width, height + top), "white")
    left = 0
    for picture, title in zip(pictures, titles, strict=True):
        sheet.paste(Image.fromarray(tone_map(np.asarray(picture), exposure=exposure)), (left, top))
        ImageDraw.Draw(sheet).multiline_text((left, 1), title, fill="black", spacing=2)
        left += np.shape(picture)[1] + space
    with jobs.atomic_write(path) as temporary:
        sheet.save(temporary, format="PNG")


def _wrapped(title: str, width: int) -> str:
    """Lines of Pillow's default font, some 6 pixels a letter, that fit above a picture."""
    return "\n".join(textwrap.wrap(title.replace("+", " + "), max(width // 6, 8)))
