"""Proper motions and parallaxes of the stars of a solution, with their errors."""

from dataclasses import dataclass

import numpy as np
from astropy import units as u

from ..geometry import parallax
from .absolute_errors import without_plain_map

#: Units of the terms of stars in the reference plane and on the sky, and their names there.
UNITS = {"vx": u.pix / u.yr, "vy": u.pix / u.yr, "parallax": u.pix}


@dataclass(frozen=True, eq=False)
class StarMotions:
    """What moves the stars from exposure to exposure.

    Attributes
    ----------
    names : tuple of str
        Of the terms: "vx", "vy" [pix/yr], "parallax" [pix].
    values : ndarray, shape (n_stars, k)
        NaN for what the observations of a star do not determine.
    epoch : float
        Julian year of the positions.
    years : ndarray, shape (n_exposures,)
        When the exposures were taken.
    chi2 : ndarray, shape (n_stars,)
        Of the used observations of every star.
    n_epochs : ndarray of int, shape (n_stars,)
        At which it was used; exposures within a day count as one.
    span : ndarray, shape (n_stars,)
        Between the first and the last of them, years.
    """

    names: tuple
    values: np.ndarray
    epoch: float
    years: np.ndarray
    chi2: np.ndarray
    n_epochs: np.ndarray
    span: np.ndarray

    @property
    def kind(self):
        """Either "proper" or "parallax"."""
        return "parallax" if "parallax" in self.names else "proper"

    def displacement(self, years, sky=None):
        """Displacements (n_stars, 2) [pix] from the epoch to another year; zero for stars without a motion."""
        known = np.nan_to_num(self.values)
        out = (years - self.epoch) * known[:, :2]
        if self.kind == "parallax" and sky is not None:
            out = out + known[:, 2:3] * parallax.on_plane(sky, [years])
        return out

    def __repr__(self):
        n = int(np.isfinite(self.values[:, 0]).sum())
        return f"<StarMotions: {self.kind}, {n} of {len(self.values)} stars, positions of {self.epoch:.3f}>"

    @property
    def sentence(self):
        """What was fitted, in a sentence."""
        what = "proper motions and parallaxes" if self.kind == "parallax" else "proper motions"
        n, once = np.count_nonzero(self.n_epochs > 1), np.count_nonzero(self.n_epochs == 1)
        words = f"{what} of {n} stars over {np.ptp(self.years):.2f} yr; positions are those of {self.epoch:.4f}"
        if once:
            where = "stays where it was" if once == 1 else "stay where they were"
            words += f"; {once} seen at a single epoch {where} then"
        if twice := np.count_nonzero(self.n_epochs == 2):
            words += f"; {twice} seen at two epochs ha{'s' if twice == 1 else 've'} nothing to check the motion by"
        return words


def covariances(gauge, uncertainty, xy):
    """Relative and absolute covariance of the terms of the stars, (k, k, n_stars) each, for positions (n_stars, 2).

    Relative motions are those once a common map of the fitted degree is taken off. Absolute ones have the error of the
    common maps that change with time, after a common rate of shift, rotation and scale and a mean parallax, which
    nothing but a reference determines.
    """
    k = len(gauge.drift.names)
    index = np.add.outer(np.zeros(k, int), np.zeros(k, int))
    for a in range(k):
        for b in range(k):
            low, high = min(a, b) + 2, max(a, b) + 2
            index[a, b] = high * (high + 1) // 2 + low
    own = uncertainty.star_unknowns[index]
    good = np.isfinite(xy[:, 0])
    directions = uncertainty.drift_directions[good, 2:]
    q, n = gauge.drift.motion.shape[2], gauge.n_modes
    hidden = np.zeros((2 * n + q, 2 * n + q))
    tied = gauge.absolute_covariance
    hidden[: 2 * n, : 2 * n] = tied if len(tied) == 2 * n else gauge.covariance
    hidden[2 * n :, 2 * n :] = gauge.drift.covariance
    plain = gauge.modes_at(xy[good]).T
    left = without_plain_map(directions, plain)
    relative, absolute = own.copy(), own.copy()
    for out, through in ((relative, left), (absolute, directions)):
        out[:, :, good] += np.moveaxis(through @ hidden @ through.transpose(0, 2, 1), 0, -1)
    if gauge.drift.shared is not None:
        absolute[:2, :2] += gauge.drift.shared
    return relative, absolute


def add_motions(table, motions, relative, absolute, xy, sky):
    """Add the columns of motions to a table of stars; on the sky, if that is known, named as in the Gaia catalogue.

    Parameters
    ----------
    table : `~astropy.table.QTable`
    motions : StarMotions
    relative, absolute : ndarray, shape (k, k, n_stars)
    xy : ndarray, shape (n_stars, 2)
    sky : TangentPlane or None
    """
    for k, name in enumerate(motions.names[:2]):
        table[name] = motions.values[:, k] * UNITS[name]
        table[f"{name}_err"] = np.sqrt(relative[k, k]) * UNITS[name]
        table[f"{name}_err_abs"] = np.sqrt(absolute[k, k]) * UNITS[name]
    table["vx_vy_corr"] = relative[0, 1] / np.sqrt(relative[0, 0] * relative[1, 1])
    if sky is not None:
        slope = sky.jacobian(np.nan_to_num(xy)) * u.deg.to(u.mas)
        on_sky = np.einsum("jab,jb->ja", slope, motions.values[:, :2]) * u.mas / u.yr
        table["pmra"], table["pmdec"] = on_sky.T
        for suffix, each in (("error", relative), ("error_abs", absolute)):
            moved = np.einsum("jab,bcj,jdc->jad", slope, each[:2, :2], slope)
            for k, name in enumerate(("pmra", "pmdec")):
                table[f"{name}_{suffix}"] = np.sqrt(moved[:, k, k]) * u.mas / u.yr
            if suffix == "error":
                table["pmra_pmdec_corr"] = moved[:, 0, 1] / np.sqrt(moved[:, 0, 0] * moved[:, 1, 1])
    if motions.kind == "parallax":
        mas = sky.pixel_scale * 1000 * u.mas
        table["parallax"] = motions.values[:, 2] * mas
        table["parallax_error"] = np.sqrt(relative[2, 2]) * mas
        table["parallax_error_abs"] = np.sqrt(absolute[2, 2]) * mas
    table["chi2"], table["n_epochs"], table["span"] = motions.chi2, motions.n_epochs, motions.span * u.yr
