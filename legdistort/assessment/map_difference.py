"""Is an old distortion map still right? The difference of two maps, or of a map and a night, with its error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable, vstack
from scipy import special

from ..cameras.camera import Camera
from ..exceptions import InputError, some_of
from ..geometry import basis, detector_modes
from ..inputs.repetitions import fingerprints
from ..inputs.table_files import records
from ..plots.difference_plots import plot_difference
from ..priors.from_objects import SKY
from ..priors.mode_tables import mode_table
from ..priors.prior import Prior
from ..priors.storage import open_prior
from ..results.solution import Solution
from ..runtime.asdf_files import entry_of
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted
from .known_maps import DETERMINED, MEAN_SQUARE, chance, follows, known_map
from .nights.camera_memory import CombinedNights
from .nights.night_data import numbers_in
from .star_difference import StarDifference, compare_stars, shared_exposures

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Chance below which two maps differ.
ALARM = 0.003
_EXACT = 1e-6  # error of what is stated without one, beside what has one [pix]
_SHOWN = 5e-5  # difference of coefficients [pix] from which on they are printed; those of 1 sigma and more always are


@dataclass(frozen=True, eq=False, repr=False)
class MapDifference(ShownAsPrinted):
    """Difference of two distortion maps, second minus first, a similarity of every detector taken off.

    Made by `legdistort.difference`.

    Attributes
    ----------
    labels : tuple of str
        What was compared.
    coefficients, errors : dict
        ``{detector: (2, n_modes)}``, normalised Legendre modes, x then y, pixels. Directions that are not determined
        are taken off; errors are NaN where most of a mode is not determined, or where neither map states an error.
    shapes : dict
        ``{detector: (ny, nx)}``.
    chi2 : float
        Of the determined directions; NaN where neither map states an error.
    dof : int
        Number of these.
    p : float
        Probability of so large a difference by chance.
    rms_error : float
        Rms of the difference that the errors let expect, per axis, pixels; NaN where none is stated.
    n_undetermined : int
        Directions that are not determined to 0.3 px, rms per axis, and do not count.
    undetermined : tuple of str
        What these are, of modes that are mostly in them: shear, degree 2, ...; by detector where there are several.
    left_out : tuple of str
        Detectors that one has alone, where the other is a map of one that its file names.
    shared : tuple of str
        Exposures of the second that the first has too: the errors are not independent then, and the difference has
        neither errors nor a probability.
    stars : StarDifference or None
        Of the stars, where two solutions have some in common.
    refused : str
        Why the maps of two solutions with common stars are not compared; empty where they are.
    """

    labels: tuple[str, str]
    coefficients: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    shapes: dict[str, tuple[int, int]]
    chi2: float
    dof: int
    p: float
    rms_error: float = np.nan
    n_undetermined: int = 0
    undetermined: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()
    stars: StarDifference | None = None
    refused: str = ""

    @property
    def rms(self) -> float:
        """Root mean square of the difference over the detectors, per axis, pixels."""
        if self.refused:
            return np.nan
        return float(np.sqrt(np.mean([np.sum(each**2) / MEAN_SQUARE for each in self.coefficients.values()])))

    @property
    def sigmas(self) -> float:
        """The significance as standard deviations of a normal variable; at most 37."""
        return float(-special.ndtri(max(self.p, 1e-300) / 2)) if np.isfinite(self.p) else np.nan

    @property
    def agrees(self) -> bool | None:
        """Whether the first map is still right; None where no error is stated, or nothing is determined."""
        return None if not (np.isfinite(self.p) and self.dof) else self.p >= ALARM

    @property
    def why_not(self) -> str:
        """Why there is no probability, in a word or two."""
        return "exposures in both" if self.shared else "no errors stated"

    @property
    def modes(self) -> QTable:
        """One row a mode and axis: ``detector``, ``axis``, ``x_degree``, ``y_degree``, ``difference``, ``error`` [pix],
        ``significance``; shift, rotation and scale are left out.
        """  # fmt: skip
        parts = []
        for key, values in self.coefficients.items():
            part = mode_table(difference=values, error=self.errors[key])
            part.add_column(np.full(len(part), key), name="detector", index=0)
            parts.append(part)
        out = vstack(parts) if parts else mode_table(difference=np.zeros((2, 1)), error=np.zeros((2, 1)))
        error = out["error"].value
        out["significance"] = out["difference"].value / np.where(error < _EXACT, np.inf, error)
        return out

    @property
    def sentence(self) -> str:
        """The result in a sentence."""
        of = ", ".join(self.shapes)
        return self._found + f" (detector {of}; without {some_of(list(self.left_out), 6)})" * bool(self.left_out)

    @property
    def _found(self):
        """The same but for detectors that are left out."""
        first, second = self.labels
        if self.refused:
            return f"the maps of {first} and {second} are not compared: {self.refused}"
        if self.shared:
            return (
                f"{second} differs from {first} by {self.rms:.2g} px rms per axis; {some_of(list(self.shared), 3)} are "
                "in both, so that their errors are not independent, and nothing tells how probable that is"
            )
        if np.isnan(self.p):
            return (
                f"{second} differs from {first} by {self.rms:.2g} px rms per axis; neither states an error, so no more "
                "is known"
            )
        if not self.dof:
            return f"{second} determines nothing of {first}: give exposures at several rolls, or dithers"
        which = f" ({', '.join(self.undetermined)})" * bool(self.undetermined)
        aside = f"; {self.n_undetermined} directions{which} are not determined and do not count"
        aside *= self.n_undetermined > 0
        found = f"chi2 {self.chi2:.1f} for {self.dof}, p = {self.p:.2g}{aside}"
        if self.agrees:
            which = first if first.startswith("the ") else f"the map of {first}"
            return (
                f"{which} is still right: {second} differs from it by {self.rms:.2g} px rms per axis, with errors of "
                f"{self.rms_error:.2g} px ({found})"
            )
        significance = f"{self.sigmas:.1f} sigma" if self.sigmas < 37 else "more than 37 sigma"
        return (
            f"{second} differs from {first} by {self.rms:.2g} px rms per axis ({significance}), mostly in "
            f"{self._most}; {found}"
        )

    @property
    def _most(self):
        """The mode that differs most significantly, in words."""
        table = self.modes
        k = int(np.nanargmax(np.abs(table["significance"])))
        row = table[k]
        of = f" of detector {row['detector']}" * (len(self.shapes) > 1)
        mode = f"L{row['x_degree']}(x) L{row['y_degree']}(y)"
        found, error = row["difference"].value, row["error"].value
        return f"{mode} along {row['axis']}{of} ({found:+.2g} +- {error:.2g} px a coefficient)"

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers and texts for JSON, None where nothing is known."""
        figures = {"rms_px": self.rms, "rms_error_px": self.rms_error, "sigmas": self.sigmas, "chi2": self.chi2}
        figures = {name: value if value == value else None for name, value in (figures | {"p": self.p}).items()}
        more = {"agrees": self.agrees, "dof": self.dof, "n_undetermined": self.n_undetermined}
        more |= {"shared_exposures": list(self.shared), "stars": self.stars and self.stars.to_dict()}
        return figures | more | {"sentence": self.sentence, "modes": records(self.modes)}

    def plot(self, *, ax: Axes | None = None, scale: float | None = None) -> Axes:
        """Picture of the difference as arrows, see `legdistort.plots.difference_plots.plot_difference`."""
        if self.refused:
            raise InputError(f"there is no picture of maps that are not compared: {self.refused}")
        return plot_difference(self, ax=ax, scale=scale)

    def __repr__(self) -> str:
        words = f"p = {self.p:.2g}" if np.isfinite(self.p) else self.why_not
        return f"<MapDifference: {self.rms:.2g} px rms, {words}>"

    def __str__(self) -> str:
        sentence = self.sentence
        if sentence.startswith("the "):  # and no name of a file
            sentence = "T" + sentence[1:]
        lines = [f"{sentence}.", ""]
        if self.refused:
            return "\n".join([*lines, *self.stars.lines()])
        lines.append(
            "Difference: coefficients of the second map less those of the first, undistorted to detector pixels."
        )
        table = self.modes
        shown = (np.abs(table["difference"].value) > _SHOWN) | (np.abs(table["significance"]) > 1)
        head = f"{'detector':10s} {'axis':4s} {'mode':14s} {'difference [px]':>15s} {'error':>9s} {'sigma':>6s}"
        lines += [head] * bool(shown.any())
        for row in table[shown]:
            mode, error = f"L{row['x_degree']}(x) L{row['y_degree']}(y)", row["error"].value
            known = f"{error:9.2g} {row['significance']:6.1f}" if np.isfinite(error) else f"{'-':>9s} {'-':>6s}"
            lines.append(f"{row['detector']:10s} {row['axis']:4s} {mode:14s} {row['difference'].value:15.4f} {known}")
        if n_alike := np.count_nonzero(~shown):
            of = "others" if shown.any() else "modes"
            lines.append(f"{n_alike} {of} differ by no more than {_SHOWN:.5f} px, and by no more than 1 sigma")
        return "\n".join([*lines, "", *self.stars.lines()] if self.stars else lines)


