"""Numbers of FITS headers, as numbers or as text, and where they stand."""

import re
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits

_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?)(?:\s+(.*)|\s*)", re.DOTALL)
#: Texts that state nothing.
_NOTHING = re.compile(r"[\s?*-]*|n/?a|none|null|nan|undef(ined)?|unknown|not (known|set|available)", re.IGNORECASE)
#: Comments of texts that are labels.
_LABEL = r"\b(number|identifier|id|name|label|index|request)\b"


class Stated(NamedTuple):
    """A value, and the words of the frame that it comes from; None where the frame does not state it."""

    value: Any
    source: str = "not stated"


class Card(NamedTuple):
    """A number of a header, its keyword, and what is said of it: its comment, and the rest of a text."""

    key: str
    value: float
    words: str

    def says(self, pattern):
        """Whether the words have the pattern, in letters of either size."""
        return re.search(pattern, self.words, re.IGNORECASE) is not None


def as_number(value):
    """A value of a header as a float, None for what is no number; of text ``'1.5'``, ``'1.5D3'``, ``'2.0 e-/ADU'``."""
    return _parsed(value)[0]


def _parsed(value):
    if isinstance(value, str):
        found = _NUMBER.fullmatch(value.strip())
        return (float(re.sub("[dD]", "e", found[1])), found[2] or "") if found else (None, "")
    if isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        return float(value), ""
    return None, ""


def is_nothing(value):
    """Whether a value of a header states nothing: undefined, blank, ``'N/A'``."""
    return value is None or isinstance(value, fits.card.Undefined) or (
        isinstance(value, str) and _NOTHING.fullmatch(value.strip()) is not None
    )  # fmt: skip


def positive(header, keywords):
    """The first positive number under one of the keywords as a `Card`, texts only where there is no other; or None."""
    texts = []
    for key in keywords:
        if key not in header:
            continue
        value, words = _parsed(header[key])
        if value is not None and np.isfinite(value) and value > 0:
            card = Card(key.removeprefix("HIERARCH "), value, f"{words} {header.comments[key]}".strip())
            if not isinstance(header[key], str):
                return card
            texts.append(card)  # EXPOSURE = '1' of JWST is no time, but a label
    return next((card for card in texts if not card.says(_LABEL)), None)
