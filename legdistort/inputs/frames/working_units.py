"""Data of which the squares would overflow or vanish in single precision, in a larger or smaller unit."""

from dataclasses import replace

import numpy as np

#: Frames whose highest value is between these are left alone: those of all detectors, and most calibrated ones.
USUAL = 1e-9, 1e12
_PEAK = 5  # power of ten of the highest value of others


def working_unit(values):
    """The power of ten by which values become numbers of the usual size; 1.0 if they are."""
    peak = float(np.nanmax(np.abs(values), initial=0.0))
    if not 0 < peak < np.inf or USUAL[0] < peak < USUAL[1]:
        return 1.0
    return 10.0 ** (_PEAK - int(np.floor(np.log10(peak))))


def in_working_unit(exposure, factor):
    """An exposure with its data, their errors, gain and saturation in a unit that is `factor` times smaller."""
    if factor == 1.0:
        return exposure
    return replace(
        exposure,
        data=(exposure.data.astype(float) * factor).astype(exposure.data.dtype),
        uncertainty=None if exposure.uncertainty is None else exposure.uncertainty.astype(float) * factor,
        gain=exposure.gain and exposure.gain / factor,
        saturation=exposure.saturation and exposure.saturation * factor,
    )


def header_in_working_unit(header, factor):
    """A copy of a header with the ``BUNIT`` of data that were multiplied by `factor`."""
    header = header.copy()
    header["BUNIT"] = f"10**{-round(np.log10(factor))} {header.get('BUNIT', '')}".strip()
    return header
