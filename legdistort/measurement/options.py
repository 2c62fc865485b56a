"""Options of `legdistort.measure`, checked before a frame is read."""

from dataclasses import dataclass, replace
from numbers import Integral, Real

import numpy as np

from ..exceptions import InputError, some_of
from ..runtime.checks import check_choice
from ..runtime.words import BLENDS, POSITION_ERRORS, PROFILES
from .effective.sources import psf_from

_DETECTOR = ("gain", "read_noise", "saturation")


@dataclass(frozen=True)
class MeasureOptions:
    """How to measure; the fields are arguments of `legdistort.measure`, which explains them.

    Raises
    ------
    InputError
        For a value out of range.
    """

    fwhm: float | None = None
    threshold: float = 5.0
    max_stars: int | None = None
    box: int | None = None
    profile: str = "own"
    blends: str = "together"
    gain: float | None = None
    read_noise: float | None = None
    saturation: float | None = None
    errors: str = "fit"
    psf: object = "auto"

    def __post_init__(self):
        if self.fwhm is not None and not (isinstance(self.fwhm, Real) and 0.5 <= self.fwhm <= 200):
            raise InputError(f"fwhm must be a number between 0.5 and 200 pixels, got {self.fwhm!r}")
        if not (isinstance(self.threshold, Real) and self.threshold >= 2):
            raise InputError(
                f"threshold must be a number of at least 2 (signal-to-noise ratio), got {self.threshold!r}"
            )
        if self.max_stars is not None and not (isinstance(self.max_stars, Integral) and self.max_stars >= 1):
            raise InputError(f"max_stars must be at least 1, and an integer, got {self.max_stars!r}")
        if self.box is not None and not (isinstance(self.box, Integral) and self.box >= 5 and self.box % 2 == 1):
            raise InputError(f"box must be an odd number of pixels, at least 5, got {self.box!r}")
        check_choice(self.errors, POSITION_ERRORS, "errors")
        check_choice(self.profile, PROFILES, "profile")
        check_choice(self.blends, BLENDS, "blends")
        object.__setattr__(self, "psf", psf_from(self.psf))
        if self.profile != "own" and self.psf not in ("auto", "moffat"):
            raise InputError(f"profile={self.profile!r} is one of Moffat profiles: give psf='moffat', or no profile")
        for key in _DETECTOR:
            value = getattr(self, key)
            if value is not None and not (isinstance(value, Real) and 0 < value < np.inf):
                raise InputError(f"{key} must be a positive number, got {value!r}")

    def psf_of(self, name):
        """What the exposure of this name is measured with: "auto", "moffat", "effective" or an `EffectivePSF`."""
        if isinstance(self.psf, dict):
            if name not in self.psf:
                raise InputError(f"psf has no PSF for exposure {name}: it has those of {some_of(list(self.psf), 3)}")
            return self.psf[name]
        if self.psf == "auto" and self.profile != "own":
            return "moffat"
        return self.psf

    @property
    def only_moffat(self):
        """Whether no exposure is measured with an effective PSF."""
        return isinstance(self.psf, str) and self.psf_of(None) == "moffat"

    def with_detector(self, exposure):
        """The exposure with the gain, read noise and saturation that are given here in place of its own."""
        given = {key: value for key in _DETECTOR if (value := getattr(self, key)) is not None}
        return replace(exposure, **given) if given else exposure
