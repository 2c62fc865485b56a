"""How good a co-added image is: sharpness and positions of its stars, against single exposures and other stacks.

All figures come from the same fits (`legdistort.assessment.star_shapes`) on the same stars.
"""

from dataclasses import asdict, dataclass, field, replace

import numpy as np
from astropy.nddata import extract_array
from scipy.spatial import KDTree

from ..coaddition.mosaicking import coadd
from ..exceptions import InputError
from ..geometry import basis
from ..inputs import column_contract
from ..results import accuracy
from ..results.view import image_view
from ..runtime.notebook import ShownAsPrinted
from . import baselines
from .star_shapes import measure_shapes
from .unexplained_light import UnexplainedLight, unexplained_light

#: Name of the single exposures in a comparison of stacks.
SINGLE = "single exposures"
_FEW = 10  # stars: with fewer isolated ones the others count too
_ZOOMS = 3
_ZOOM_HALF = 5, 20  # FWHM, and at least pixels, from the middle of a zoom to its edge
_MEDIAN_DISTANCE = np.sqrt(2 * np.log(2))  # of a Gaussian scatter in two axes, in its standard deviations per axis


@dataclass(frozen=True)
class Quality(ShownAsPrinted):
    """Sharpness and positions of stars in one image, medians over the stars.

    Attributes
    ----------
    n_stars : int
        Measured in all images that are compared.
    fwhm : float
        Geometric mean of the two axes' full widths at half maximum, pixels.
    ellipticity : float
        1 - minor / major axis. Noise makes it positive for round stars too, most so in single exposures.
    peak : float
        Of a star, over its flux within two FWHM of the single exposures, 1 / pixel.
    position : float
        Scatter of the positions about those of the solution, per axis, pixels: from the median distance, so that a
        few blends do not count. In single exposures that of corrected positions.
    fwhm_ratio, peak_ratio : float
        `fwhm` and `peak` over those in single exposures, star by star (NaN without exposures). The second is a
        Strehl ratio with single exposures in place of the diffraction limit.
    exposures : dict
        ``{name: (FWHM [pix], ellipticity, position angle [deg])}``, medians over the stars of single exposures, the
        angle of the major axis from x to y; empty without exposures.
    light : UnexplainedLight or None
        What the stars of the solution do not explain of the image; None where it was not looked for.
    """

    n_stars: int
    fwhm: float
    ellipticity: float
    peak: float
    position: float
    fwhm_ratio: float = np.nan
    peak_ratio: float = np.nan
    exposures: dict = field(default_factory=dict)
    light: UnexplainedLight | None = None

    def __str__(self):
        return (
            f"{self.n_stars} stars: FWHM {self.fwhm:.3f} px ({self.fwhm_ratio:.3f} x single exposures), ellipticity "
            f"{self.ellipticity:.3f}, peak {self.peak_ratio:.3f} x, positions {self.position:.4f} px"
        )


@dataclass(frozen=True, eq=False)
class Zoom:
    """The neighbourhood of one star in several stacks.

    Attributes
    ----------
    star : object
        In the middle.
    place : tuple of float
        Its position on the reference plane of the method.
    cuts : dict
        ``{name: (image, extent)}``; the extent in pixels from the star, as matplotlib takes it.
    fwhm : dict
        ``{name: pixels}``, of the star.
    """

    star: object
    place: tuple
    cuts: dict
    fwhm: dict

    def __repr__(self):
        return f"<Zoom: star {self.star} in {len(self.cuts)} stacks>"


@dataclass(frozen=True, eq=False)
class Stacks(ShownAsPrinted):
    """Stacks made with several corrections, side by side.

    Attributes
    ----------
    qualities : dict
        ``{name: Quality}``: single exposures first, then every correction.
    zooms : list of Zoom
        Star neighbourhoods towards the corners of the field.
    removed : int or "similarity"
        Map that was fitted to the position differences of every stack and taken out: its degree.
    """

    qualities: dict
    zooms: list
    removed: int | str

    def __repr__(self):
        n = next(iter(self.qualities.values())).n_stars
        return f"<Stacks: {len(self.qualities) - 1} corrections, {n} stars, {len(self.zooms)} zooms>"

    def figures(self):
        """The qualities as plain dictionaries, for JSON."""
        return {name: asdict(quality) for name, quality in self.qualities.items()}


