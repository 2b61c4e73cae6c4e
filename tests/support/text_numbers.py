"""Numbers of a sentence, so that tests check its figures and not its wording."""

from __future__ import annotations

import re


def find_numbers(text: str) -> list[float]:
    """Return the numbers of a text in its order; a minus counts only where nothing stands before it."""
    return [float(number.replace("−", "-")) for number in re.findall(r"(?<![\w.])[-−]?\d+(?:\.\d+)?", text)]
