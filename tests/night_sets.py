"""Star lists of several nights that depart from a static distortion as a whole; numpy alone."""

import numpy as np
from astropy.table import Table
from numpy.polynomial.legendre import legval2d

SIZE, DEGREE, STATIC = 1024, 3, 1.5
#: Stars that move and were seen in few nights have far larger errors than others, and would decide alone.
FAR = 5.0
_ORDERS = np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1))


def field(rng, size, degree=DEGREE):
    """Legendre coefficients (2, 4, 4) of a displacement, by default a cubic one, smaller by order."""
    return rng.normal(0, size, (2, *_ORDERS.shape)) * (degree >= _ORDERS) / (1 + _ORDERS)


class Nights:
    """Dithered lists of some nights, the later ones of which are rolled.

    Parameters
    ----------
    seed : int
    nights, per : int
        Nights, and lists in each.
    nightly, single : float
        Size of what the lists of a night have in common, and of what each adds [pix].
    odd : float
        Size of what those of one night have in common in its place.
    odd_ones : tuple of int, optional
        Nights that are odd, each in its own way; the middle one by default.
    roll : float
        Of the last third of the nights, degrees.
    motion : float
        Of the stars, pixels a year; the nights span six years.
    sigma : float
        Of the positions [pix].
    degree : int
        Of all distortions, at most 3.
    alone : bool
        The middle one of the nights, which is the one that may be odd, has one list.
    """

    def __init__(self, seed, *, nights=8, per=5, nightly=0.02, single=0.01, odd=0.0, roll=30.0, motion=0.0, sigma=0.03,
                 n_stars=200, degree=DEGREE, alone=False, odd_ones=None):  # fmt: skip
        rng = np.random.default_rng(seed)
        self.sky = rng.uniform(-120, SIZE + 120, (n_stars, 2))
        self.motion = rng.normal(0, motion, (n_stars, 2))
        self.static, rows = field(rng, STATIC, degree), []
        self.odd, self.common = nights // 2, []
        odd_ones = (self.odd,) if odd_ones is None else odd_ones
        years = np.linspace(2014.4, 2020.6, nights) if nights > 1 else [2014.4]
        for i, year in enumerate(years):
            common = field(rng, odd if odd and i in odd_ones else nightly, degree)
            self.common.append(common)
            for k in range(1 if alone and i == self.odd else per):
                angle = np.radians(rng.normal(0, 0.05) + roll * (i >= nights - max(1, nights // 3)))
                turn = (1 + rng.normal(0, 1e-4)) * np.array([[np.cos(angle), -np.sin(angle)],
                                                            [np.sin(angle), np.cos(angle)]])  # fmt: skip
                moved = self.sky + self.motion * (year - 2017) - SIZE / 2
                q = moved @ turn.T + SIZE / 2 + rng.uniform(-90, 90, 2)
                u = (2 * q + 1) / SIZE - 1
                q = q + legval2d(*u.T, (self.static + common + field(rng, single, degree)).transpose(1, 2, 0)).T
                q = q + rng.normal(0, sigma, q.shape)
                for j in np.flatnonzero(np.all((q > 0) & (q < SIZE - 1), axis=1)):
                    rows.append((f"n{i}e{k}", j, *q[j], sigma, sigma, year + k * 1e-5, i))
        names = ["exposure", "star", "x", "y", "x_err", "y_err", "epoch", "block"]
        self.table = Table(rows=rows, names=names)

    def offsets(self, stars, epoch=2017.0):
        """Errors (n, 2) of the positions of a table of stars, a similarity taken off.

        NaN for those without a position at this epoch, or with an error beyond `FAR` typical ones.
        """
        at = np.asarray(stars["star"], int)
        xy = np.column_stack([np.asarray(getattr(stars[c], "value", stars[c]), float) for c in ("x", "y")])
        truth = self.sky[at] + self.motion[at] * (epoch - 2017)
        x_err = np.asarray(getattr(stars["x_err"], "value", stars["x_err"]))
        known = x_err < FAR * np.nanmedian(x_err)
        if "n_epochs" in stars.colnames:  # the motion of others is not known
            known &= np.asarray(stars["n_epochs"]) > 1
        z, w = ((each[known] - each[known].mean(axis=0)) @ [1, 1j] for each in (truth, xy))
        off = w - z * (z.conj() @ w) / (z.conj() @ z).real
        out = np.full(xy.shape, np.nan)
        out[known] = np.column_stack([off.real, off.imag])
        return out
