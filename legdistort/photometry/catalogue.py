"""`legdistort.catalogue` and what it returns."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable

from ..coaddition.grids import reference_grid
from ..coaddition.selection import check_order, select_images, warn_of_left_out
from ..exceptions import InputError, reasons_of
from ..inputs.table_files import write_table
from ..measurement.filters import use_compiled_loops
from ..measurement.options import MeasureOptions
from ..runtime.checks import check_counts
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted
from ..runtime.parallel import map_items
from ..runtime.scratch import moved, scratch_folder
from .agreement import catalogue_check
from .artificial_stars import Completeness, flux_bias, measure_completeness
from .forced import at_places, forced_table, given_places
from .joint_scene import JointScene
from .measuring import measure_field
from .reading import read_layer
from .tables import photometry_table, stars_table

if TYPE_CHECKING:
    from astropy.table import Table

    from ..inputs.exposures import Exposure
    from ..results.check import Check
    from ..results.solution import Solution
    from ..runtime.annotations import StrPath

log = logging.getLogger(__name__)

_STORED = 24  # bytes a pixel of the exposures, at most
_IN_MEMORY = 1 << 30  # bytes of them up to which they need not go to the disk


@dataclass(frozen=True, eq=False, repr=False)
class Catalogue(ShownAsPrinted):
    """Every star of a field, measured in all exposures at once.

    Attributes
    ----------
    stars : `~astropy.table.QTable`
        One row a star, brightest first: ``star`` (numbers of the solution, new ones after the highest); ``x``, ``y``
        [pix] in the reference plane with ``x_err``, ``y_err``, ``xy_corr`` by the pixels, ``x_map_err``, ``y_map_err``
        by the maps of the exposures, which neighbours share, ``x_err_abs``, ``y_err_abs`` by both and the common map
        (NaN where that is not known); with a sky ``ra``, ``dec`` and their errors as in `Solution.stars`; ``flux``,
        ``flux_err`` in an exposure of mean transmission; ``mag``, ``mag_err`` with a zero point; ``flux_scatter`` over
        the exposures; ``n`` images that see it, of which ``n_left_out`` do not tell where it is, as in the
        solution; ``snr`` where nothing but the flux is unknown; ``chi2_dof`` of the
        core; ``sharpness``, what is left in the central pixel over what the PSF has there; ``crowding``; ``flags``
        (`legdistort.measurement.flags.Flag`): what is so in every image that sees it, BLENDED, VARIABLE, DISPLACED,
        EXTENDED.
        ``meta["noise_peaks"]`` is the number of peaks of noise alone to be expected above the threshold.
    photometry : `~astropy.table.QTable`
        One row a star and image that sees it: ``star``, ``exposure`` (and ``detector``), ``flux``, ``flux_err``,
        ``flags``. The transmission is taken off; fluxes may be negative. ``meta["zero_points"]`` has magnitudes to be
        added to those of single images, with errors.
    left_out : dict
        Names of images that were not used, with the reason.
    completeness : `~legdistort.photometry.artificial_stars.Completeness` or None
        What is missed, and how the rows err, where artificial stars were asked for; `stars` have ``flux_bias`` then,
        the median excess of artificial stars that were measured as bright. Nothing is corrected for it.

    See Also
    --------
    legdistort.catalogue : Makes it.
    legdistort.measure : Stars of single exposures.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    >>> exposures = ld.read_exposures(list(night.hdus.values()))
    >>> solution = ld.solve(ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures))
    >>> found = ld.catalogue(exposures, solution)
    >>> found.stars["star", "x", "x_err", "flux"].colnames
    ['star', 'x', 'x_err', 'flux']
    """

    stars: QTable
    photometry: QTable
    left_out: Mapping[str, str]
    completeness: Completeness | None = None

    def __repr__(self) -> str:
        n_images = self.stars.meta["n_images"]
        images = f"{n_images} image{'s' * (n_images != 1)}"
        if self.stars.meta.get("forced"):
            return f"<Catalogue: {len(self.stars)} given positions in {images}>"
        return f"<Catalogue: {len(self.stars)} stars in {images}, {self.stars.meta['n_new']} of them new>"

    @property
    def check(self) -> Check:
        """The check ``catalogue``: do its stars lie where the solution has them?"""
        return catalogue_check(self.stars)

    def __str__(self) -> str:
        meta = self.stars.meta
        compared = f"\n{self.check.sentence}" if "displaced" in meta else ""
        return (
            f"{repr(self)[1:-1]}\n"
            f"above {meta['threshold']:g} times the noise of all exposures together, where {meta['noise_peaks']:.2g} "
            f"peaks of noise are expected in {meta['area']} px^2\n"
            f"{meta['n_rejected']} peaks left out that one exposure alone shows, or none"
            f"{compared}"
        )

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write `stars` as ECSV, and `photometry` as ``photometry.ecsv`` beside it; returns the path.

        Raises
        ------
        InputError
            If one of them exists.
        """
        path = Path(path)
        beside = photometry_path(path)
        write_table(self.photometry, beside, overwrite=overwrite)
        write_table(self.stars, path, overwrite=overwrite)
        return path


