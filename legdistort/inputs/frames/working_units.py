"""The unit in which work is done: squares of 1e-21 or 1e16 have no place in single precision, nor have fixed limits.

Stars are measured in the unit of the noise, so that a frame is the same in any unit. Mosaics, whose unit is
written, come in powers of ten of that of the frames, and only where they must.
"""

from dataclasses import replace

import numpy as np

#: Frames whose highest value is between these are left alone: those of all detectors, and most calibrated ones.
USUAL = 1e-9, 1e12
_SAMPLE = 20_000  # pixels that show the noise of a frame
_PEAK = 5  # power of ten of the highest value of others


def working_unit(values):
    """The power of ten by which values become numbers of the usual size; 1.0 if they are."""
    peak = float(np.nanmax(np.abs(values), initial=0.0))
    if not 0 < peak < np.inf or USUAL[0] < peak < USUAL[1]:
        return 1.0
    return 10.0 ** (_PEAK - int(np.floor(np.log10(peak))))


def noise_unit(exposure):
    """The factor by which the values of an exposure have a scatter of about 1.

    Parameters
    ----------
    exposure : Exposure
        Of its good pixels some thousand serve, half of which lie within the scatter about their median.

    Returns
    -------
    float
        1.0 where all pixels have the same value.
    """
    values = exposure.data[~exposure.mask] if exposure.mask.any() else exposure.data.ravel()
    values = values[:: max(1, values.size // _SAMPLE)].astype(float)
    off = np.abs(values - np.median(values))
    scatter = np.median(off) or np.mean(off)  # more than half may be alike
    if not 0 < scatter < np.inf:
        return 1.0
    return float(1 / scatter)


def in_working_unit(exposure, factor):
    """An exposure with its data, their errors, gain and saturation in a unit that is `factor` times smaller."""
    if factor == 1.0:
        return exposure
    return replace(
        exposure,
        data=_times(exposure.data, factor),
        uncertainty=None if exposure.uncertainty is None else _times(exposure.uncertainty, factor),
        gain=exposure.gain and exposure.gain / factor,
        saturation=exposure.saturation and exposure.saturation * factor,
    )


def _times(values, factor):
    """In the type of the values, by way of double precision: a factor may be out of the range of the type."""
    with np.errstate(over="ignore"):  # of what a frame is filled with
        return np.multiply(values, factor, dtype=float).astype(values.dtype)


def header_in_working_unit(header, factor):
    """A copy of a header with the ``BUNIT`` of data that were multiplied by `factor`."""
    header = header.copy()
    header["BUNIT"] = f"10**{-round(np.log10(factor))} {header.get('BUNIT', '')}".strip()
    return header