def assess(mosaic, solution, *, exposures=(), fwhm=None, max_stars=500):
    """Sharpness and positions of the stars of a co-added image.

    Parameters
    ----------
    mosaic : Mosaic
        On the reference plane (``coadd(grid=None)``).
    solution : Solution
        With which it was made. Its brighter half of the stars is measured, isolated and unsaturated.
    exposures : sequence of Exposure or ExposureFile
        What the image is compared with; read one at a time.
    fwhm : float, optional
        Of the stars [pix], for the size of the cut-outs; by default the median of the positions that were solved.
    max_stars : int
        Not more than so many, the brightest.

    Returns
    -------
    Quality

    Raises
    ------
    InputError
        If the image has another grid, no width is known, or no star can be measured.
    """
    sample = _Sample.of([solution], fwhm, max_stars)
    single = sample.of_exposures(exposures, solution)
    found = sample.of_mosaic(mosaic, solution)
    keep = _common([found], single, bool(len(exposures)))
    quality = _summary(found[keep], single and single[0][keep], sample.positions(solution)[keep])
    light = None if solution.estimate.motions else unexplained_light(mosaic, solution, fwhm=sample.fwhm)
    return replace(quality, exposures=single[2] if single else {}, light=light)


def compare_stacks(exposures, comparison, *, mosaic, fwhm=None, max_stars=500, **coadding):
    """Stacks made with other corrections, measured and seen beside that of the method (paper, Figure "stars2").

    Parameters
    ----------
    exposures : sequence of Exposure or ExposureFile
    comparison : dict
        ``{name: Solution}`` of `legdistort.assessment.baselines.compare`; the last is the method.
    mosaic : Mosaic
        That of the method. The others are made one after the other and not kept.
    fwhm, max_stars
        As for `assess`.
    **coadding
        Options of `legdistort.coadd`, the same for all.

    Returns
    -------
    Stacks
        Positions are compared with those of the method, after the map that the images do not determine (a polynomial of
        the degree fitted, common to all exposures) was taken out of every stack alike.

    Raises
    ------
    InputError
        As for `assess`.
    """
    if baselines.METHOD not in comparison:
        raise InputError(f"comparison must hold {baselines.METHOD!r}, got {', '.join(comparison) or 'nothing'}")
    method = comparison[baselines.METHOD]
    sample = _Sample.of(list(comparison.values()), fwhm, max_stars)
    single = sample.of_exposures(exposures, method)
    places, found, cuts = None, {}, {}
    for name, solution in sorted(comparison.items(), key=lambda item: item[0] != baselines.METHOD):  # the method first
        stack = mosaic if solution is method else coadd(exposures, solution, **coadding)
        found[name] = sample.of_mosaic(stack, solution)
        if places is None:
            places = sample.corners(stack, found[name])
        cuts[name] = [sample.cut(stack, solution, place) for place in places]
        del stack
    found, cuts = ({name: made[name] for name in comparison} for made in (found, cuts))
    keep = _common(found.values(), single, True)
    true = sample.positions(method)[keep]
    removed = next((d for d in range(method.degree, 1, -1) if len(true) >= 3 * basis.n_modes(d)), "similarity")
    each = single[0][keep]
    qualities = {
        SINGLE: _summary(each, each, position=_robust(single[1][:, keep].reshape(-1, 2))),
        **{name: _summary(values[keep], each, true, removed=removed) for name, values in found.items()},
    }
    zooms = [
        Zoom(
            star=sample.stars[place],
            place=tuple(sample.positions(method)[place].tolist()),
            cuts={name: cut[k] for name, cut in cuts.items()},
            fwhm={name: float(values[place, 2]) for name, values in found.items()},
        )
        for k, place in enumerate(places)
    ]
    return Stacks(qualities, zooms, removed)


