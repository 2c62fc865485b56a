"""A camera that remembers: its static distortion from many nights, at a date, with its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property, partial
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import asdf
import numpy as np
from astropy import units as u
from astropy.table import QTable

from ...cameras import storage as camera_files
from ...cameras.camera import Camera
from ...cameras.detector import Detector
from ...cameras.stated_errors import FREE, UNKNOWN
from ...exceptions import AssumptionWarning, InputError, some_of, warn
from ...geometry import basis, epochs
from ...inputs.table_files import records
from ...plots.memory_plots import plot_memory
from ...priors.mode_tables import mode_table
from ...priors.prior import Prior
from ...priors.storage import FURTHER_NIGHT, ONE_NIGHT
from ...results.solution import Solution
from ...runtime import asdf_files, provenance
from ...runtime.guards.units import plain_numbers
from ...runtime.notebook import ShownAsPrinted
from ...runtime.outputs import replacing
from ...runtime.parallel import map_items
from ...runtime.trees import codec
from ...runtime.trees.facts import SIZE, array, number
from ..known_maps import DETERMINED, KEPT, MEAN_SQUARE, chance
from .camera_changes import common_maps_in_lines, modes_of
from .combined_nights import Chain, contradiction, fitted, own_scatter2
from .night_data import EXACT, Night, check_nights, check_numbers, dates_of, given_by, nights_of, standard_numbers

if TYPE_CHECKING:
    from astropy.time import Time
    from matplotlib.figure import Figure

    from ...runtime.annotations import StrPath

#: Version of the layout under ``legdistort_nights``, and that entry of a file.
LAYOUT, ROOT = 1, "legdistort_nights"
#: Chance below which one of all nights is odd.
ALARM = 0.003
_UNNAMED = "camera"
_WEAK = 10  # errors of a combination in those of most, from which it is told apart


@dataclass(frozen=True, eq=False, repr=False)
class CombinedNights(ShownAsPrinted):
    """The static distortion of a camera from many nights, made by `legdistort.combine_nights`.

    Of several detectors (`has_focal_plane`) S are changes of the modes of all of them, of orders 0 and 1 the layout,
    from the camera of the first night; maps of the focal plane that all detectors share are no part of it.

    Night n sees ``S(t_n) + B_n``. S is constant; where the nights show that it changes, it has a rate and a random walk
    in time, or depends linearly on a number of the exposures, the covariate. B_n is what the exposures of a night have
    in common beside it.

    Attributes
    ----------
    nights : tuple of Night
        By date.
    shape : tuple
        ``(ny, nx)`` of the detector, or of the focal plane.
    name : str
        Of the camera.
    scatter : ndarray, shape (degree,)
        Of B by degree, pixels a normalised coefficient; zero where a single night does not tell it. Of several
        detectors from degree 0 on, (degree + 1,).
    oddness : ndarray, shape (n_nights,)
        Factors >= 1 on it, as for Student's t distribution: odd nights count less.
    rate, walk : float
        Sizes of the change of a coefficient, pixels a year, and pixels in the square root of a year; 0: none seen.
    covariate : str or None
        Name of the number.
    slope : float
        Size of the change of a coefficient with it, pixels a unit; 0: none seen.
    evidence : float
        By how much a dependence on it makes twice the logarithm of the likelihood larger.

    See Also
    --------
    legdistort.combine_nights : Makes it.

    Examples
    --------
    >>> import legdistort as ld
    >>> seen = ld.simulate_matches(degree=2, n_exposures=6, rotations=[0, 90] * 3, dither=300.0, sigma=0.02)
    >>> night = ld.solve(seen.matches, degree=2)
    >>> ld.combine_nights([night], name="NIRC2")
    <CombinedNights: NIRC2, degree 2, 1 nights, 0 odd>
    """

    nights: tuple[Night, ...]
    _: KW_ONLY
    shape: tuple[int, int] = field(metadata=SIZE)
    name: str
    scatter: np.ndarray = field(metadata=array("n_degrees", unit="pix", minimum=0))
    oddness: np.ndarray = field(metadata=array("n_nights", minimum=1))
    rate: float = field(default=0.0, metadata=number(minimum=0))
    walk: float = field(default=0.0, metadata=number(minimum=0))
    covariate: str | None = None
    slope: float = field(default=0.0, metadata=number(minimum=0))
    evidence: float = 0.0

    @property
    def degree(self) -> int:
        """Total degree of the distortion."""
        return self.nights[0].degree

    @property
    def has_focal_plane(self) -> bool:
        """Whether the camera has several detectors, in a focal plane."""
        return self.nights[0].camera is not None

    def _year(self, date):
        return float(self.dates.max() if date is None else epochs.year(date))

    @cached_property
    def _standard(self):
        """Mean and unit of the covariate, and what nights have in it, (n_nights,)."""
        return (0.0, 1.0, None) if self.covariate is None else standard_numbers(self.nights)

    def _number(self, value):
        """A value of the covariate in its unit from the mean, which is None too."""
        if value is None:
            return 0.0
        if self.covariate is None:
            raise InputError(
                f"value {value!r} is that of a covariate, without which these nights were combined: leave it out, or "
                "name one, combine_nights(..., covariate=) (--covariate)"
            )
        if isinstance(value, bool) or not isinstance(value, Real) or not np.isfinite(value):
            raise InputError(f"value must be a number, what {self.covariate} is, got {value!r}")
        mean, unit, _ = self._standard
        return float((value - mean) / unit)

    @cached_property
    def _modes(self):
        return modes_of(self.nights, self.shape)

    @cached_property
    def _widths(self):
        """Scatter of nights, of every mode."""
        return self.scatter[self._modes.labels - 1]

    @cached_property
    def _chain(self):
        _, unit, numbers = self._standard
        given = given_by(self.nights, self._modes, unit)
        scatter2 = own_scatter2(self.scatter, self.oddness, self._whole, self._modes.labels)
        sizes = {"rate": self.rate, "walk": self.walk, "slope": self.slope * unit}
        return Chain.of(given, scatter2, self.dates, sizes, numbers)

    @property
    def _whole(self):
        """Which are several nights together, and speak of S itself."""
        return np.array([each.n_nights > 1 for each in self.nights])

    def _known(self, date=None, value=None):
        """S at a date and a value (K,) and its covariance, free along what nights do not tell."""
        k = self._modes.size
        mean, covariance = self._chain.at(self._year(date), self._number(value))
        mean, covariance = mean[:k], covariance[:k, :k]
        # what a map states counts however wide it is
        seen = [information[:k, :k] for _, information, _ in given_by(self.nights, self._modes, 1.0)]
        factors = [1 if each.n_stars else DETERMINED * UNKNOWN**2 for each in self.nights]
        whole = sum(factor * each for factor, each in zip(factors, seen, strict=True))
        power, directions = np.linalg.eigh(whole)
        told, free = directions[:, power > DETERMINED], directions[:, power <= DETERMINED]
        if free.shape[1]:
            across = told.T @ covariance @ free
            gain = np.linalg.solve(free.T @ covariance @ free, across.T).T
            mean = told @ (told.T @ mean - gain @ (free.T @ mean))
            covariance = told @ (told.T @ covariance @ told - gain @ across.T) @ told.T + FREE**2 * free @ free.T
        return mean, covariance

    @plain_numbers
    def static(
        self, date: float | Time | None = None, value: float | None = None, *, further_night: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """S at a date and value, normalised Legendre modes (2, n_modes), and its covariance (2 n_modes,) * 2, pixels.

        Of several detectors changes (n_detectors, 2, n_modes) from the camera of the first night, and the covariance of
        all, one detector after the other.

        Combinations that nights together do not determine, to 0.3 px rms per axis over the detector, are zero in it,
        with an error of 1000 px: what little they say of them rests on maps being polynomials exactly.

        Parameters
        ----------
        date : float or `~astropy.time.Time`, optional
            Julian year; that of the last night if not given. Without a drift it does not matter.
        value : float, optional
            Of the covariate; its mean over all exposures if not given. Without a dependence it does not matter.
        further_night : bool
            Whether the covariance is that of a further night, with the scatter of nights.
        """
        mean, covariance = self._known(date, value)
        return self._modes.coefficients(mean, covariance + np.diag(self._widths**2) * further_night)

    @property
    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """By the covariate, pixels a unit, normalised Legendre modes (2, n_modes), and their covariance.

        Zero where no dependence is seen. Where nights do not tell, the error is ten times `slope`.
        """
        k, unit = self._modes.size, self._standard[1]
        mean, covariance = self._chain.at(self._year(None)) if self.slope else (np.zeros(2 * k), np.zeros((2 * k,) * 2))
        mean, covariance = mean[k:] / unit, covariance[k:, k:] / unit**2
        return self._modes.coefficients(mean, covariance)

    @plain_numbers
    def prior(
        self, date: float | Time | None = None, value: float | None = None, *, one_exposure: bool = False
    ) -> Prior:
        """What is known of the static distortion of a further night: S at its date, with its error and nights' scatter.

        Parameters
        ----------
        date : float or `~astropy.time.Time`, optional
            As for `static`.
        value : float, optional
            As for `static`: the mean of the exposures of that night.
        one_exposure : bool
            Whether it is for one exposure alone, which does not tell how far exposures scatter: as far as those of
            the nights, `exposure_scatter`, is the `sigma` of the prior then.

        Raises
        ------
        InputError
            Of a camera with several detectors.
        """
        if self.has_focal_plane:
            raise InputError(
                f"camera {self.name} has several detectors, and no single distortion: take its camera, camera() "
                "(--camera)"
            )
        static, covariance = self.static(date, value, further_night=True)
        record = {"kind": "nights", "name": self.name, "camera": self.name, "nights": len(self.nights)}
        record["errors_of"] = FURTHER_NIGHT if self.scatter.any() else ONE_NIGHT
        if np.isfinite(self.dates).any():
            record["dates"] = [float(np.nanmin(self.dates)), float(np.nanmax(self.dates))]
        known = Prior(static, static_covariance=covariance, shape=self.shape, source=record)
        if not (one_exposure and np.any(self.exposure_scatter)):
            return known
        degrees = np.maximum(np.add(*basis.orders(self.degree)), 1)  # a shift is a part of the pose
        return known.with_sigma(self.exposure_scatter[degrees - 1])

    @plain_numbers
    def camera(self, date: float | Time | None = None, value: float | None = None) -> Camera:
        """The same as a `Camera`: of one detector, or of several, whose layouts and static distortions have errors.

        Parameters
        ----------
        date : float or `~astropy.time.Time`, optional
        value : float, optional
            As for `prior`.
        """
        if self.has_focal_plane:
            return self._camera(date, further_night=True)
        return Camera(self.name, {"1": Detector(self.shape, static=self.prior(date, value))})

    def _camera(self, date, *, further_night):
        return self._modes.changed(self.name, *self.static(date, further_night=further_night))

    @plain_numbers
    def modes(self, date: float | Time | None = None, value: float | None = None) -> QTable:
        """One row a mode and axis: ``axis``, ``x_degree``, ``y_degree``, ``coefficient``, ``error``, ``night_scatter``,
        pixels; shift, rotation and scale are taken off. Where the map depends on a covariate ``slope``, ``slope_error``
        too, pixels a unit of it. Of several detectors those of degree 2 and more, with a column ``detector``.

        Parameters
        ----------
        date : float or `~astropy.time.Time`, optional
        value : float, optional
            As for `static`.
        """  # fmt: skip
        if self.has_focal_plane:
            return self._modes.table(self._camera(date, further_night=False), self._widths)
        static, covariance = self.static(date, value)
        error = np.sqrt(np.diag(covariance)).reshape(2, -1)
        scatter = np.sqrt(self._widths**2 @ self._modes.rows**2).reshape(2, -1)
        known = np.where(error < UNKNOWN, error, np.nan)
        out = mode_table(coefficient=static, error=known, night_scatter=scatter)
        if self.slope:
            slopes, covariance = self.slopes
            more = mode_table(slope=slopes, slope_error=np.sqrt(np.diag(covariance)).reshape(2, -1))
            for name in ("slope", "slope_error"):
                out[name] = more[name]
                out[name].info.format = ".2g"
        return out

    @cached_property
    def table(self) -> QTable:
        """One row a night, worst first: ``night``, ``date`` [yr], ``n_nights``, ``n_exposures``, ``n_stars``,
        ``departure`` [pix] (rms per axis, from what all others say, in the directions that the night determines),
        ``chi2``, ``dof``, ``p``, ``oddness`` and whether it is ``odd``; ``value``, the mean of a covariate.
        """  # fmt: skip
        rows, count = [], len(self.nights)
        for n, night in enumerate(self.nights):
            own = self._widths * (night.n_nights == 1)
            chi2, dof, away = contradiction(self._chain, n, own) if count > 1 else (0.0, 0, np.zeros(1))
            p = chance(chi2, dof, night.dof)
            rms = np.sqrt(np.sum(away**2) / MEAN_SQUARE / self._modes.n_detectors)
            date = np.nan if night.date is None else night.date
            counts = night.n_nights, night.n_exposures, night.n_stars
            value = np.nan if night.value is None else night.value
            rows.append((night.name, date, *counts, rms, chi2, dof, p, self.oddness[n], value))
        rows.sort(key=lambda row: row[8])
        counts = "n_nights", "n_exposures", "n_stars"
        names = "night", "date", *counts, "departure", "chi2", "dof", "p", "oddness", "value"
        out = QTable(rows=rows, names=names)
        if self.covariate is None:
            out.remove_column("value")
        out["date"], out["departure"] = out["date"] * u.yr, out["departure"] * u.pix
        # of two that contradict one another nothing tells which is odd, unless one is of more nights
        others = sum(each.n_nights for each in self.nights) - out["n_nights"]
        out["odd"] = (out["p"] < ALARM / count) & (others > out["n_nights"])
        return out

    @property
    def odd(self) -> tuple[str, ...]:
        """Names of nights that contradict the others, worst first, then those left out of nights solved together."""
        found = self.table["night"][self.table["odd"]].tolist()
        return *found, *(f"{name} of {each.name}" for each in self.nights for name in each.odd)

    def seen_by(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """What night number n alone says of the static distortion, and its error: (2, n_modes) each, pixels.

        The error holds the scatter of nights; it is large where the night does not tell. Where the map depends on a
        covariate the night is brought to the mean of that, by the slopes of all nights.
        """
        k, chain, scatter2 = self._modes.size, self._chain, self._widths**2 * (self.nights[n].n_nights == 1)
        whole = np.linalg.inv(chain.information[n][:k, :k] + np.eye(k) / UNKNOWN**2)
        mean, covariance = whole @ chain.pull[n][:k], whole + np.diag(scatter2)
        if self.slope:
            slopes = chain.at(self._year(None))[0][k:]
            mean = mean - whole @ chain.information[n][:k, k:] @ slopes - chain.numbers[n] * slopes
        values, covariance = self._modes.coefficients(mean, covariance)
        return values, np.sqrt(np.diag(covariance)).reshape(values.shape)

    @property
    def dates(self) -> np.ndarray:
        """Years of the nights, (n_nights,); zeros if one has none."""
        return dates_of(self.nights)

    @property
    def exposure_scatter(self) -> np.ndarray:
        """Of single exposures about their night by degree, pixels a normalised coefficient: (degree,), of all nights.

        Zero for maps, and of several detectors, of which it is not found.
        """
        weight = np.array([each.n_exposures * bool(np.any(each.scatter)) for each in self.nights], dtype=float)
        squares = np.array([each.scatter**2 for each in self.nights])
        return np.sqrt(weight @ squares / max(weight.sum(), 1.0))

    @property
    def drifts(self) -> bool:
        """Whether the static distortion changes with time."""
        return self.rate > 0 or self.walk > 0

    @plain_numbers
    def to_dict(self, date: float | Time | None = None, value: float | None = None) -> dict[str, Any]:
        """Everything but what nights say one by one as numbers and texts for JSON.

        Parameters
        ----------
        date : float or `~astropy.time.Time`, optional
        value : float, optional
            As for `static`.
        """
        sizes = {"scatter_px": self.scatter.tolist(), "exposure_scatter_px": self.exposure_scatter.tolist()}
        sizes |= {"rate_px_yr": self.rate, "walk_px_root_yr": self.walk}
        named = {"name": self.name, "degree": self.degree, "date": self._year(date) or None, "odd": list(self.odd)}
        if self.covariate is not None:
            mean, unit, _ = self._standard
            rms, error = self._slope_rms if self.slope else (0.0, None)
            depends = {"covariate": self.covariate, "evidence": self.evidence, "slope_px": rms, "slope_error_px": error}
            sizes |= depends | {
                "mean": float(mean),
                "rms": float(unit),
                "value": float(mean if value is None else value),
            }
        return named | sizes | {"modes": records(self.modes(date, value)), "nights": records(self.table)}

    def plot(self, *, fig: Figure | None = None) -> Figure:
        """Coefficients against time, see `legdistort.plots.memory_plots.plot_memory`."""
        return plot_memory(self, fig=fig)

    @plain_numbers
    def write(
        self, path: StrPath, *, date: float | Time | None = None, value: float | None = None, overwrite: bool = False
    ) -> Path:
        """Write a camera file (`Camera.read`, ``--prior``, ``--camera``), with the nights; returns the path."""
        own = {"layout": LAYOUT, "provenance": provenance.stamp()} | codec.to_tree(self)
        with replacing(path, overwrite=overwrite) as file:
            whole = camera_files.tree_of(self.camera(date, value)) | {ROOT: own}
            asdf.AsdfFile(whole, version=asdf_files.ASDF_STANDARD).write_to(file)
        return Path(path)

    @classmethod
    def read(cls, path: StrPath) -> CombinedNights:
        """Read what `write` wrote.

        Raises
        ------
        InputError
            Naming the file: if it holds no nights, or is damaged.
        """
        tree = asdf_files.read_tree(path).get(ROOT)
        if not isinstance(tree, dict) or "layout" not in tree:
            raise InputError(f"{path} holds no nights (no entry '{ROOT}'); make one: legdistort nights")
        asdf_files.check_layout(tree["layout"], LAYOUT, path)
        return asdf_files.understood(path, partial(_from_tree, cls), tree)

    def __repr__(self) -> str:
        return f"<CombinedNights: {self.name}, degree {self.degree}, {len(self.nights)} nights, {len(self.odd)} odd>"

    def _said_of_odd(self):
        """Sentences on nights that contradict one another."""
        less, out = self.table["night"][self.table["odd"]].tolist(), self.odd[np.count_nonzero(self.table["odd"]) :]
        said = [f"Odd nights, which count less: {some_of(less, 10)}."] * bool(less)
        said += [f"Odd nights, left out: {some_of(list(out), 10)}."] * bool(out)
        if not less and len(self.nights) > 1:
            differ = np.any(self.table["p"] < ALARM / len(self.nights))
            both = "Nights contradict one another, and nothing tells which is odd."
            said.append(both if differ else "No night contradicts the others.")
        return said

    def _said_of_weak(self):
        """Combinations whose errors are far larger than those of most, which single coefficients do not show."""
        told = self._modes.told
        error = np.sqrt(np.linalg.eigvalsh(told @ self._known()[1] @ told.T))
        weak = error > _WEAK * np.median(error)
        if not weak.any():
            return []
        least, rest = np.min(error[weak]), np.sqrt(np.mean(error[~weak] ** 2))
        known = "are not determined, which is" if least > UNKNOWN else f"are known to {least:.2g} px at best, and"
        return [
            f"{np.count_nonzero(weak)} combinations {known} in the errors of all of their coefficients; the "
            f"{np.count_nonzero(~weak)} others are known to {rest:.2g} px rms."
        ]

    @property
    def _slope_rms(self):
        """Slope in all, px a unit of the covariate, rms per axis over the detector, and its error."""
        slopes, covariance = (each / factor for each, factor in zip(self.slopes, (1, MEAN_SQUARE), strict=True))
        size = np.linalg.norm(slopes)
        return float(size / np.sqrt(MEAN_SQUARE)), float(np.sqrt(slopes.ravel() @ covariance @ slopes.ravel()) / size)

    def _said_of_covariate(self):
        """Whether the map depends on it."""
        if self.covariate is None:
            return []
        told = f"twice ln L is larger by {self.evidence:.1f}"
        if not self.slope:
            return [f"No dependence on {self.covariate} is seen ({told} with one, {KEPT:g} are needed)."]
        mean, (rms, error) = self._standard[0], self._slope_rms
        low, high = min(each.lowest for each in self.nights), max(each.highest for each in self.nights)
        return [
            f"It depends on {self.covariate}, by {rms:.3g} +- {error:.1g} px rms a unit ({told}): by "
            f"{rms * (high - low):.2g} px from {low:g} to {high:g}. Coefficients are those at {mean:.6g}."
        ]

    def __str__(self) -> str:
        n_exposures, count = (sum(getattr(each, name) for each in self.nights) for name in ("n_exposures", "n_nights"))
        of = f"{n_exposures} exposures of {count} night{'s' * (count > 1)}"
        named = f"Camera {self.name}".removesuffix(f" {_UNNAMED}")
        lines = [f"{named}: static distortion of degree {self.degree} from {of}."]
        if not self.scatter.any():
            lines.append("One night does not tell how far nights scatter: errors are those of this night alone.")
        else:
            scatter = ", ".join(f"{each:.2g} (degree {d})" for d, each in enumerate(self.scatter, self._modes.lowest))
            lines.append(f"Nights scatter by {scatter} px a coefficient.")
            drift = f"{self.rate:.2g} px a year, and wanders by {self.walk:.2g} px in the root of a year"
            if undated := [each.name for each in self.nights if each.date is None]:
                have = "has" if len(undated) == 1 else "have"
                lines.append(f"Change with time is not looked for: {some_of(undated, 6)} {have} no date.")
            elif self.drifts or len(self.nights) > 2:
                lines.append(f"A coefficient changes by {drift}." if self.drifts else "No change with time is seen.")
        lines += self._said_of_covariate()
        if np.any(own := self.exposure_scatter):
            scatter = ", ".join(f"{each:.2g} (degree {d})" for d, each in enumerate(own, 1))
            lines.append(f"Exposures scatter about their night by {scatter} px a coefficient.")
        together = [f"{each.n_nights} nights of {each.name}" for each in self.nights if each.nightly is not None]
        if together:
            lines.append(
                f"Solved together were {some_of(together, 3)}: they count as one row, their scatter is that found in "
                "their solution, and how each departs is in the table of its nights (legdistort show)."
            )
        lines += [*self._said_of_odd(), ""]
        if self.has_focal_plane:
            camera = self._camera(None, further_night=False)
            lines += [*camera.table_lines(), *common_maps_in_lines(camera, self.degree), ""]
        off = "those of degree 2 and more" if self.has_focal_plane else "shift, rotation and scale taken off"
        lines.append(f"Normalised Legendre modes, undistorted to detector pixels, {off}:")
        lines += [*self.modes().pformat(max_lines=-1, max_width=-1), *self._said_of_weak()]
        shown = self.table[[name for name in self.table.colnames if name != "odd"]]
        forms = {"date": ".3f", "departure": ".4f", "chi2": ".1f", "p": ".2g", "oddness": ".2f", "value": ".6g"}
        for name in forms.keys() & set(shown.colnames):
            shown[name].info.format = forms[name]
        lines += ["", "Nights, worst first; departure: rms per axis, in the directions that a night determines:"]
        return "\n".join([*lines, *shown.pformat(max_lines=22, max_width=-1)])


@plain_numbers
def combine_nights(
    results: Sequence[Solution | CombinedNights | Prior | StrPath],
    *,
    name: str | None = None,
    covariate: str | None = None,
    workers: int | None = None,
    progress: bool = False,
) -> CombinedNights:
    """Combine nights to one camera, its static distortion and layout, with what each night adds found from all.

    Of every night counts what its exposures tell of the static distortion by dithers and rolls, whatever prior it
    was solved with, so that a prior counts nowhere. What a night does not determine it does not state. A map of
    another program is a night that states all, to its `static_sigma` or else to 0.001 pixels: of several
    `Prior.from_file` of headers it is their mean, and their scatter.

    Of several detectors a solution of several nights, or in which something of the camera was held or known
    beforehand, is solved again, every night by itself with layout and static distortion fitted.

    Parameters
    ----------
    results : list of Solution, CombinedNights, Prior or path
        Solutions of nights or fields, folders with one, maps, and earlier combinations, to which the others are added.
    name : str, optional
        Of the camera; by default that of an earlier combination, or of the camera of the first night if it has
        several detectors, else "camera".
    covariate : str, optional
        A number of every exposure on which the static distortion may depend linearly, by a slope of every mode: a
        column of the tables of matches, such as ``match(keywords=...)`` takes from headers. It is kept by the same
        evidence as a drift. By default that of an earlier combination. An angle must not wrap.
    workers : int, optional
        Processes that solve nights.
    progress : bool
        Show a progress bar.

    Returns
    -------
    CombinedNights

    Raises
    ------
    InputError
        Naming the night: of another detector or degree, with exposures that were given before, or without the
        covariate; of several detectors with a covariate, or if it cannot be solved by itself. If the covariate is one
        number everywhere.

    Warns
    -----
    AssumptionWarning
        For maps without a width that do not scatter at a degree; for a covariate that may be an angle that wraps;
        for nights of one exposure in a solution of several, of several detectors, which are left out.

    See Also
    --------
    legdistort.difference : Whether an old map is still right.
    legdistort.Prior : What is known of a further night, `CombinedNights.prior`.

    Examples
    --------
    >>> import legdistort as ld
    >>> seen = ld.simulate_matches(degree=2, n_exposures=6, rotations=[0, 90] * 3, dither=300.0, sigma=0.02)
    >>> camera = ld.combine_nights([ld.solve(seen.matches, degree=2)])
    >>> camera.prior()
    <Prior: degree 2, 6 modes an axis, static_sigma given, with correlations>
    """
    given = [results] if isinstance(results, (str, Path, Solution, CombinedNights, Prior)) else list(results)
    if not given:
        raise InputError("no nights: give solutions, folders with one, or an earlier combination")
    earlier, solved = [], []
    for count, each in enumerate(given, 1):
        thing = _opened(each)
        kind = "map" if isinstance(thing, Prior) else "solution"
        label = str(each) if isinstance(each, (str, Path)) else f"{kind} {count}"
        (earlier if isinstance(thing, CombinedNights) else solved).append((label, thing))
    nights = [night for _, each in earlier for night in each.nights]
    shapes = {each.shape for _, each in earlier}
    covariate = _common_covariate(earlier, covariate)
    reduce, shown = partial(nights_of, covariate=covariate), {"description": "nights", "unit": "night"}
    made = list(map_items(reduce, solved, workers=workers, progress=progress, **shown))
    nights += [night for those, _ in made for night in those]
    check_nights(nights, shapes | {shape for _, shape in made})
    named = [each.camera.name for each in nights if each.camera is not None]
    name = name or next((each.name for _, each in earlier), None) or next(iter(named), _UNNAMED)
    shape = next(iter(shapes | {shape for _, shape in made}))
    if covariate is not None:
        check_numbers(nights, covariate)
    found = _combined(nights, shape, name, covariate)
    if not earlier and len(solved) > 1:
        _warn_of_one_map([thing for _, thing in solved], found.scatter)
    return found


def _common_covariate(earlier, covariate):
    """That which is asked for, or else that of earlier combinations, which must have the same."""
    if covariate is not None and not (isinstance(covariate, str) and covariate):
        raise InputError(f"covariate must be the name of a column or keyword, got {covariate!r}")
    asked = covariate or next((each.covariate for _, each in earlier if each.covariate), None)
    for label, each in earlier:
        if each.covariate != asked:
            has = f"covariate {each.covariate}" if each.covariate else "no covariate"
            raise InputError(f"{label} was combined with {has}, not {asked}: give the solutions of its nights instead")
    return asked


def _warn_of_one_map(things, scatter):
    """Warn where maps that state no errors do not scatter either."""
    same = [str(degree) for degree, size in enumerate(scatter, 1) if size < EXACT]
    if same and all(isinstance(each, Prior) and each.static_sigma is None for each in things):
        warn(
            f"the maps are the same to {EXACT} px at degree {', '.join(same)}: one fit that they have in common, or "
            "none, and they do not tell how wrong it is; state a static_sigma (--static-sigma), and no higher degree "
            "than was fitted",
            AssumptionWarning,
        )


def _opened(thing):
    """A solution, combination or map as it is; a path to a solution as a path, that to a combination or prior read."""
    if isinstance(thing, (Solution, CombinedNights, Prior)):
        return thing
    if not isinstance(thing, (str, Path)):
        raise InputError(
            f"nights are solutions, folders with one, maps, or earlier combinations, got {type(thing).__name__}"
        )
    kinds = {ROOT: CombinedNights, "legdistort_prior": Prior}
    entry = asdf_files.entry_of(thing, kinds)
    return Path(thing) if entry is None else kinds[entry].read(thing)


def _combined(nights, shape, name, covariate):
    nights = sorted(nights, key=lambda night: np.inf if night.date is None else night.date)
    modes = modes_of(nights, shape)
    _, unit, numbers = standard_numbers(nights) if covariate else (0.0, 1.0, None)
    whole = [each for each in nights if each.n_nights > 1]
    known = None
    if whole:  # squares weighted by the number of nights that they are of
        weight = [each.n_nights for each in whole]
        known = np.sqrt(np.average([each.nightly**2 for each in whole], axis=0, weights=weight))
    together = np.array([each.n_nights > 1 for each in nights])
    given = given_by(nights, modes, unit)
    chain, oddness, scatter, evidence = fitted(given, dates_of(nights), modes.labels, together, known, numbers)
    changes = {"rate": chain.rate, "walk": chain.walk, "slope": float(chain.slope / unit)}
    changes |= {"covariate": covariate, "evidence": evidence}
    return CombinedNights(tuple(nights), shape=shape, name=name, scatter=scatter, oddness=oddness, **changes)


def _from_tree(kind, tree):
    return codec.from_tree(kind, tree, ROOT, strict=False)
