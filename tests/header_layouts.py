"""Star lists of four detectors whose headers have the layout wrong: numpy, and headers written by astropy alone."""

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from astropy.wcs import WCS

from legdistort.inputs.exposures import Exposure

SIZE, GAP, ARCSEC = 512, 28, 0.1
STEP = SIZE + GAP
KEYS = "1", "2", "3", "4"
#: Corners of the detectors in the focal plane [pix].
CORNERS = np.array([[0, 0], [STEP, 0], [STEP, STEP], [0, STEP]], dtype=float)
MIDDLE = (SIZE + STEP - 1) / 2


class Night:
    """Dithered exposures; detectors lie as `places` has it, (4, 2, 3) focal plane -> pixels, headers say otherwise.

    Parameters
    ----------
    seed : int
    off, turn : float
        Standard deviations of what headers have wrong of the place [pix] and of the rotation [degrees] of detectors.
    dither : float
        Largest dither along an axis [pix].
    odd : tuple of float
        What the headers of detector 3 have wrong beside that: x, y [pix] and rotation [degrees].
    rolls : sequence of float
        Position angles of the exposures one after the other, degrees.
    sigma : float
        Of the positions [pix].
    static : float
        Distortion of the focal plane that all exposures share, as `size` of those that each has [pix].
    own : float
        Distortions that each detector has of its own in all exposures, as `size` [pix].
    """

    def __init__(self, seed, *, off=2.5, turn=0.0, dither=80.0, n=9, n_stars=450, rolls=(0.0,), sigma=0.01, size=0.3,
                 odd=(0.0, 0.0, 0.0), static=0.0, own=0.0):  # fmt: skip
        rng = np.random.default_rng(seed)
        self.sky = rng.uniform(-60, 2 * MIDDLE + 60, (n_stars, 2))
        flux = 10 ** rng.uniform(3.5, 5.5, n_stars)
        self.wrong = rng.normal(0, off, (4, 2)), rng.normal(0, turn, 4)
        self.wrong[0][2] += odd[:2]
        self.wrong[1][2] += odd[2]
        self.places = np.array([_place(corner, np.zeros(2), 0.0) for corner in CORNERS])
        self.stated = np.array([_place(c, *w) for c, *w in zip(CORNERS, *self.wrong, strict=True)])
        common = np.random.default_rng((seed, 1)).normal(0, static / 2, (10, 2))
        alone = np.random.default_rng((seed, 2)).normal(0, own / 2, (4, 10, 2))
        rows, self.exposures, self.focal, self.flux = [], [], [], flux
        for i in range(n):
            shift, angle = rng.uniform(-dither, dither, 2) * (i > 0), np.radians(rolls[i % len(rolls)])
            roll = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            f = (self.sky - MIDDLE) @ roll.T + MIDDLE + shift
            t = f / MIDDLE - 1
            f = f + _powers(t) @ (common + rng.normal(0, size / 2, (10, 2)))
            self.focal.append(f)
            pointing = rng.normal(0, 3, 2)  # of the header
            for key, place, stated, modes in zip(KEYS, self.places, self.stated, alone, strict=True):
                xy = f @ place[:, :2].T + place[:, 2]
                xy = xy + _powers(np.clip(2 * xy / SIZE - 1, -1.2, 1.2)) @ modes + rng.normal(0, sigma, f.shape)
                for j in np.flatnonzero(np.all((xy > 0) & (xy < SIZE - 1), axis=1)):
                    rows.append((f"e{i}", key, *xy[j], sigma, sigma, flux[j], j))
                header = _header(key, i, stated, roll, shift + pointing)
                self.exposures.append(
                    Exposure(f"e{i}-{key}", np.broadcast_to(np.float32(0), (SIZE, SIZE)), wcs=WCS(header),
                             header=header, exposure=f"e{i}", detector=key)
                )  # fmt: skip
        names = ["exposure", "detector", "x", "y", "x_err", "y_err", "flux", "true"]
        self.table = Table(rows=rows, names=names)

    def write(self, folder, seed=0):
        """Frames of it, an extension a detector: Moffat stars (beta 2.5, FWHM 2.6 px), sky 100, read noise 5."""
        rng, width = np.random.default_rng(seed), 1.3 / np.sqrt(2**0.4 - 1)
        y, x = np.mgrid[:SIZE, :SIZE]
        for i, f in enumerate(self.focal):
            images = [fits.PrimaryHDU(header=_when(i))]
            for each in self.exposures[4 * i : 4 * i + 4]:
                place, light = self.places[KEYS.index(each.detector)], np.full((SIZE, SIZE), 100.0)
                for (a, b), flux in zip(f @ place[:, :2].T + place[:, 2], self.flux, strict=True):
                    if -20 < a < SIZE + 20 and -20 < b < SIZE + 20:
                        box = np.s_[max(0, int(b) - 20) : int(b) + 22, max(0, int(a) - 20) : int(a) + 22]
                        r2 = (x[box] - a) ** 2 + (y[box] - b) ** 2
                        light[box] += 1.5 * flux / (np.pi * width**2) * (1 + r2 / width**2) ** -2.5
                image = rng.normal(rng.poisson(light), 5.0).astype(np.float32)
                known = {
                    "EXTNAME": "SCI",
                    "EXTVER": int(each.detector),
                    "GAIN": 1.0,
                    "RDNOISE": 5.0,
                    "BUNIT": "electron",
                }
                images.append(fits.ImageHDU(image, each.header + fits.Header(known).cards))
            fits.HDUList(images).writeto(folder / f"e{i}.fits")

    def true_stars(self, solution):
        """Number of the true star (n,) of each star of a solution of its frames, by the place on the detectors."""
        out, residuals = {}, solution.residuals
        apart = "x_detector" not in residuals.colnames  # exposures of single detectors
        x, y = ("x", "y") if apart else ("x_detector", "y_detector")
        for i, f in enumerate(self.focal):
            for key, place in zip(KEYS, self.places, strict=True):
                name = f"e{i}-{key}" if apart else f"e{i}"
                rows = residuals[(residuals["exposure"] == name) & (residuals["detector"] == key)]
                xy = np.stack([rows[x].value, rows[y].value], axis=1)
                nearest = np.argmin(np.hypot(*(xy[:, None] - (f @ place[:, :2].T + place[:, 2])).T), axis=0)
                out.update(zip(np.asarray(rows["star"]), nearest, strict=True))
        return np.array([out[star] for star in solution.stars["star"]])

    def crossing(self, least=4):
        """True stars that several detectors see, in `least` exposures or more."""
        star, detector = np.asarray(self.table["true"]), np.asarray(self.table["detector"])
        counts = np.bincount(star)
        return {int(s) for s in np.flatnonzero(counts >= least) if len(set(detector[star == s])) > 1}

    def found(self, matches):
        """Those of them that are one star of the matches; `AssertionError` where two stars became one."""
        star, true = np.asarray(matches.table["star"]), np.asarray(matches.table["true"])
        detector, out = np.asarray(matches.table["detector"]), set()
        for number in np.unique(star):
            mine = star == number
            assert len(set(true[mine])) == 1
            if len(set(detector[mine])) > 1:
                out.add(int(true[mine][0]))
        return out

    def pulls(self, solution, degree=3, groups=None):
        """Squared pull of relative positions, a common map of the degree taken off, of each of some groups of stars."""
        stars, true = solution.stars, self.sky[self.true_stars(solution)]
        xy, errors = (
            np.stack([stars[name].value for name in names], axis=1) for names in (("x", "y"), ("x_err", "y_err"))
        )
        found = []
        for group in [np.ones(len(xy), bool)] if groups is None else groups:
            left = (xy[group] - _mapped(true[group], xy[group], errors[group], degree)) / errors[group]
            found.append(np.mean(left**2) * len(left) / (len(left) - (degree + 1) * (degree + 2) / 2))
        return found

    def layout_pull(self, camera):
        """Squared pull of where the middles of the detectors lie, after the affine map that they have in common."""
        there = CORNERS + (SIZE - 1) / 2
        places = [camera[key].place for key in KEYS]
        xy, errors = np.array([(p.x, p.y) for p in places]), np.array([p.errors[:2] for p in places])
        left = xy - _mapped(there, xy, errors, 1)
        return np.mean((left / errors) ** 2) * 4  # an affine map takes three of four