@plain_numbers
def difference(first: Any, second: Any, *, degree: int = 5) -> MapDifference:
    """Compare a distortion map with another, or with a night: is it still right?

    Shift, rotation, scale and parity of either map are conventions and taken off. Of a night counts what its exposures
    determine of the static distortion by dithers and rolls, whatever prior it was solved with: they depart from it by
    their scatter, and a common map of the plane is free. Of two solutions the stars are compared too. Where exposures
    are in both, as of a solution with and without a night, errors are not independent, and no probability is given.

    A map of a file that names its detector is compared with that detector of a camera, and two gwcs that end in other
    frames on the sky. What the detectors of a camera share counts where a reference tied the night, to what exposures
    scatter about it by; else these can take it over, and the map of the plane that brings it nearest is taken off.

    Parameters
    ----------
    first, second : path, Camera, Prior, Solution, CombinedNights, or anything
        That `Prior.from_model` takes with all it needs stated.
        Paths are of camera files, of solutions or folders with one, and of all that `Prior.from_file` reads.
    degree : int
        Of the Legendre series for what is not one yet.

    Returns
    -------
    MapDifference
        Of the detectors that both have, to the lower degree if one is a night, second minus first.

    Raises
    ------
    InputError
        For maps of different detectors or shapes, and nights of a camera whose static distortions were not fitted.

    See Also
    --------
    legdistort.Prior.from_model : Makes a map of a model, a WCS or a function.
    legdistort.Solution.factors : The tests of what a night was solved with.

    Examples
    --------
    >>> import legdistort as ld
    >>> old = ld.Prior([[0, 0, 0, 0.2, 0, 0], [0, 0, 0, 0, 0.1, 0]], static_sigma=0.02, shape=(2048, 2048))
    >>> ld.difference(old, ld.Prior(old.mean * 1.05)).agrees
    True
    """
    one, two = _both(first, second, degree)
    if (frames := _ends(one[0], two[0])) is not None:  # what lies between them is a part of one map and not the other
        on_sky = {"degree": degree, "frame": SKY}
        try:
            one, two = _opened(first, argument="first", **on_sky), _opened(second, argument="second", **on_sky)
        except InputError as error:
            raise InputError(
                f"{one[1]} ends in the frame {frames[0]!r}, {two[1]} in {frames[1]!r}, which need not be alike, and "
                f"not both lead to the sky ({error}): compare priors that were made with one frame (--frame)"
            ) from None
    shared, stars = _shared(one[0], two[0]), None
    if isinstance(one[0], Solution) and isinstance(two[0], Solution):
        stars = compare_stars(one[0], two[0], shared=bool(shared))
    try:
        found = _of_maps(one, two)
    except InputError as error:
        if stars is None:
            raise
        found = MapDifference((one[1], two[1]), {}, {}, {}, np.nan, 0, np.nan, refused=str(error))
    if shared:
        errors = {key: np.full_like(each, np.nan) for key, each in found.errors.items()}
        found = replace(found, errors=errors, chi2=np.nan, dof=0, p=np.nan, rms_error=np.nan)
    return replace(found, shared=shared, stars=stars)