def photometry_path(path):
    """Where the fluxes by exposure go beside a catalogue."""
    beside = Path(path).with_name("photometry.ecsv")
    if beside == Path(path):
        raise InputError(f"{path}: fluxes by exposure are written under this name; give the catalogue another")
    return beside


@plain_numbers
def catalogue(
    exposures: Sequence[Exposure],
    solution: Solution,
    *,
    threshold: float = 5.0,
    psf: Any = "auto",
    fwhm: float | None = None,
    gain: float | None = None,
    read_noise: float | None = None,
    saturation: float | None = None,
    zero_point: float | None = None,
    positions: Table | StrPath | None = None,
    artificial: int | None = None,
    seed: int = 0,
    scratch: StrPath | None = None,
    progress: bool = False,
) -> Catalogue:
    """Find and measure every star in all exposures at once, by the maps of a solution.

    Likelihood images (matched filters with the PSF and the noise of each exposure) are carried to the reference plane
    and summed; what stands out is fitted in every exposure, subtracted, and the rest searched for more until nothing
    changes. A star has one position in the reference plane and one flux; the transmissions of the exposures follow from
    bright stars. What one exposure alone shows, such as the hit of a particle, is no star. Images count where stars
    determined their map (`View.supported`; of a camera those of all detectors), and a core's width beyond.

    In memory are the pixels of one exposure at a time, some 60 bytes for each, where those of all would take more than
    1 GB; the others are on disk. The catalogue is the same, bit for bit.

    Parameters
    ----------
    exposures : sequence of Exposure
        From `legdistort.read_exposures` or `legdistort.open_exposures`.
    solution : Solution
        With the maps; it is not changed. Its stars are where the search begins.
    threshold : float
        Least signal-to-noise ratio of all exposures together.
    psf : {"auto", "moffat", "effective"}, EffectivePSF, path, photutils model or dict of those, optional
        As for `legdistort.measure`; "auto" is what the positions of the solution were measured with.
    fwhm : float, optional
        Of the stars [pix]; found in every frame if not given.
    gain, read_noise, saturation : float, optional
        In e-/ADU, e-, ADU; for all exposures instead of their own values.
    zero_point : float, optional
        Magnitude of a star of unit flux in an exposure of mean transmission; without it there are no magnitudes.
    positions : `~astropy.table.Table` or path, optional
        Given stars instead: ``x``, ``y`` in the reference plane [pix] or, where the solution has a sky, ``ra``, ``dec``
        [deg], perhaps ``star``. All stars are found as always, and the fluxes at these places are fitted beside those
        of the others: negative ones are kept, and ``flux_limit`` is three standard deviations above what is there.
    artificial : int, optional
        Put so many artificial stars into all exposures, a few at a time, and find them again: `Catalogue.completeness`
        states what the catalogue misses and how many rows are false, and the column ``flux_bias`` by how much fluxes
        near the threshold are too large. As many as 3 % of the rows come at a time, for about a tenth of the time
        that the catalogue takes.
    seed : int
        Of the random numbers of artificial stars.
    scratch : str or path, optional
        Folder for pixels while work goes on, if they do not stay in memory: 24 bytes for each. The default is that of
        the system (``TMPDIR``), which some systems keep in memory.
    progress : bool
        Show progress bars.

    Returns
    -------
    Catalogue

    Raises
    ------
    InputError
        For a value out of range, positions that are not finite or on no exposure, an exposure whose shape is not that
        of the solution, a solution with motions of stars, which this does not fit, one of a camera whose detectors no
        star ties together, and where no exposure can be used.
    DiskFullError
        If the disk of `scratch` has less space than will be needed.

    Warns
    -----
    AssumptionWarning
        For exposures that are left out: the solution does not know them, or their PSF cannot be made.

    See Also
    --------
    legdistort.coadd : The image of the same exposures.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    >>> exposures = ld.read_exposures(list(night.hdus.values()))
    >>> solution = ld.solve(ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures))
    >>> ld.catalogue(exposures, solution).stars.meta["n_images"]
    4
    """
    check_order(exposures, solution, "catalogue")
    options = MeasureOptions(
        threshold=threshold, psf=psf, fwhm=fwhm, gain=gain, read_noise=read_noise, saturation=saturation
    )
    if zero_point is not None and not np.isfinite(zero_point):
        raise InputError(f"zero_point must be a finite magnitude, got {zero_point!r}")
    _check_artificial(artificial, seed, positions)
    _check_solution(solution)
    places = None if positions is None else given_places(positions, solution)
    frames, views, left_out = select_images(exposures, solution, "measure", "the catalogue")
    grid = reference_grid(list(views.values()), solution.sky)
    use_compiled_loops(sum(int(np.prod(frame.shape)) for frame in frames))
    need = _STORED * sum(int(np.prod(frame.shape)) for frame in frames)
    what = f"the pixels of {len(frames)} exposures"
    with nullcontext() if need <= _IN_MEMORY else scratch_folder(scratch, need, what) as folder:
        read = partial(_read, views=views, grid=grid, options=options, folder=folder)
        read = map_items(read, frames, workers=1, progress=progress, description="reading")
        layers = []
        for frame, layer in zip(frames, read, strict=True):
            if isinstance(layer, str):
                left_out[frame.name] = layer
                warn_of_left_out({frame.name: layer}, "the catalogue")
            else:
                layers.append(layer)
        if not layers:
            raise InputError(f"no exposure can be measured: {reasons_of(left_out)}")
        field = JointScene(layers, grid, progress=progress)
        return _measured(field, solution, frames, left_out, threshold, zero_point, places, artificial, seed)