def _mapped(source, target, errors, degree):
    """Where the polynomial of a degree that fits best carries the source."""
    u, v = (source / MIDDLE - 1).T
    powers = np.stack([u**a * v**b for a in range(degree + 1) for b in range(degree + 1 - a)], axis=1)
    out = [
        powers @ np.linalg.lstsq(powers / e[:, None], t / e, rcond=None)[0]
        for t, e in zip(target.T, errors.T, strict=True)
    ]
    return np.stack(out, axis=1)


def _powers(t):
    """x^a y^b up to degree 3 (n, 10) of positions (n, 2)."""
    return np.stack([t[:, 0] ** a * t[:, 1] ** b for a in range(4) for b in range(4 - a)], axis=1)


def _place(corner, moved, degrees):
    """Focal plane -> pixels of a detector whose middle is `moved` and which is turned."""
    angle, middle = np.radians(degrees), np.full(2, (SIZE - 1) / 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([turn, middle - turn @ (corner + middle + moved)])


def _when(i):
    """Header with the instrument and the time of exposure i."""
    time = Time(60000 + i / 128, format="mjd")
    return fits.Header({"INSTRUME": "FOUR", "DATE-OBS": time.isot, "MJD-OBS": time.mjd})


def _header(key, i, place, roll, shift):
    """Of a detector that lies at `place` of an exposure that is turned and shifted."""
    header = _when(i)
    header["DETECTOR"] = key
    header["CTYPE1"], header["CTYPE2"], header["CRVAL1"], header["CRVAL2"] = "RA---TAN", "DEC--TAN", 150.0, -20.0
    pixel = place[:, :2] @ (MIDDLE + shift) + place[:, 2]
    header["CRPIX1"], header["CRPIX2"] = pixel + 1
    cd = np.diag([-ARCSEC, ARCSEC]) / 3600 @ np.linalg.inv(place[:, :2] @ roll)
    for a in (0, 1):
        for b in (0, 1):
            header[f"CD{a + 1}_{b + 1}"] = cd[a, b]
    return header
