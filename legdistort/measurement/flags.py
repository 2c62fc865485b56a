"""Flags of detections."""

from enum import IntFlag

import numpy as np


class Flag(IntFlag):
    """Bits of the column ``flags``."""

    SATURATED = 1  #: a saturated pixel within one FWHM of the centre
    EDGE = 2  #: less than one FWHM from the edge of the image, or beside a gap: a third of its pixels are missing
    HOT = 4  #: much sharper than the stars of the frame, or fixed on the detector: hot pixel or cosmic ray
    NOT_CONVERGED = 8  #: the fit found no position, or one far from the detection
    INSIGNIFICANT = 16  #: the signal-to-noise ratio of the fit is below 3, or below the detection limit
    BLENDED = 32  #: another detection within two FWHM (fitted together with it, or its model was subtracted)
    MASKED = 64  #: bad or outlying pixels within one FWHM of the centre were left out of the fit
    SHARED_SHAPE = 128  #: too faint or disturbed for a shape of its own: fitted with that of the frame
    #: The shape is not what is usual at this place, or a bright star has none: see `is_deformed`.
    #: In a crowd: chi2 of the core above 4.
    DEFORMED = 256
    DEFECT = 512  #: a hot pixel, a bad column or a cosmic ray within one FWHM of the centre was left out of the fit
    VARIABLE = 1024  #: in a catalogue: its fluxes scatter by more than their errors, and two exposures confirm it
    DISPLACED = 2048  #: in a catalogue: more than five errors from where the solution has it
    EXTENDED = (
        4096  #: in a catalogue: wider than the stars of its flux; its light is that of a PSF spread by a Gaussian
    )


#: Flags that make a detection useless as a star position.
UNUSABLE = Flag.SATURATED | Flag.EDGE | Flag.HOT | Flag.NOT_CONVERGED | Flag.INSIGNIFICANT
#: Signal-to-noise ratio of a fit below which no star is significant.
LEAST = 3.0
#: Ratio of the axes of stars from which on they are trailed: aberrations make no more of most.
TRAILED = 2.0
#: Part of the light of a star that persists where it was, at most; defects of one place differ by less.
PERSISTS = 0.1
#: Larger numbers are no flags: the bits of 32.
_LARGEST = 2.0**32 - 1


def flags_of(table):
    """Flags (n,) of the detections of a table with a column ``flags``; a missing flag is none."""
    return np.nan_to_num(np.clip(np.ma.filled(table["flags"], 0), 0, _LARGEST)).astype(int)
