"""One gain for all frames of a camera whose headers have none, and what speaks against one that a header has.

A frame alone determines it to a factor of ten.

The photon noise of a frame is estimated from what the fits of its stars leave (`profiles.pixel_noise`). The gain
belongs to the camera and the unit of its data, not to the frame: the median of the estimates of some is taken for all.
"""

import numpy as np

from ..exceptions import AssumptionWarning, some_of, warn
from ..inputs.frames.integrations import integrations
from ..inputs.frames.value_units import value_unit

#: A gain is doubted where the noise seen is so many times what it implies, or what it implies so many times the noise
#: seen: resampling makes noise up to twice too small, and no honest gain is off by a factor of nine.
DOUBTFUL = 3.0
_SKY_SEEN = 5.0  # the level of the sky, in its noise, from which on it has not been taken off
#: Variance of photons over that which the gain implies: the stars of a frame show it to a factor of ten.
_STARS_DOUBT = 16.0
_FEWEST, _BRIGHTEST = 5, 20  # stars whose fits show noise that is far too large

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
    # electrons per value grow with the time of a rate, and with the integrations of a mean
    averaged = integrations(exposure.header).averaged
    values = [str(exposure.header.get(key, "")).strip() for key in KEYWORDS]
    time = None if value_unit(exposure.header).has_time else exposure.exposure_time
    return (*values, exposure.shape, time, averaged)


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


def contradiction(exposure, frame, flux, chi2, photon):
    """How much larger the noise of an exposure is than its gain implies, where that is doubtful; None if it is not.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
    frame : `~legdistort.measurement.detection.Frame`
        With the variance of the sky as seen where there are no stars.
    flux, chi2 : ndarray, shape (n,)
        Of usable stars, the latter per degree of freedom: where most of the noise of a star is that of its photons and
        the fit leaves next to nothing, the gain is too small, whatever the sky.
    photon : callable
        Gives the variance per unit of light that the stars show: asked where the sky has been taken off.

    Returns
    -------
    float or None
        Ratio of standard deviations.
    """
    if not exposure.gain or frame.noise_given:
        return None
    good, variance = frame.good[::4, ::4], frame.variance[::4, ::4]
    if not good.any():
        return None
    seen, sky = float(np.median(variance[good])), frame.sky[::4, ::4][good]
    darkest, level = np.percentile(sky, [10, 50])  # a slope in the sky may be no light
    read_noise = ((exposure.read_noise or 0.0) / exposure.gain) ** 2
    at_level, at_least = (max(float(each), 0.0) / exposure.gain + read_noise for each in (level, darkest))
    if seen > DOUBTFUL**2 * at_level and level > _SKY_SEEN * np.sqrt(seen):
        return float(np.sqrt(seen / at_level))
    if 0 < seen < at_least / DOUBTFUL**2:
        return float(np.sqrt(seen / at_least))
    brightest = np.argsort(-flux)[:_BRIGHTEST]
    left = float(np.median(chi2[brightest])) if len(flux) >= _FEWEST else 1.0
    if 0 < left < 1 / DOUBTFUL**2:
        return float(np.sqrt(left))
    if level > _SKY_SEEN * np.sqrt(seen) or len(flux) < _FEWEST:
        return None
    shown = photon() * exposure.gain
    return float(np.sqrt(shown)) if shown > _STARS_DOUBT else None


def warn_of_contradictions(found, gains):
    """Warn of exposures whose noise contradicts their gain.

    Parameters
    ----------
    found : dict
        ``{name: ratio}`` of `contradiction`.
    gains : dict
        ``{name: electrons per unit of the data}``.
    """
    for large, words in ((True, "large"), (False, "small")):
        names = [name for name, ratio in found.items() if (ratio > 1) is large]
        if names:
            worst = max(names, key=lambda name: abs(np.log(found[name])))
            ratio = found[worst] if large else 1 / found[worst]
            cause = "a setting of the camera, or the sky has been scaled" if large else "or a bias is in the sky"
            warn(
                f"{some_of(names, 3)}: the noise is {ratio:.2g} times too {words} for a gain of {gains[worst]:.3g} "
                f"electrons per unit of the data ({worst}); errors of positions go by it: is it the gain ({cause})? "
                "give gain= (--gain), or mend the header; legdistort show FRAME prints where it comes from",
                AssumptionWarning,
            )
