"""Images of stars behind adaptive optics with their true point-spread function and the smallest possible errors."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from legdistort.simulation import rendering
from legdistort.simulation.gridded_psf import GriddedPSF
from legdistort.simulation.pupil import PupilPSF

SKY, GAIN, READ_NOISE = 200.0, 2.0, 15.0
STREHLS = (0.1, 0.3, 0.6)
#: What is added to a round pupil of 2.8 px resolution in a halo of 25 px.
SHAPES = {"symmetric": {}, "elongated": {"elongation": 1.2}, "coma": {"coma": 0.4}}
#: Order of the polynomial in x and y after which positions are compared: that of the PSF's centre. With coma that grows
#: linearly the centre of the core moves by an odd function of the place: after a linear map 2.5 x the bound of bright
#: stars is left of its true course, after a cubic one 0.1.
ORDERS = {"symmetric": 0, "elongated": 2, "coma": 3, "psfao": 0}


@dataclass(frozen=True, eq=False)
class Frame:
    """One image.

    `data` (ny, nx) ADU; `xy` (n, 2) true positions [pix]; `flux` (n,) ADU; `covariance` (n, 2, 2) bound of the
    positions [pix^2]; `snr` (n,) flux over the bound of its error; `order` of the map after which one compares.
    """

    name: str
    data: np.ndarray
    xy: np.ndarray
    flux: np.ndarray
    covariance: np.ndarray
    snr: np.ndarray
    order: int


def psfao(rng=None, *, shape=800, oversampling=4):
    """A PSF of maoppy (Fetick et al. 2019), with residuals about 20 % different if `rng` is given."""
    from maoppy.instrument import Instrument
    from maoppy.psfmodel import Psfao

    step = 0.02 / 206264.8 / oversampling
    samp = 2.8 * oversampling
    model = Psfao((shape * 2, shape * 2), system=Instrument(D=7.9, occ=0.13, res=step, Nact=17), samp=samp)
    r0, background, variance, alpha, ratio, angle, beta = 0.75, 4e-2, 1.1, 0.12, 1.15, 0.6, 1.6
    if rng is not None:
        r0, variance, ratio = np.array([r0, variance, ratio]) * (1 + 0.1 * np.clip(rng.normal(size=3), -2, 2))
        angle = rng.uniform(0, np.pi)
    otf = model.otf([r0, background, variance, alpha, ratio, angle, beta])
    f = np.fft.fftshift(np.fft.fftfreq(len(otf)))
    wider = np.sinc(oversampling * f) / np.sinc(f)  # from samples to detector pixels
    light = np.fft.fftshift(np.fft.ifft2(np.fft.ifftshift(otf * wider[:, None] * wider)).real)
    return GriddedPSF(light * oversampling**2, oversampling, origin=(shape, shape))


def make_psf(kind, strehl, rng):
    """The PSF of one exposure of a kind of `ORDERS`."""
    if kind == "psfao":
        return psfao(rng)
    return PupilPSF(strehl=strehl, jitter=0.4, **SHAPES[kind]).varied(rng)


def apart(rng, n, size, distance, margin):
    """Random positions (n, 2) at least so far from one another and from the edge [pix]."""
    xy = np.empty((0, 2))
    while len(xy) < n:
        one = rng.uniform(margin, size - 1 - margin, 2)
        if not len(xy) or np.hypot(*(xy - one).T).min() > distance:
            xy = np.vstack([xy, one])
    return xy


def bounds(xy, flux, psf, shape):
    """Covariance (n, 2, 2), signal-to-noise ratios (n,) and the image without noise."""
    expected = rendering.render(shape, xy, flux, psf=psf, sky=SKY)
    covariance, error = rendering.position_covariance(
        xy, flux, expected, psf=psf, gain=GAIN, read_noise=READ_NOISE, half=16
    )
    return covariance, flux / error, expected


def start(kind, strehl, seed, size):
    """The random numbers of a frame, and its PSF, which they begin with."""
    rng = np.random.default_rng([seed, list(ORDERS).index(kind), round(100 * strehl)])
    return rng, rendering.as_psf(make_psf(kind, strehl, rng), (size, size))


def frame(kind, strehl, seed, *, n=60, size=1024, lowest=10.0, highest=1000.0):
    """Isolated stars evenly spread in the logarithm of their signal-to-noise ratio."""
    rng, psf = start(kind, strehl, seed, size)
    xy = apart(rng, n, size, 40, 25)
    wanted = rng.permutation(np.geomspace(lowest, highest, n))
    trial = np.geomspace(100, 1e8, 25)
    middle = np.tile([size / 2 + 0.3, size / 2 - 0.2], (25, 1))
    ratio = [bounds(middle[:1], trial[k : k + 1], psf, (size, size))[1][0] for k in range(25)]
    flux = np.exp(np.interp(np.log(wanted), np.log(ratio), np.log(trial)))
    covariance, snr, expected = bounds(xy, flux, psf, (size, size))
    data = rendering.add_noise(expected, rng, gain=GAIN, read_noise=READ_NOISE).astype(np.float32)
    return Frame(f"{kind}-{strehl:g}-{seed}", data, xy, flux, covariance, snr, ORDERS[kind])


def start_crowded(strehl, seed, size):
    """The random numbers of a crowded frame, and its PSF, which they begin with."""
    rng = np.random.default_rng([seed, 5])
    return rng, rendering.as_psf(make_psf("symmetric", strehl, rng), (size, size))


def crowded_frame(strehl, seed, *, n, size=512):
    """Stars at random places, with a round PSF; evenly spread in the logarithm of the flux."""
    (rng, psf), shape = start_crowded(strehl, seed, size), (size, size)
    xy, flux = rng.uniform(8, size - 9, (n, 2)), 10 ** rng.uniform(3.2, 6, n)
    covariance, snr, expected = bounds(xy, flux, psf, shape)
    data = rendering.add_noise(expected, rng, gain=GAIN, read_noise=READ_NOISE).astype(np.float32)
    return Frame(f"crowd-{strehl:g}-{n}-{seed}", data, xy, flux, covariance, snr, ORDERS["symmetric"])


def fit_true(frame, psf, *, half=16):
    """Positions (n, 2) by one least-squares step from the truth with the true PSF, other stars subtracted."""
    expected = rendering.render(frame.data.shape, frame.xy, frame.flux, psf=psf, sky=SKY)
    out = np.array(frame.xy)
    for k, (xy, flux) in enumerate(zip(frame.xy, frame.flux, strict=True)):
        columns, rows = (np.arange(max(round(c) - half, 0), min(round(c) + half + 1, n))
                         for c, n in zip(xy.tolist(), frame.data.shape[::-1], strict=True))  # fmt: skip
        part = np.ix_(rows, columns)
        moved = [[psf.on_pixels(columns, rows, xy + s * e) for s in (0.01, -0.01)] for e in np.eye(2)]
        slopes = [flux * (there - back) / 0.02 for there, back in moved]
        design = np.array([*slopes, psf.on_pixels(columns, rows, xy), np.ones(expected[part].shape)])
        root = 1 / np.sqrt(expected[part] / GAIN + (READ_NOISE / GAIN) ** 2)
        off = ((frame.data - expected)[part] * root).ravel()
        out[k] += np.linalg.lstsq((design * root).reshape(4, -1).T, off, rcond=None)[0][:2]
    return out


def identify(found, truth, radius):
    """Row of `found` (m, 2) nearest to every true star (n, 2), -1 beyond `radius` or where another star is nearer."""
    distance, star = cKDTree(truth).query(found)
    out, best = np.full(len(truth), -1), np.full(len(truth), radius)
    for row in np.argsort(distance)[::-1]:
        if distance[row] < best[star[row]]:
            out[star[row]], best[star[row]] = row, distance[row]
    return out


def mapped(off, xy, order, size, *covariances):
    """Deviations (n, 2) less their common polynomial of this order, and the covariances (n, 2, 2) of what is left.

    The weights are 1 / (bound^2 + its median): no star decides alone. The first covariance is the bound; all go through
    the same projection, stars being independent.
    """
    bound = np.trace(covariances[0], axis1=1, axis2=2) / 2
    root = 1 / np.sqrt(bound + np.median(bound))
    x, y = (2 * xy / (size - 1) - 1).T
    design = np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
    hat = design @ np.linalg.pinv(root[:, None] * design) * root
    left = np.eye(len(off)) - hat
    return left @ off, *(np.einsum("ij,jab->iab", left**2, c) for c in covariances)