def _measured(field, solution, frames, left_out, threshold, zero_point, places, artificial, seed):
    """The catalogue of a scene that has no stars yet."""
    estimate, completeness = solution.estimate, None
    order = np.argsort(estimate.positions[:, 1], kind="stable")  # stars that are near in the memory are near on images
    order = order[np.isfinite(estimate.positions[order, 1])]
    clipped = np.array([layer.places.left_out(np.asarray(estimate.star_names)[order]) for layer in field.layers])
    measured = measure_field(field, estimate.positions[order], clipped, threshold)
    if places is not None:
        measured, names, rows = at_places(field, measured, *places)
        stars = forced_table(field, measured, names, rows, solution, threshold, zero_point)
    elif not len(field.flux):
        raise InputError(f"no star stands out of all exposures together by {threshold:g} times the noise")
    else:
        stars = stars_table(field, measured, solution, threshold, zero_point)
        names, rows = stars["star"], np.argsort(-field.flux, kind="stable")
    frames = {frame.name: frame for frame in frames}
    photometry = photometry_table(field, measured, names, rows, frames)
    if artificial is not None:
        completeness = measure_completeness(
            field, estimate.positions[order], threshold, int(artificial), seed=int(seed), zero_point=zero_point
        )
        bias = flux_bias(completeness.stars, stars["snr"], stars["flux_err"])
        stars.add_column(bias, name="flux_bias", index=stars.colnames.index("flux_err") + 1)
    return Catalogue(stars, photometry, left_out, completeness)


def _check_artificial(artificial, seed, positions):
    """Raise `InputError` for artificial stars that cannot be had."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"seed must be an integer, 0 or above, got {seed!r}")
    if artificial is None:
        return
    check_counts(artificial=artificial)
    if positions is not None:
        raise InputError(
            "artificial stars tell how stars are found, those of positions are given: leave artificial or positions out"
        )


def _check_solution(solution):
    """Raise `InputError` for a solution by whose maps the same star would lie at several places."""
    if solution.estimate.motions is not None:
        raise InputError(
            "the solution has motions of stars, which a catalogue does not fit yet: solve exposures of one epoch"
        )
    if "group" in solution.stars.colnames:
        raise InputError(
            "no star ties some detectors of the solution to others, so that a star that they share would lie at two "
            "places: dither over the gaps, or solve and catalogue the detectors of each group by themselves"
        )


def _read(frame, views, grid, options, folder):
    """The layer of an image, its pixels on the disk of a folder if there is one."""
    layer = read_layer(frame, views[frame.name], grid, options)
    if folder is not None and not isinstance(layer, str):
        layer.scene.replace_planes(partial(moved, folder=folder))
    return layer
