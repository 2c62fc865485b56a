"""Options of `legdistort.match`, checked before there are detections."""

from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from ..exceptions import InputError
from ..inputs.start_poses import given_starts
from ..measurement.crowding import LIMIT, check_isolation
from ..measurement.flags import UNUSABLE
from ..runtime.checks import LARGEST


def check_enough(n_exposures, min_exposures, kind="exposures"):
    """Raise `InputError` if there are fewer exposures than every star must be in."""
    if n_exposures < min_exposures:
        raise InputError(
            f"a star must be in {min_exposures} exposures, but there are only {n_exposures} {kind}: "
            f"give min_exposures={n_exposures} (--min-exposures) or less"
        )


@dataclass(frozen=True)
class MatchOptions:
    """How to match; the fields are arguments of `legdistort.match`, which explains them.

    Raises
    ------
    InputError
        For a value out of range.
    """

    min_exposures: int = 4
    columns: dict | None = None
    tolerance: float | None = None
    reject_flags: int = UNUSABLE
    isolation: float | None = LIMIT
    start: Any = None
    keywords: Any = None
    progress: bool = False

    def __post_init__(self):
        least = self.min_exposures
        if not (isinstance(least, Real) and least >= 2 and least % 1 == 0):
            raise InputError(f"min_exposures must be an integer of at least 2, got {least!r}")
        if not isinstance(self.columns, dict | None):
            raise InputError(f"columns must be a dict {{name expected: name in the table}}, got {self.columns!r}")
        if self.tolerance is not None and not (isinstance(self.tolerance, Real) and 0 < self.tolerance < LARGEST):
            raise InputError(f"tolerance must be a positive number of pixels, got {self.tolerance!r}")
        if not isinstance(self.reject_flags, Integral):
            raise InputError(f"reject_flags must be an integer, whose bits are flags, got {self.reject_flags!r}")
        check_isolation(self.isolation)
        keywords = () if self.keywords is None else self.keywords
        keywords = (keywords,) if isinstance(keywords, str) else keywords
        if not (
            isinstance(keywords, list | tuple) and all(isinstance(each, str) and each.strip() for each in keywords)
        ):
            raise InputError(f"keywords must be names of header keywords, got {self.keywords!r}")
        object.__setattr__(self, "keywords", tuple(keywords) or None)
        if self.start is not None:
            object.__setattr__(self, "start", given_starts(self.start))
