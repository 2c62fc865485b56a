"""The cards of a mosaic: what its exposures have in common, their times, and how it was made."""

from importlib.metadata import version

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.time import Time

from ..geometry.epochs import read_date
from ..inputs.exposure_names import whole_name
from ..inputs.frames.integrations import value_time
from ..inputs.frames.value_units import value_unit

#: What is taken from the exposures where all agree.
_COPIED = ("OBJECT", "TELESCOP", "INSTRUME", "FILTER")
#: Where headers have the start of an exposure: as a date, as a day (with a time of day beside it), as a modified Julian
#: date; ESO and Astropy, HST and JWST.
_DATES = ("DATE-BEG", "DATE-OBS")
_CLOCKS = ("TIME-OBS", "UT", "UTC-OBS")
_DAYS = ("MJD-BEG", "MJD-OBS", "EXPSTART")


def mosaic_header(frames, left_out, factors, settings):
    """The header of a mosaic without its WCS.

    Parameters
    ----------
    frames : list of Exposure or ExposureFile
    left_out : dict
        Names of others, with the reason.
    factors : dict
        Flux scales by name.
    settings : list of (str, object, str)
        Further cards; those without a value, or with one that is not finite, are left out.
    """
    header = fits.Header()
    for key in _COPIED:
        values = {str(f.header.get(key, "")) for f in frames}
        if len(values) == 1 and values != {""}:
            header[key] = values.pop()
    first, *others = (value_unit(f.header) for f in frames)
    if first.text and all(first.same_as(other) for other in others):
        header["BUNIT"] = first.text
    times = [f.exposure_time or None for f in frames]
    if None not in times:
        mean = float(np.mean([value_time(f) * factors[f.name] for f in frames]))
        header["EXPTIME"] = (round(mean, 9), "[s] exposure time that the values stand for")
        header["TEXPTIME"] = (
            sum(dict(zip(map(whole_name, frames), times, strict=True)).values()),
            "[s] sum of the exposure times",
        )
    header.extend(_dates(frames, times))
    header["NCOMBINE"] = (len(frames), "number of images combined")
    header["NEXPOSUR"] = (len(set(map(whole_name, frames))), "number of exposures that they are of")
    for key, value, meaning in settings:
        if isinstance(value, str) or (value is not None and np.isfinite(value)):
            header[key] = (value, meaning)
    header["CREATOR"] = f"legdistort {version('legdistort')}"
    header.extend((f"IMCMB{i:03d}", _ascii(frame.name)) for i, frame in enumerate(frames[:999], start=1))
    for name, reason in left_out.items():
        header.add_history(_ascii(f"left out {name}: {reason}"))
    return header


def is_mosaic(header):
    """Whether the header is that of a mosaic, as `mosaic_header` makes it, whatever the version."""
    return str(header.get("CREATOR", "")).startswith("legdistort ") and "NCOMBINE" in header


def exposure_start(header):
    """Start of an exposure by its header, a `~astropy.time.Time` (UTC), or None."""
    for key in _DATES:
        text = header.get(key)
        if isinstance(text, str) and text.strip():
            clock = next((header[c] for c in _CLOCKS if isinstance(header.get(c), str)), None)
            text = text.strip() if "T" in text or clock is None else f"{text.strip()}T{clock.strip()}"
            if ":" not in text:
                continue  # a day alone is no time
            if (start := read_date(text)) is not None:
                return start
    for key in _DAYS:
        if (start := read_date(header.get(key))) is not None:
            return start
    return None


def _dates(frames, times):
    """Start of the first and end of the last exposure, and the mean of their middles; of all or not at all."""
    starts = [exposure_start(f.header) for f in frames]
    if None in starts or None in times:
        return []
    starts = Time([start.isot for start in starts], scale="utc")
    ends = starts + times * u.s
    first, last = starts.min().isot, ends.max().isot
    middle = float(np.mean((starts + times * u.s / 2).mjd))
    return [
        ("DATE-OBS", first, "start of the first exposure"),
        ("DATE-BEG", first, "start of the first exposure"),
        ("DATE-END", last, "end of the last exposure"),
        ("MJD-AVG", middle, "[d] mean of the middles of the exposures"),
        ("TIMESYS", "UTC", "of these"),
    ]


def _ascii(text):
    """As FITS has it; other letters by their numbers."""
    return text.encode("ascii", "backslashreplace").decode()
