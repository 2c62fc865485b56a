"""One image and what is known about it, from its header where that is plausible."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits

from ..exceptions import DamagedError, InputError, some_of
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted
from .exposure_names import check_exposure_name, whole_name
from .frames.cards import as_number
from .frames.undefined_pixels import undefined_pixels

if TYPE_CHECKING:
    from astropy.wcs.wcsapi import BaseHighLevelWCS

    from .frames.statement import FrameStatement

log = logging.getLogger(__name__)

#: What is known of the detector and the time, as far as it is.
_KNOWN = ("saturation", "gain", "read_noise", "exposure_time")

#: Header keywords of what was observed, in order of preference; of filters all that are there count.
OBSERVED = {
    "target": ("OBJECT", "TARGNAME", "TARGPROP"),
    "telescope": ("TELESCOP",),
    "instrument": ("INSTRUME",),
}
_FILTERS = re.compile(r"FILTERS?\d?|FILTNAM\d?|PUPIL|HIERARCH ESO INS FILT\d NAME|ESO INS FILT\d NAME")
_OPEN = re.compile(r"open|clear\w*|none|empty|n/?a|", re.IGNORECASE)

#: What to do about an exposure that has nothing to offer.
LEAVE_OUT = "; leave this exposure out or mend it"


@plain_numbers
@dataclass(frozen=True, eq=False, repr=False)
class Exposure(ShownAsPrinted):
    """One image and what is known about it.

    Attributes
    ----------
    name : str
    data : ndarray of float, shape (ny, nx)
        Integers are converted (float32 up to 16 bits, float64 beyond). A `~astropy.units.Quantity` gives its unit to
        the header (``BUNIT``).
    mask : ndarray of bool, shape (ny, nx)
        True = bad; pixels that are not finite are always masked, and so are those that hold no measurement
        (`legdistort.inputs.frames.undefined_pixels`): areas of one number at the border. None = all good.
    uncertainty : ndarray or None
        Standard deviation of every pixel, in units of the data.
    wcs : `~astropy.wcs.WCS`, gwcs or other WCS of the shared interface (APE 14), or None
        Nominal WCS, celestial and believable (see `legdistort.inputs.sky_wcs.believable_wcs`).
    header : `~astropy.io.fits.Header`
    saturation : float or None
        Pixels at or above it are saturated [ADU].
    gain : float or None
        Electrons per unit of the data.
    read_noise : float or None
        Electrons.
    exposure_time : float or None
        Seconds.
    path : `~pathlib.Path` or None
    has_gwcs : bool
        Whether its file has an extension ``ASDF`` beside it, which may hold a gwcs.
    exposure, detector : str or None
        Of a camera with several detectors: name of the exposure that they share, and id of the one that took this part.
    stated : `~legdistort.inputs.frames.statement.FrameStatement` or None
        What its header states, each value with its source; None for an exposure that was not read.

    Raises
    ------
    InputError
        If the data are not a 2-D image, planes differ in shape, no pixel is good, or the name could not be that of a
        file.

    See Also
    --------
    legdistort.read_exposures : Exposures from files.

    Examples
    --------
    >>> import numpy as np
    >>> import legdistort as ld
    >>> ld.Exposure("night1", np.zeros((100, 120)), gain=2.0, saturation=5e4)
    <Exposure 'night1': 120 x 100 px, 0 masked, saturation 50000, gain 2, no WCS>
    """

    name: str
    data: np.ndarray
    mask: np.ndarray | None = None
    uncertainty: np.ndarray | None = None
    wcs: BaseHighLevelWCS | None = None
    header: fits.Header = field(default_factory=fits.Header)
    saturation: float | None = None
    gain: float | None = None
    read_noise: float | None = None
    exposure_time: float | None = None
    path: Path | None = None
    has_gwcs: bool = False
    exposure: str | None = None
    detector: str | None = None
    stated: FrameStatement | None = None

    def __post_init__(self) -> None:
        check_exposure_name(self.name, self.path)
        unit, header, uncertainty = getattr(self.data, "unit", None), self.header, self.uncertainty
        if unit is not None:
            header = header.copy()
            header["BUNIT"] = unit.to_string()
        if (own := getattr(uncertainty, "unit", None)) is not None:
            if unit is None or not own.is_equivalent(unit):
                raise InputError(
                    f"{self.name}: the uncertainty is in {own}, the data in {unit or 'no unit'}; give one unit"
                )
            uncertainty = uncertainty.to_value(unit)
        data = _as_float(np.asarray(self.data), self.name)
        mask = ~np.isfinite(data)
        if self.mask is not None:
            mask |= self._plane(self.mask, "mask", data.shape).astype(bool)
        if uncertainty is not None:
            uncertainty = self._plane(uncertainty, "uncertainty", data.shape).astype(data.dtype)
            with np.errstate(invalid="ignore"):
                mask |= ~((uncertainty > 0) & np.isfinite(uncertainty))
        if mask.all():
            cause = (
                "is NaN or blank" if not np.isfinite(data).any() else "is hidden by the mask or the uncertainty plane"
            )
            raise DamagedError(f"{self.name}: every pixel {cause}{LEAVE_OUT}")
        undefined, words = undefined_pixels(data, mask)
        if undefined is not None:
            mask |= undefined
            log.info("%s: %s", self.name, words)
            object.__setattr__(self, "stated", self.stated and self.stated.with_doubt(words))
        for key, value in {"data": data, "mask": mask, "uncertainty": uncertainty, "header": header}.items():
            object.__setattr__(self, key, value)

    def _plane(self, plane, what, shape):
        plane = np.asarray(plane)
        if plane.shape != shape:
            raise InputError(f"{self.name}: the {what} has shape {plane.shape}, the image {shape}; they must agree")
        return plane

    @property
    def shape(self) -> tuple[int, int]:
        """Image shape ``(ny, nx)``."""
        return self.data.shape

    def read(self) -> Exposure:
        """The exposure itself: it has its pixels already (see `legdistort.open_exposures`)."""
        return self

    def __repr__(self) -> str:
        ny, nx = self.shape
        words = [f"{nx} x {ny} px", f"{np.count_nonzero(self.mask)} masked"]
        words += [f"{key.replace('_', ' ')} {getattr(self, key):g}" for key in _KNOWN if getattr(self, key) is not None]
        words += ["with uncertainty"] * (self.uncertainty is not None) + ["WCS" if self.wcs is not None else "no WCS"]
        return f"<Exposure {self.name!r}: {', '.join(words)}>"


def observed(exposures):
    """What was observed, in words, as far as headers state it: ``{"target" | "instrument" | "filter" | ...: text}``.

    Parameters
    ----------
    exposures : sequence of Exposure or ExposureFile

    Returns
    -------
    dict
        ``target``, ``telescope``, ``instrument``, ``filter``, ``dates``, ``exposure time``; absent ones are not there.
    """
    headers = [exposure.header for exposure in exposures]
    found = {}
    for what, keywords in OBSERVED.items():
        values = [next((str(h[key]).strip() for key in keywords if str(h.get(key, "")).strip()), "") for h in headers]
        found[what] = _listed(values)
    filters = [[str(h[key]).strip() for key in h if _FILTERS.fullmatch(key) and _is_closed(h[key])] for h in headers]
    found["filter"] = _listed([" + ".join(each) for each in filters])
    dates = sorted(date for h in headers if re.match(r"\d{4}-\d\d-\d\d", date := str(h.get("DATE-OBS", ""))))
    if dates:
        found["dates"] = dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"
    frames = {whole_name(exposure): exposure.exposure_time for exposure in exposures}
    times = [time for time in frames.values() if time]
    if times and len(times) == len(frames):
        same = min(times) == max(times)
        found["exposure time"] = f"{len(times)} x {times[0]:g} s" if same else f"{sum(times):g} s in all"
    return {what: text for what, text in found.items() if text}


def stated_numbers(headers, keywords):
    """What headers state under keywords, ``{keyword: {exposure: number}}``; NaN where one does not, as the log says.

    Parameters
    ----------
    headers : dict
        ``{exposure: `~astropy.io.fits.Header`}``.
    keywords : sequence of str or None

    Raises
    ------
    InputError
        For a keyword that none of them states as a number, with those like it.
    """
    out = {}
    for keyword in keywords or ():
        stated = {name: as_number(header.get(keyword)) for name, header in headers.items()}
        lacking = [name for name, value in stated.items() if value is None]
        if len(lacking) == len(stated):
            near = get_close_matches(keyword.upper(), list(headers[lacking[0]]), cutoff=0.5)
            like = f"; {lacking[0]} has {', '.join(near)}" * bool(near)
            raise InputError(f"no header states {keyword} as a number: correct keywords= (--keywords){like}")
        if lacking:
            log.warning("%s is no number in the headers of %s", keyword, some_of(lacking, 6))
        out[keyword] = {name: np.nan if value is None else value for name, value in stated.items()}
    return out


def _is_closed(value):
    return isinstance(value, str) and not _OPEN.fullmatch(value.strip())


def _listed(values, most=4):
    """Different texts in a line, not more than some."""
    return some_of(list(dict.fromkeys(filter(None, values))), most)


def _as_float(data, name):
    if data.ndim != 2:
        raise InputError(f"{name}: the data have shape {data.shape}, an exposure is one 2-D image")
    if data.dtype.kind in "iub":
        return data.astype(np.float32 if data.dtype.itemsize <= 2 else np.float64)
    if data.dtype.kind != "f":
        raise InputError(f"{name}: the data must be real numbers, got {data.dtype}")
    return data.astype(data.dtype.newbyteorder("="), copy=False)