def _of_maps(one, two):
    """The `MapDifference` of what was opened, as of independent data."""
    one, two = _at_number(one, two), _at_number(two, one)
    if follows(one[0]) and not follows(two[0]):
        two = known_map(*two)
        one = known_map(*one, two)
    else:
        one = known_map(*one)
        two = known_map(*two, one)
    if one.label == two.label:
        one, two = replace(one, label=f"{one.label} (first)"), replace(two, label=f"{two.label} (second)")
    pairs = _paired(one, two)
    left_out = [key for k, each in enumerate((one, two)) for key in each.statics if key not in [p[k] for p in pairs]]
    limits = [each.degree for each in (one, two) if each.degree is not None]
    degree = min(limits) if limits else max(one.highest, two.highest)
    n = basis.n_modes(degree)
    rows, values = [], []
    for mine, theirs in pairs:
        shape = one.shapes[mine] or two.shapes[theirs]
        rows.append(detector_modes.dynamic_basis(shape, n))
        maps = [
            basis.change_degree(detector_modes.pointed(each, shape), degree)
            for each in (one.statics[mine], two.statics[theirs])
        ]
        values.append(rows[-1] @ (maps[1] - maps[0]).ravel())
    known = [_in_rows(each, [pair[k] for pair in pairs], rows, n) for k, each in enumerate((one, two))]
    stated = any(each is not None for each in known)
    values, covariance = np.concatenate(values), sum(each for each in known if each is not None)
    if not stated:
        covariance = np.zeros((len(values), len(values)))
    power, directions = np.linalg.eigh(covariance)
    power = np.maximum(power, 0)  # what rounding leaves beside directions of which nothing is known
    determined = power < 1 / DETERMINED
    inside = directions[:, determined]
    pull = inside.T @ values
    chi2 = float(np.sum(pull**2 / (power[determined] + _EXACT**2))) if stated else np.nan
    k, dof = int(determined.sum()), min(one.dof, two.dof)
    p = chance(chi2, k, dof)
    errors = np.einsum("ik,k,jk->ij", inside, power[determined], inside)
    found, own = _by_detector(inside @ pull, errors if stated else None, inside, rows, [pair[0] for pair in pairs])
    shapes = {mine: one.shapes[mine] or two.shapes[theirs] for mine, theirs in pairs}
    size = float(np.sqrt(np.sum(power[determined]) / MEAN_SQUARE / len(pairs))) if stated else np.nan
    return MapDifference(
        (one.label, two.label), found, own, shapes, chi2, k if stated else 0, p if stated else np.nan, size,
        int(np.count_nonzero(~determined)), _named(inside, [pair[0] for pair in pairs], n),
        left_out=tuple(dict.fromkeys(left_out)),
    )  # fmt: skip