@dataclass(frozen=True, eq=False)
class _Sample:
    """The stars that are measured everywhere, and the size of their cut-outs."""

    stars: np.ndarray
    fwhm: float

    @classmethod
    def of(cls, solutions, fwhm, max_stars):
        """The brightest isolated stars that all solutions have; the last one knows fluxes and widths."""
        method = solutions[-1]
        if fwhm is None:
            if "fwhm" not in method.residuals.colnames:
                raise InputError(
                    "the positions came without a column fwhm: give fwhm=, the width of the stars in pixels"
                )
            fwhm = float(np.nanmedian(column_contract.values(method.residuals, "fwhm", "pix")))
        if not (np.isfinite(fwhm) and 0.5 <= fwhm <= 200):
            raise InputError(f"fwhm must be a number between 0.5 and 200 pixels, got {fwhm!r}")
        if max_stars < 1:
            raise InputError(f"max_stars must be at least 1, got {max_stars!r}")
        good = np.isfinite(method.estimate.positions).all(axis=1)
        for solution in solutions[:-1]:
            good &= np.isin(
                method.estimate.star_names, solution.estimate.star_names[np.isfinite(solution.estimate.positions[:, 0])]
            )
        flux = column_contract.values(method.stars, "flux") if "flux" in method.stars.colnames else np.ones(len(good))
        bright = good & (flux >= np.nanmedian(flux[good])) if good.any() else good
        chosen = np.flatnonzero(bright)
        tree = KDTree(method.estimate.positions[np.isfinite(method.estimate.positions).all(axis=1)])
        if len(chosen) and tree.n > 1:
            isolated = tree.query(method.estimate.positions[chosen], k=2)[0][:, 1] > 3 * fwhm + 1
            chosen = chosen[isolated] if np.count_nonzero(isolated) >= _FEW else chosen
        chosen = chosen[np.argsort(-flux[chosen], kind="stable")[:max_stars]]
        return cls(np.asarray(method.estimate.star_names)[np.sort(chosen)], float(fwhm))

    def positions(self, solution):
        """Reference positions (n, 2) of the stars, in the plane of a solution."""
        return solution.estimate.positions[np.searchsorted(solution.estimate.star_names, self.stars)]

    def of_mosaic(self, mosaic, solution):
        """`measure_shapes` of a mosaic, positions on the reference plane."""
        if mosaic.offset is None:
            raise InputError("the mosaic is not on the reference plane; make one with coadd(..., grid=None)")
        found = measure_shapes(mosaic.data, self.positions(solution) - mosaic.offset, fwhm=self.fwhm)[:, :5]
        found[:, :2] += mosaic.offset
        return found

    def of_exposures(self, exposures, solution):
        """Medians of `measure_shapes` over the exposures (n, 5), offsets of corrected positions (n_exp, n, 2), and
        ``{exposure: (FWHM, ellipticity, position angle)}``, medians over the stars.

        A star that is saturated, or cannot be measured for another reason, in every exposure is NaN.
        """
        shapes, offsets, medians = [], [], {}
        for handle in exposures:
            view = image_view(solution, handle)
            if view is None:
                continue
            exposure, rows = handle.read(), view.residuals
            rows = rows[rows["used"] & np.isin(rows["star"], self.stars)]
            xy = np.full((len(self.stars), 2), np.nan)
            xy[np.searchsorted(self.stars, rows["star"])] = np.column_stack([rows["x"].value, rows["y"].value])
            found = measure_shapes(exposure.data, xy, fwhm=self.fwhm, bad=exposure.mask, saturation=exposure.saturation)
            seen = np.isfinite(found[:, 0])
            offset = np.full_like(xy, np.nan)
            offset[seen] = view.correct(found[seen, :2]) - self.positions(solution)[seen]
            shapes.append(found[:, :5])
            if seen.any():
                stretch = found[seen, 3] * np.exp(2j * np.radians(found[seen, 5]))
                angle = np.degrees(np.angle(np.median(stretch.real) + 1j * np.median(stretch.imag))) / 2
                medians[exposure.name] = (*np.median(found[seen, 2:4], axis=0).tolist(), float(angle))
            offsets.append(offset)
        if not shapes:
            return None
        with np.errstate(all="ignore"):
            median = np.ma.median(np.ma.masked_invalid(np.stack(shapes)), axis=0)
            return median.filled(np.nan), np.stack(offsets), medians

    @property
    def _zoom_half(self):
        return int(np.ceil(max(_ZOOM_HALF[0] * self.fwhm, _ZOOM_HALF[1])))

    def corners(self, mosaic, found):
        """Stars (indices) for zooms: in three corners the bright one farthest out, exposed all around."""
        half = self._zoom_half
        xy = found[:, :2] - mosaic.offset
        ny, nx = mosaic.shape
        inside = np.isfinite(found).all(axis=1) & ((xy >= half) & (xy < np.array([nx, ny]) - half)).all(axis=1)
        height = np.zeros(len(xy))
        for k in np.flatnonzero(inside):
            x, y = np.round(xy[k]).astype(int)
            height[k] = mosaic.data[y - 1 : y + 2, x - 1 : x + 2].max()
            inside[k] = np.isfinite(mosaic.data[y - half : y + half + 1, x - half : x + half + 1]).all()
        inside &= height >= np.median(height[inside]) if inside.any() else False
        offset = (xy - [nx / 2, ny / 2]) / [nx, ny]
        quadrant, places = 2 * (offset[:, 1] > 0) + (offset[:, 0] > 0), []
        for corner in range(4):
            own = np.flatnonzero(inside & (quadrant == corner))
            if len(own):
                places.append(own[np.argmax(np.abs(offset[own]).min(axis=1))])
        return sorted(places, key=lambda k: -np.hypot(*offset[k]))[:_ZOOMS]

    def cut(self, mosaic, solution, place):
        """Image around a star, and its extent in pixels from the star."""
        half = self._zoom_half
        xy = self.positions(solution)[place] - mosaic.offset
        x, y = np.round(xy).astype(int)
        side = 2 * half + 1
        west, south = np.array([x, y]) - half - 0.5 - xy
        image = extract_array(mosaic.data, (side, side), (y, x), mode="partial", fill_value=np.nan)
        return image.copy(), (west, west + side, south, south + side)  # the mosaic itself is not kept


