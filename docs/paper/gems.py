"""A simulated twin of the N159W data (Bernard et al. 2017, section 5): from images to the four corrections.

Every figure that the paper gives is used: one GSAOI detector (number 2) with its published distortion, 11 exposures
of 60 s, dithers of 5 arcsec rms, FWHM 4.5 px of 20 mas, stars with position errors between 0.002 and 0.14 px. The
paper does not give the dynamic distortion. Here it has degrees 1 to 3, and a residue of degrees 4 to 6 that a fit of
degree 3 cannot follow, both scaled so that the four corrections can leave about what they left there.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

import legdistort as ld
from legdistort.assessment import baselines
from legdistort.assessment.truth import nearest
from legdistort.geometry.gsaoi import gsaoi_static
from legdistort.results import accuracy
from legdistort.simulation import rendering
from legdistort.simulation.gsaoi_night import Night
from legdistort.simulation.pupil import PupilPSF
from legdistort.simulation.truth import Truth

#: Rms over the detector, both axes together, pixels.
DYNAMIC, RESIDUE = 0.62, 0.31
#: Gemini (7.9 m) in Ks at 20 mas a pixel: Strehl ratio 14 %, 75 % of the light in a halo of 0.5 arcsec, a core widened
#: by image motion.
PSF = PupilPSF(strehl=0.14, resolution=2.8, halo_fwhm=25.0, jitter=1.15, elongation=1.0)
N_STARS = 110
#: "It ranges between 0.002 pixels and 0.14 pixels": fainter stars are not used.
FAINTEST = 0.14
SEED = 5


@dataclass(frozen=True, eq=False)
class Twin:
    """What was simulated, measured and matched."""

    night: Night
    truth: Truth
    exposures: list
    matches: ld.Matches
    prior: ld.Prior


def observe(folder, *, residue=True, small=False, seed=SEED):
    """Render the exposures into a folder, read them back, measure and match them."""
    settings = {"dynamic_rms": DYNAMIC, "residue_rms": RESIDUE if residue else 0.0, "psf": PSF, "n_stars": N_STARS}
    if small:
        settings |= {"size": 768, "n_exposures": 6, "dither": 94.0, "n_stars": 70}
    night = replace(Night(), **settings)
    images = ld.simulate_exposures(seed=seed, **settings)
    exposures = ld.read_exposures(images.write(folder))
    detections = ld.measure(exposures)
    usable = (detections["x_err"].value <= FAINTEST) & (detections["y_err"].value <= FAINTEST)
    matches = ld.match(detections[usable], exposures=exposures)
    model = gsaoi_static(night.detector, size=night.size)
    prior = ld.Prior.from_model(model, shape=(night.size,) * 2, direction="detector_to_reference", degree=5)
    return Twin(night, images.truth, exposures, matches, prior)


def correct(twin, *, errors="stated"):
    """The four corrections, ``{name: Solution}``; the method with the stated errors for weights, as in the paper.

    All observations take part: the residue, which no fit of degree 3 can follow, is no gross error.
    """
    solution = ld.solve(twin.matches, prior=twin.prior, errors=errors, clip=None)
    return baselines.compare(twin.matches, solution, prior=twin.prior)


def absolute_error(twin, solution, *, removed):
    """Error b of the reference positions after a common similarity or polynomial, pixels per axis."""
    true = nearest(solution.estimate.positions, twin.truth.positions)
    return accuracy.bias(solution.estimate.positions, true, removed=removed)


def psf_of_width(fwhm):
    """The mean PSF of the twin, its core widened by more or less motion to this FWHM [pix], with the same halo."""

    def moved(jitter):
        return replace(PSF, strehl=None, jitter=jitter, elongation=0.0).with_core(PSF.coherent)

    return moved(brentq(lambda jitter: moved(jitter).over((1, 1), nodes=1).fwhm - fwhm, 0.0, fwhm, xtol=0.01))


def noise_curve(exposure, night, fwhm, fluxes, *, n=100, size=1024, seed=0):
    """Measured error of positions against flux: stars of known position put into a real background, measured again.

    As in section 5.2.2 of the paper: n positions per flux, photon noise added, fitted by the same program.

    Returns
    -------
    error : ndarray, shape (n_fluxes,)
        Per axis, pixels, from the median square (a profile may fall beside a faint star); NaN where fewer than half
        were found.
    """
    rng = np.random.default_rng(seed)
    image = np.asarray(exposure.data[:size, :size], dtype=float)
    places = _empty_places(image, n, rng)
    psf, out = rendering.as_psf(psf_of_width(fwhm), image.shape), np.full(len(fluxes), np.nan)
    for k, flux in enumerate(fluxes):
        xy = places + rng.uniform(-0.5, 0.5, places.shape)
        light = rendering.render(image.shape, xy, np.full(n, flux), psf=psf)
        noisy = image + rng.poisson(light * night.gain) / night.gain
        frame = ld.Exposure(name="injected", data=noisy, gain=night.gain, read_noise=night.read_noise)
        found = ld.measure([frame], threshold=3.0)
        away = np.column_stack([found["x"].value, found["y"].value])[None] - xy[:, None]
        near = np.abs(away).max(axis=2).argmin(axis=1)
        away = away[np.arange(n), near]
        good = np.hypot(*away.T) < 1.5
        if np.count_nonzero(good) > n / 2:
            out[k] = np.sqrt(np.median(np.sum(away[good] ** 2, axis=1)) / (2 * np.log(2)))
    return out


def _empty_places(image, n, rng, apart=28):
    """Places (n, 2) far from each other and from anything bright."""
    sky, high = np.percentile(image, [50, 84])
    bright = np.argwhere(image > sky + 12 * (high - sky))[:, ::-1]
    places = np.empty((0, 2))
    while len(places) < n:
        xy = rng.uniform(20, np.array(image.shape[::-1]) - 20)
        others = np.concatenate([places, bright]) if len(bright) else places
        if not len(others) or np.hypot(*(others - xy).T).min() > apart:
            places = np.vstack([places, xy])
    return places