def _at_number(labelled, other):
    """Nights whose map depends on a number as that map, where the other is a solution that states the number."""
    nights, label = labelled
    if not (isinstance(nights, CombinedNights) and nights.slope and isinstance(other[0], Solution)):
        return labelled
    label = nights.name if label.startswith("the ") else label
    numbers = numbers_in(other[0], nights.covariate, other[1])
    return nights.prior(value=np.mean(list(numbers.values()))), label


def _named(inside, detectors, n):
    """Names of the rows of detectors, those of `detector_modes.dynamic_basis` each, that are mostly not `inside`."""
    names = ["shear" if degree < 2 else f"degree {degree}" for degree in detector_modes.dynamic_degrees(n)]
    lost = (1 - np.sum(inside**2, axis=1)).reshape(len(detectors), -1) > 0.5
    found = {}
    for name in dict.fromkeys(names):
        mine = lost[:, np.array(names) == name].any(axis=1)
        of = "" if mine.all() else f" of {', '.join(np.array(detectors)[mine])}"
        if mine.any():
            found[f"{name}{of}"] = None
    return tuple(found)


def _ends(first, second):
    """Frames in which the undistorted planes of the maps of two gwcs lie, if these are not the same; else None."""
    sources = [each.source for each in (first, second) if isinstance(each, Prior) and isinstance(each.source, dict)]
    frames = [each["frame"] for each in sources if each.get("kind") == "gwcs"]
    return frames if len(set(frames)) == 2 else None


def _shared(first, second):
    """Names of the exposures, or of nights, that both have."""
    if isinstance(first, Solution) and isinstance(second, Solution):
        return shared_exposures(first, second)
    coarse, fine = sorted((_measured(first), _measured(second)), key=len)
    known = {mark for marks in coarse.values() for mark in marks}
    return tuple(name for name, marks in fine.items() if known & set(marks))


def _measured(thing):
    """Fingerprints of what was measured, by exposure or by night; of maps none."""
    if isinstance(thing, Solution):
        return fingerprints(thing.residuals)
    return {each.name: each.exposures for each in thing.nights} if isinstance(thing, CombinedNights) else {}


def _both(first, second, degree):
    """Both as `_opened` gives them; one that states no shape has that of the other."""
    try:
        one = _opened(first, degree, "first")
    except InputError:
        two = _opened(second, degree, "second")
        return _opened(first, degree, "first", _shape_of(two[0])), two
    return one, _opened(second, degree, "second", _shape_of(one[0]))


def _shape_of(thing):
    """That of the only detector of what was opened; None for several, or where it is not stated."""
    if isinstance(thing, (Prior, CombinedNights)):
        return thing.shape
    shapes = thing.estimate.shapes.values() if isinstance(thing, Solution) else (
        each.shape for each in thing.detectors.values()
    )  # fmt: skip
    shapes = set(shapes)
    return shapes.pop() if len(shapes) == 1 else None


