"""One gain for all frames of a camera whose headers have none: a frame alone determines it to a factor of ten.

The photon noise of a frame is estimated from what the fits of its stars leave (`profiles.pixel_noise`). The gain
belongs to the camera and the unit of its data, not to the frame: the median of the estimates of some is taken for all.
"""

import numpy as np

#: Keywords that distinguish cameras, their ways of being read, and units.
KEYWORDS = ("TELESCOP", "INSTRUME", "DETECTOR", "CAMERA", "READMODE", "GAIN", "BUNIT")
#: Frames of a camera that are measured for its gain: the median of so many is known as well as 0.4 of one estimate.
PILOTS = 12


def pilots(exposures):
    """Of cameras without a gain the frames that determine it: ``{camera: list of exposures}``, at least two each."""
    cameras = {}
    for exposure in exposures:
        if not exposure.gain:
            cameras.setdefault(camera(exposure), []).append(exposure)
    places = {
        key: np.unique(np.linspace(0, len(all_) - 1, PILOTS).round().astype(int)) for key, all_ in cameras.items()
    }
    return {key: [all_[k] for k in places[key]] for key, all_ in cameras.items() if len(all_) > 1}


def camera(exposure):
    """What an exposure has in common with all others of one gain."""
    unit = str(exposure.header.get("BUNIT", "")).lower()
    per_second = "/s" in unit or "s-1" in unit or "s**-1" in unit
    values = [str(exposure.header.get(key, "")).strip() for key in KEYWORDS]
    return (*values, exposure.shape, exposure.exposure_time if per_second else None)


def pooled(photons):
    """Electrons per unit of the data by the variances per unit of light of single frames; None if not determined.

    Parameters
    ----------
    photons : list of float or None
        None where the noise of a frame is known: then there is nothing to find.
    """
    if None in photons:
        return None
    photon = float(np.median(photons))
    return 1 / photon if photon > 0 else None