def _common(found, single, compared):
    """Stars that were measured in all stacks, and in an exposure if there are any to compare with."""
    keep = np.logical_and.reduce([np.isfinite(values).all(axis=1) for values in found])
    if compared:
        if single is None:
            raise InputError("none of the exposures is in the solution, so there is nothing to compare the mosaic with")
        keep &= np.isfinite(single[0]).all(axis=1)
    if not keep.any():
        raise InputError(
            "no star could be measured in the mosaic and the exposures: too few bright, unsaturated stars away from "
            "edges and bad pixels"
        )
    return keep


def _summary(values, single, true=None, *, removed=None, position=None):
    """`Quality` of stars measured (n, 5), given medians in single exposures and true positions."""
    ratios = () if single is None else (float(np.median(values[:, k] / single[:, k])) for k in (2, 4))
    if position is None:
        position = _robust(accuracy.bias_by_star(values[:, :2], true, removed=removed))
    fwhm, ellipticity, peak = map(float, np.median(values[:, 2:], axis=0))
    return Quality(len(values), fwhm, ellipticity, peak, position, *ratios)


def _robust(offsets):
    """Scatter per axis of offsets (n, 2) about zero, from the median distance."""
    return float(np.nanmedian(np.hypot(*offsets.T)) / _MEDIAN_DISTANCE)