def _opened(thing, degree, argument, usual_shape=None, frame=None):
    """A solution, nights, a camera or a prior, of a gwcs to a frame of it, and its label.

    A map that states no shape has the usual one.
    """
    label = f"the {argument} map"
    if isinstance(thing, (str, Path)) or (isinstance(thing, (list, tuple)) and len(thing) == 2):
        label = str(thing) if isinstance(thing, (str, Path)) else f"{thing[0]}, {thing[1]}"
        thing = _read(thing, degree, usual_shape, frame)
    if isinstance(thing, Mapping):
        raise InputError(f"{label} is a dict: compare its maps one by one, or give a Camera")
    if not isinstance(thing, (Solution, CombinedNights, Camera, Prior)):
        thing = Prior.from_model(thing, degree=degree, frame=frame)
    if isinstance(thing, Prior) and thing.mean is None:
        raise InputError(f"{label} states only the size of a distortion: give a map")
    return thing, label


def _read(where, degree, usual_shape, frame):
    """The nights, camera, solution or prior in files."""
    if isinstance(where, (str, Path)):
        path = Path(where)
        if path.is_dir():
            return Solution.read(path)
        kinds = {"legdistort_nights": CombinedNights, "legdistort_camera": Camera}
        kinds |= {"legdistort": Solution, "legdistort_prior": Prior}
        if (entry := entry_of(path, kinds)) is not None:
            return kinds[entry].read(path)
    return open_prior(where, Prior, degree=degree, frame=frame, usual_shape=usual_shape)


def _by_detector(values, covariance, inside, rows, keys):
    """Coefficients and errors, ``{detector: (2, n_modes)}``, of values of the rows of all detectors."""
    found, errors, begin = {}, {}, 0
    share = inside @ inside.T
    for key, each in zip(keys, rows, strict=True):
        part = slice(begin, begin := begin + len(each))
        found[key] = (each.T @ values[part]).reshape(2, -1)
        whole = np.sum(each**2, axis=0)
        left = np.einsum("ia,ij,ja->a", each, share[part, part], each) < 0.5 * whole
        error = np.full(each.shape[1], np.nan)
        if covariance is not None:
            error = np.sqrt(np.maximum(np.einsum("ia,ij,ja->a", each, covariance[part, part], each), 0))
            error[left] = np.nan
        errors[key] = error.reshape(2, -1)
    return found, errors


def _in_rows(known, keys, rows, n):
    """Covariance of the rows of detectors in some order; None where it is not stated."""
    if known.covariance is None:
        return None
    own, begin = {}, 0
    for key, static in known.statics.items():
        m = static.shape[1]
        own[key] = (begin + np.arange(2 * m)).reshape(2, m)
        begin += 2 * m
    picked, at = np.zeros((sum(map(len, rows)), begin)), 0
    for key, each in zip(keys, rows, strict=True):
        m = min(n, own[key].shape[1])
        wide = each.reshape(len(each), 2, n)
        picked[at : at + len(each), own[key][:, :m].ravel()] = wide[:, :, :m].reshape(len(each), -1)
        at += len(each)
    return picked @ known.covariance @ picked.T


def _paired(one, two):
    """Detectors of both, as pairs of their names."""
    if len(one.statics) == len(two.statics) == 1:
        pairs = [(next(iter(one.statics)), next(iter(two.statics)))]
    else:
        pairs = [(key, key) for key in one.statics if key in two.statics]
    if len(pairs) < max(len(one.statics), len(two.statics)) and not (pairs and (one.is_named or two.is_named)):
        cure = "compare maps of the same detectors"
        if 1 in (len(one.statics), len(two.statics)):
            cure += ": a file whose header names the detector (DETECTOR), or a camera file (Camera.write)"
        raise InputError(
            f"{one.label} has detectors {some_of(list(one.statics), 6)}, {two.label} has "
            f"{some_of(list(two.statics), 6)}: {cure}"
        )
    for mine, theirs in pairs:
        shapes = one.shapes[mine], two.shapes[theirs]
        if None not in shapes and shapes[0] != shapes[1]:
            raise InputError(
                f"{one.label} is for {shapes[0]} (ny, nx), {two.label} for {shapes[1]}: give maps of one detector"
            )
        if shapes == (None, None):
            raise InputError(
                f"neither {one.label} nor {two.label} states the shape of its detector: give Prior(shape=)"
            )
    return pairs
