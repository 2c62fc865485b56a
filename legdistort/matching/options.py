"""Options of `legdistort.match`, checked before there are detections."""

from dataclasses import dataclass

import numpy as np

from ..exceptions import InputError
from ..measurement.crowding import LIMIT, check_isolation
from ..measurement.flags import UNUSABLE


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
    progress: bool = False

    def __post_init__(self):
        if int(self.min_exposures) != self.min_exposures or self.min_exposures < 2:
            raise InputError(f"min_exposures must be an integer of at least 2, got {self.min_exposures!r}")
        if self.tolerance is not None and not 0 < self.tolerance < np.inf:
            raise InputError(f"tolerance must be a positive number of pixels, got {self.tolerance!r}")
        check_isolation(self.isolation)
