"""Cameras: several detectors in one focal plane.

The optics and the atmosphere distort the focal plane; detectors are fixed in it. A position f of the focal plane falls
on the pixel ``x = q + sum_m s_m b_m(q)`` of a detector, ``q = P f``. P, an affine map, is the layout of the detector,
and s its static distortion, normalised Legendre modes of orders 2 and more. Both are common to all exposures. What an
exposure adds to them is a distortion of the focal plane as a whole.
"""

from __future__ import annotations

import logging
import re
from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from dataclasses import field as stored
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from scipy.sparse.csgraph import connected_components

from ..exceptions import InputError
from ..geometry import basis, similarity
from ..geometry.gsaoi import GSAOI_SIZE, GsaoiMap
from ..inputs import column_contract
from ..inputs.detector_files import of_files
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import Heading, ShownAsPrinted, text_of
from ..runtime.trees import codec
from ..runtime.trees.facts import SIZE, array, keyed, number
from . import places as found_places
from . import static_correction, storage
from .detector import Detector, Place
from .from_wcs import camera_of, fullest, grid_of, header_map, moved_plane, stated_detectors
from .header_layout import HeaderLayout, compare_headers
from .source import check_shape
from .stated_errors import joint_covariance

if TYPE_CHECKING:
    from astropy.table import QTable, Table
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from ..inputs.exposures import Exposure
    from ..runtime.annotations import Shape, StrPath

log = logging.getLogger(__name__)

#: Headers have detectors alike that agree to this [pix] after one similarity: those of one reference file do so to
#: 1e-4 px, the rounding of FITS headers aside, and headers with what a solution found differ by more.
SAME_OPTICS = 0.02
#: Detectors may lie on each other by this part of their area: layouts to begin with are not exact.
OVERLAP = 0.05
#: Name of the camera of plain images.
IMAGE = "image"
#: Degree of the series that stand for the published distortions of GSAOI: they differ by less than 1e-6 px.
GSAOI_DEGREE = 6
#: Size of a pixel of the focal plane of GSAOI [arcsec], about that of its detectors.
GSAOI_SCALE = 0.0197
#: They may stick out of the field by this part of it: layouts are wrong by pixels, and are moved where they are fitted.
MARGIN = 0.1
_SIDE = 32  # points along a side of a detector that are sought on others


@plain_numbers
@dataclass(frozen=True, eq=False, repr=False)
class Camera(ShownAsPrinted):
    """Detectors in one focal plane, or the one detector of plain images.

    One detector whose layout is the identity is a plain image: its pixels are those of the exposure, its static
    distortion is the prior of `legdistort.solve`, and there is no focal plane beside it (`has_focal_plane`). Exposures
    without a camera have such a one, of the id "1", which nobody needs to write.

    Parameters
    ----------
    name : str
    detectors : dict
        ``{id: Detector}``; ids are strings (numbers become strings), as in the column ``detector`` of tables.
    field : tuple, optional
        ``(ny, nx)`` of the focal plane, whose pixels are counted from 0 as those of a detector. None: the box around
        all detectors, to which the layouts are shifted.
    common_sigma : array_like, shape (2, n_modes), optional
        Uncertainty of a distortion of the focal plane that all detectors have in common, standard deviations of its
        modes in pixels, beside that of each detector; infinite where nothing is known. It is a degeneracy: exposures do
        not distinguish it from one of their own, so that layouts and static distortions found from them do not contain
        it. None: no such uncertainty.
    common_map : array_like, shape (2, n_modes), optional
        That distortion, as exposures had it that a reference tied to the sky: normalised Legendre modes of the focal
        plane, pixels, known to `common_sigma`. It is the static distortion of the focal plane from which further
        exposures depart. None: no reference has told it.
    header_map : array_like, shape (2, 3), optional
        Similarity from the plane of the `header_layout` of the detectors to the focal plane: as the layouts have it,
        but with a `common_map` scale and rotation are as the sky was found, which carries these to headers of further
        exposures. Their pointing stays.
    header_errors : tuple of float, optional
        Standard deviations of the scale (as a part of it) and the rotation [deg] of the `header_map` as the sky was
        found. None: not known, or as the layouts have them.
    place_errors : array_like, shape (n_detectors, 3), optional
        Standard deviations of x, y [pix] and rotation [deg] of the `places` with the `common_map`, after one affine map
        of all detectors, with what layouts and map have in common; infinite where nothing is known. None: the errors of
        both count as independent.
    covariance : array_like, shape (2 n_detectors n_modes, 2 n_detectors n_modes), optional
        Covariance of layouts (orders 0 and 1) and static distortions of all detectors, one after the other, modes of x
        first, px^2, as `legdistort.solve` finds it. Its diagonal are the squares of `layout_sigma` and `static_sigma`
        of the detectors; where these have been changed since, it is left out (None). A prior has it for the next
        exposures, and `correct_table` for errors. None: all modes count as independent.

    Raises
    ------
    InputError
        For no detector, detectors that lie on each other, or outside of the field; a `common_map` without its errors;
        what is no covariance.

    See Also
    --------
    Detector : One of its detectors.
    legdistort.predict : Plan observations with a camera.

    Examples
    --------
    >>> import legdistort as ld
    >>> camera = ld.Camera.gsaoi()
    >>> camera
    <Camera GSAOI: 4 detectors in a focal plane of 4301 x 4276 px>
    >>> camera["2"].to_focal_plane([[100.0, 200.0]]).round(1).shape
    (1, 2)
    """

    name: str
    detectors: dict[str, Detector] = stored(metadata=keyed("id"))
    field: tuple[int, int] | None = stored(default=None, metadata=SIZE)
    common_sigma: np.ndarray | None = stored(
        default=None, metadata=array(2, "modes", unit="pix", minimum=0, infinite=True)
    )
    common_map: np.ndarray | None = stored(default=None, metadata=array(2, "modes", unit="pix"))
    header_map: np.ndarray | None = stored(default=None, metadata=array(2, 3, unit="pix", invertible=True))
    header_errors: tuple[float, float] | None = stored(default=None, metadata=number(minimum=0))
    place_errors: np.ndarray | None = stored(default=None, metadata=array("n_chips", 3, minimum=0, infinite=True))
    covariance: np.ndarray | None = stored(
        default=None, metadata=array("k", "k", unit="pix2", covariance=True, infinite=True)
    )

    def __post_init__(self) -> None:
        if not isinstance(self.detectors, dict) or not self.detectors:
            raise InputError(f"detectors must be a dict {{id: Detector}} with one at least, got {self.detectors!r}")
        for key, detector in self.detectors.items():
            if not isinstance(detector, Detector):
                raise InputError(f"detector {key} must be a legdistort.Detector, got {type(detector).__name__}")
        detectors = {str(key): detector for key, detector in self.detectors.items()}
        for key in detectors:
            if not re.fullmatch(r"[\w.+-]+", key):
                raise InputError(f"ids of detectors become part of file names: letters, digits, _ . + -; got {key!r}")
        first, *others = detectors.values()
        field = first.shape if self.field is None and first.is_plain and not others else self.field
        object.__setattr__(self, "common_sigma", _common(self.common_sigma))
        object.__setattr__(self, "common_map", _common_map(self.common_map, self.common_sigma))
        object.__setattr__(self, "place_errors", _place_errors(self.place_errors, len(detectors)))
        object.__setattr__(self, "covariance", joint_covariance(self.covariance, list(detectors.values())))
        if self.header_map is not None:
            object.__setattr__(self, "header_map", similarity.check(self.header_map, "header_map"))
        if first.is_plain and not others and self.common_sigma is None and field == first.shape:
            object.__setattr__(self, "detectors", detectors)
            object.__setattr__(self, "field", field)
            return
        detectors = {key: each.placed() for key, each in detectors.items()}
        edges = np.concatenate([each.outline for each in detectors.values()])
        low, high = edges.min(axis=0), edges.max(axis=0)
        if field is None:
            first = np.floor(low + 0.5)
            field = tuple(int(n) for n in np.ceil(high - first + 0.5))[::-1]
            if np.any(first):
                detectors = {key: _shifted(each, first) for key, each in detectors.items()}
        field = check_shape(field)
        outside = [key for key, each in detectors.items() if not _within(each, field)]
        if outside:
            raise InputError(
                f"detector{'s' * (len(outside) > 1)} {', '.join(outside)} of camera {self.name} "
                f"lie{'s' * (len(outside) == 1)} outside of the focal plane, {field} (ny, nx); leave field out, or "
                "correct the layouts"
            )
        object.__setattr__(self, "detectors", detectors)
        object.__setattr__(self, "field", field)
        self._check_overlaps()

    def _check_overlaps(self):
        for (first, second), share in overlapping(self.detectors).items():
            raise InputError(
                f"detectors {first} and {second} of camera {self.name} lie on each other by "
                f"{100 * share:.0f} % of their area: correct the layouts (focal plane -> undistorted pixels)"
            )

    @classmethod
    def of_images(cls, shapes: Iterable[Shape]) -> Camera:
        """The camera of plain images: one detector, "1", as large as the largest of the shapes ``(ny, nx)``."""
        shape = tuple(int(n) for n in np.max(list(shapes), axis=0))
        return cls(IMAGE, {"1": Detector(shape)})

    @property
    def has_focal_plane(self) -> bool:
        """Whether the detectors lie in a focal plane that is more than the pixels of one of them."""
        first, *others = self.detectors.values()
        return bool(others) or not first.is_plain or self.common_sigma is not None or self.field != first.shape

    @property
    def is_known(self) -> bool:
        """Whether there is more to it than plain images have: a focal plane, a name, or a static distortion."""
        return self.has_focal_plane or self.name != IMAGE or self.states_static or list(self.detectors) != ["1"]

    @property
    def states_scale(self) -> bool:
        """Whether a reference told how the sky of headers of its kind lies in the focal plane (`header_map`)."""
        return self.common_map is not None and self.header_map is not None

    @property
    def states_static(self) -> bool:
        """Whether anything is known of the static distortion of a detector."""
        return any(np.any(each.static) or each.static_sigma is not None for each in self.detectors.values())

    @property
    def places(self) -> dict[str, Place]:
        """Where the detectors lie, ``{id: Place}``: by their layouts (`Detector.place`), with a bend of all together.

        That is the `common_map` that a reference told, where layouts and static distortions were found, which do not
        contain it; errors then are those after one affine map of all detectors.
        """
        return found_places.places(self)

    def __getitem__(self, key: str) -> Detector:
        """The `Detector` of an id."""
        if str(key) not in self.detectors:
            raise InputError(f"camera {self.name} has no detector {str(key)!r}; it has {', '.join(self.detectors)}")
        return self.detectors[str(key)]

    def in_focal_plane(self, table: Table) -> QTable:
        """A table of positions on detectors with those in the focal plane in their place.

        Parameters
        ----------
        table : `~astropy.table.QTable`
            Columns ``detector``, ``x``, ``y``, ``x_err``, ``y_err`` [pix] and perhaps ``xy_corr``. What has the columns
            ``x_detector`` and ``y_detector`` is in the focal plane already.

        Returns
        -------
        `~astropy.table.QTable`
            With ``x_detector``, ``y_detector`` added: the positions as given.

        Raises
        ------
        InputError
            Without the column ``detector``, or for a detector that the camera does not have.
        """
        if not self.has_focal_plane or "x_detector" in table.colnames:
            return table
        table, detector = table.copy(), self.ids(table)
        xy = np.stack([table["x"].to_value(u.pix), table["y"].to_value(u.pix)], axis=1)
        covariance = column_contract.covariance(table)
        for key in np.unique(detector):
            rows = detector == key
            xy[rows], covariance[rows] = self[key].to_focal_plane(xy[rows], covariance[rows])
        table["x_detector"], table["y_detector"] = table["x"], table["y"]
        table["x"], table["y"] = xy.T * u.pix
        column_contract.set_covariance(table, covariance)
        return table

    @plain_numbers
    def correct_table(self, table: Table, *, sigma: ArrayLike | None = None) -> QTable:
        """Positions in any list of its detectors -> its focal plane, by the static distortion alone, with their errors.

        A single detector has its undistorted pixels in the place of a focal plane. The pose of an exposure stays, and
        what it adds to the static distortion: `Solution.correct_table` takes these off too.

        Parameters
        ----------
        table : `~astropy.table.Table`
            Columns ``x``, ``y`` [pix], and ``detector`` where there are several; ``x_err``, ``y_err`` and perhaps
            ``xy_corr``, without which the errors are those of the correction alone.
        sigma : array_like, optional
            Scatter of exposures about the static distortion, as `sigma` of a `Prior`: over the focal plane of several
            detectors. None leaves it out.

        Returns
        -------
        `~astropy.table.QTable`
            Row by row: ``x``, ``y``; ``x_err``, ``y_err``, ``xy_corr`` by the measurement, the scatter of exposures
            and what is stated of the detectors in a focal plane; ``x_err_abs``, ``y_err_abs`` with the map that all
            exposures have in common, which is the static distortion of a single detector. NaN where that is not known;
            what states no error counts as exact. Further columns are kept, of several detectors ``x_detector`` and
            ``y_detector`` are the positions as given. In the ``meta`` are ``static_error_px`` and
            ``exposure_scatter_px``, rms per axis over the positions.

        Raises
        ------
        InputError
            For a list that lacks columns or has bad values, a detector that the camera does not have, positions off
            their detector by more than a tenth of its size, or images without a static distortion.
        FoldError
            If a static distortion folds.

        Warns
        -----
        AssumptionWarning
            Of positions off their detector by more than a pixel, where the correction is extrapolated.
        """
        return static_correction.correct_table(self, table, sigma)

    def on_detectors(self, table: QTable) -> QTable:
        """A table that `in_focal_plane` made, as it was before."""
        if not self.has_focal_plane:
            return table
        table, detector = table.copy(), self.ids(table)
        f = np.stack([table["x"].to_value(u.pix), table["y"].to_value(u.pix)], axis=1)
        covariance = column_contract.covariance(table)
        for key in np.unique(detector):
            rows = detector == key
            slope = self[key].slope(f[rows])
            covariance[rows] = slope @ covariance[rows] @ slope.mT
        table["x"], table["y"] = table["x_detector"], table["y_detector"]
        column_contract.set_covariance(table, covariance)
        table.remove_columns(["x_detector", "y_detector"])
        return table

    def ids(self, table: Table) -> np.ndarray:
        """Detector of every row of a table, as strings; `InputError` if there is none, or one that is not known."""
        if "detector" not in table.colnames and len(self.detectors) == 1:
            return np.full(len(table), *self.detectors)
        if "detector" not in table.colnames:
            raise InputError(
                f"the table has no column detector, which of {', '.join(self.detectors)} of camera {self.name}: add it"
            )
        detector = np.asarray(table["detector"]).astype(str)
        keys = np.unique(detector).tolist()
        if unknown := [key for key in keys if key not in self.detectors]:
            raise InputError(
                f"camera {self.name} has no detector {unknown[0]!r}; it has {', '.join(self.detectors)}, and the "
                f"column detector has {', '.join(keys)}, not the same numbers each once: rename these in the column, "
                "leave out what is of another instrument, or give the camera of these detectors"
            )
        return detector

    @plain_numbers
    def sees(self, f: ArrayLike) -> np.ndarray:
        """Which positions f (n, 2) of the focal plane fall on each detector, bool (n_detectors, n)."""
        return np.array([each.sees(f) for each in self.detectors.values()])

    @plain_numbers
    def errors_in_focal_plane(self, f: ArrayLike, errors: ArrayLike) -> np.ndarray:
        """Errors (n, 2) at positions f (n, 2), of those measured on the detector there; unchanged off all detectors."""
        out = np.array(errors, dtype=float)
        for each, here in zip(self.detectors.values(), self.sees(f), strict=True):
            back = np.linalg.inv(each.slope(f[here]))
            out[here] = np.sqrt(np.einsum("nab,nb->na", back**2, out[here] ** 2))
        return out

    def groups(self, table: Table) -> list[list[str]]:
        """Lists of detectors that have stars in common, directly or through others.

        Parameters
        ----------
        table : `~astropy.table.Table`
            Columns ``detector`` and ``star``. Detectors without a position are in none.
        """
        keys, group = np.array(list(self.detectors)), self.group_of(table)
        detector = self.ids(table)
        return [[str(key) for key in keys if key in detector[group == g]] for g in range(group.max(initial=-1) + 1)]

    def group_of(self, table: Table) -> np.ndarray:
        """Number of the group of detectors (see `groups`) of every row of a table, int (n,)."""
        _, detector = np.unique(self.ids(table), return_inverse=True)
        _, star = np.unique(np.asarray(table["star"]), return_inverse=True)
        seen = np.zeros((detector.max(initial=-1) + 1, star.max(initial=-1) + 1), dtype=bool)
        seen[detector, star] = True
        _, group = connected_components(seen.astype(int) @ seen.T, directed=False)
        return group[detector]

    def __repr__(self) -> str:
        ny, nx = self.field
        if not self.has_focal_plane:
            return f"<Camera {self.name}: one detector of {nx} x {ny} px>"
        return f"<Camera {self.name}: {len(self.detectors)} detectors in a focal plane of {nx} x {ny} px>"

    def __str__(self) -> str:
        return text_of(self._parts())

    def _parts(self):
        return [Heading(repr(self)[1:-1]), *found_places.parts(self)]

    def to_dict(self) -> dict[str, Any]:
        """Where the detectors lie as numbers and texts for JSON, None where a layout is exact or nothing is known."""

        def stated(place):
            figures = {"x": place.x, "y": place.y, "rotation_deg": place.rotation, "scale": place.scale}
            errors = (None,) * 3 if place.errors is None else place.errors
            errors = [each if each is not None and np.isfinite(each) else None for each in errors]
            return figures | dict(zip(("x_error", "y_error", "rotation_error_deg"), errors, strict=True))

        detectors = [
            {"id": key, "shape": list(self[key].shape), "static_rms_px": self[key].rms} | stated(place)
            for key, place in self.places.items()
        ]
        return {"name": self.name, "field": list(self.field), "detectors": detectors}

    def table_lines(self) -> list[str]:
        """Lines of a table of where the detectors lie, with the errors of that where it is not exact.

        Where nothing is known of that for any detector, a last line says so.
        """
        return text_of(self._parts()[1:]).splitlines()

    @classmethod
    @plain_numbers
    def gsaoi(cls, *, size: int = GSAOI_SIZE) -> Camera:
        """The four detectors of GSAOI at Gemini South, "1" to "4", by the polynomials that DRAGONS uses.

        1 is the lower right one, 2 lower left, 3 upper left, 4 upper right. A pixel of the focal plane is 0.0197
        arcsec. The uncertainty of the published numbers is not known.

        Parameters
        ----------
        size : int
            Pixels along a side of a detector. Other than 2048 it is the same field on coarser or finer pixels.
        """
        shape, detectors = (size, size), {}
        for k in (1, 2, 3, 4):
            published = GsaoiMap(k, size)

            def shift(u, v, published=published):
                q = basis.denormalize(u, v, shape)
                return (published.distort(q) - q).T

            pixel = GSAOI_SCALE * GSAOI_SIZE / size
            scale = np.column_stack([pixel * np.eye(2), np.zeros(2)])
            layout = similarity.compose(similarity.invert(published.similarity), scale)
            static = basis.project(shift, GSAOI_DEGREE, GSAOI_DEGREE + 8)
            detectors[str(k)] = Detector(shape, layout=layout, static=static)
        return cls("GSAOI", detectors)

    def of_detectors(self, exposures: Sequence[Exposure]) -> list[Exposure]:
        """Exposures whose detectors are in files of their own, with their `exposure` and `detector`.

        The detector is the one that the header names (``CCDCHIP``, ``DETECTOR``, ``CHIP``, ``EXTVER`` or ``EXTNAME``),
        the exposure is the name of the file without it. Those read from one file by the name of its extensions are as
        they were.

        Raises
        ------
        InputError
            If a header names no detector of the camera, a file name does not have it, or one is not of this camera
            (`check`).
        """
        if not self.has_focal_plane:
            return list(exposures)
        exposures = of_files(exposures, self.detectors)
        for exposure in exposures:
            self.check(exposure)
        return exposures

    def check(self, exposure: Exposure) -> None:
        """Raise `InputError` unless an exposure is of one of the detectors, by its id and shape."""
        key = exposure.detector
        if key is None:
            raise InputError(
                f"{exposure.name} does not state which detector of camera {self.name} it is: read all extensions of "
                "its file by their name (ext='SCI', --ext SCI)"
            )
        if key not in self.detectors:
            raise InputError(
                f"{exposure.name} is of detector {key}, and camera {self.name} has {', '.join(self.detectors)}: is it "
                "a camera of another instrument? Else leave these extensions out, or give a camera whose ids are those "
                "of the frames (Camera(name, {id: detector}))"
            )
        if exposure.shape != self[key].shape:
            (ny, nx), binned = exposure.shape, ""
            if self.name == "GSAOI" and ny == nx:
                binned = ", as subarrays need it (this camera is of whole detectors), or if pixels are binned give "
                binned += f"Camera.gsaoi(size={nx}), its file (Camera.write) as --camera"
            raise InputError(
                f"{exposure.name} has shape {exposure.shape}, detector {key} of camera {self.name} {self[key].shape} "
                "(ny, nx): is it a camera of another instrument? Else leave the camera "
                f"out, which takes the layout of the headers{binned}"
            )

    @classmethod
    def of_frames(cls, exposures: Sequence[Exposure]) -> Camera:
        """Camera by the headers of that of several exposures which has most detectors, as `from_exposures`.

        Parameters
        ----------
        exposures : list of Exposure
            Of the same camera, with `exposure` and `detector`.
        """
        return cls.from_exposures(fullest(exposures))

    def with_headers(self, exposures: Sequence[Exposure]) -> Camera:
        """The camera with the `header_layout` of its detectors by that of several exposures which has most of them.

        Parameters
        ----------
        exposures : list of Exposure
            Of detectors of this camera, with `exposure` and `detector`. Those without a WCS state nothing.
        """
        stated = stated_detectors(exposures) if self.has_focal_plane else {}
        layouts = {key: stated[key].header_layout if key in stated else None for key in self.detectors}
        detectors = {k: replace(each, header_layout=layouts[k]) for k, each in self.detectors.items()}
        camera = replace(self, detectors=detectors, header_map=None, header_errors=None)
        if not stated:
            return camera
        known = self._carried(stated) if self.states_scale else header_map(camera, stated)
        same = self.states_scale and known is not None
        return replace(camera, header_map=known, header_errors=self.header_errors if same else None)

    def with_header_map(self, found: np.ndarray, errors: tuple[float, float] | None) -> Camera:
        """The camera with scale and rotation of a `header_map` found on the sky (2, 3), the shift as layouts have it.

        And with the `header_errors` of both, where these are known.

        That by which a sky is away from headers is the pointing of these, which is another one in the next visit.
        """
        odd = () if self.headers is None else self.headers.odd
        lie = [each for key, each in self.detectors.items() if each.header_layout is not None and key not in odd]
        pixels = [grid_of(each.shape) for each in lie]
        here, there = (
            np.mean(
                [similarity.apply(similarity.invert(pose), xy) for pose, xy in zip(poses, pixels, strict=True)], (0, 1)
            )
            for poses in ([each.layout for each in lie], [each.header_layout for each in lie])
        )
        turn = np.asarray(found)[:, :2]
        return replace(self, header_map=np.column_stack([turn, here - turn @ there]), header_errors=errors)

    def _carried(self, stated):
        """The `header_map` for headers that have detectors otherwise turned or shifted as a whole; None for others.

        `stated` are ``{id: Detector}`` by these headers.
        """
        if sum(self[key].header_layout is not None for key in stated) > 1:
            step, off = moved_plane(stated, self.detectors)
            if off < SAME_OPTICS:
                return similarity.compose(self.header_map, step)
            words = f"have its detectors {off:.2g} px otherwise"
        else:
            words = "do not have two of its detectors"
        log.warning(
            "the headers %s than those with which a reference tied camera %s: scale and rotation on the sky are as "
            "these headers state them",
            words,
            self.name,
        )
        return None

    @cached_property
    def headers(self) -> HeaderLayout | None:
        """Whether headers have the detectors where they lie (`legdistort.cameras.header_layout`); None without any."""
        return compare_headers(self.detectors) if self.has_focal_plane else None

    @classmethod
    def from_exposures(
        cls, exposures: Mapping[str, Exposure] | Sequence[Exposure], *, name: str | None = None
    ) -> Camera:
        """Camera from the WCSs of the detectors of one exposure (see `legdistort.cameras.from_wcs`).

        Of several detectors the layout is a start value: its `layout_sigma` is infinite, and `legdistort.solve` finds
        it, unless it is held (``layout="hold"``).

        Parameters
        ----------
        exposures : dict or list of Exposure
            ``{id: exposure}``, or images whose headers distinguish the detectors (``CCDCHIP``, ``DETECTOR``, ``EXTVER``
            or ``EXTNAME``), as `legdistort.read_exposures` reads them. FITS WCSs and gwcs, with distortion or without.
        name : str, optional
            By default the instrument of the header.

        Raises
        ------
        InputError
            If the headers do not distinguish the detectors, or a WCS is missing or cannot be followed.
        """
        return camera_of(cls, exposures, name)

    def plot(self, *, ax: Axes | None = None, scale: float | None = None) -> Axes:
        """Draw detectors, gaps and distortion (`legdistort.plots.camera_plots.plot_camera`); returns the axes."""
        from ..plots.camera_plots import plot_camera

        return plot_camera(self, ax=ax, scale=scale)

    def to_meta(self) -> dict[str, Any]:
        """The camera as plain numbers, lists and strings, for the header of a table file; see `from_meta`.

        The `covariance`, which may have 100,000 numbers, is one text: base64 of its rows as little-endian doubles.
        """
        tree = codec.to_tree(replace(self, covariance=None), plain=True)
        if self.covariance is not None:
            tree["covariance"] = b64encode(self.covariance.astype("<f8").tobytes()).decode()
        return tree

    @classmethod
    def from_meta(cls, meta: Mapping[str, Any]) -> Camera:
        """The camera that `to_meta` wrote."""
        if isinstance(meta.get("covariance"), str):
            with suppress(ValueError):  # what is no such text is refused as no matrix
                values = np.frombuffer(b64decode(meta["covariance"], validate=True), "<f8")
                meta = {**meta, "covariance": values.reshape(int(np.sqrt(len(values))), -1)}
        return storage.from_tree(meta, cls)

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write to an ASDF file of plain arrays, numbers and strings; returns the path."""
        return storage.write_camera(self, Path(path), overwrite=overwrite)

    @classmethod
    def read(cls, path: StrPath) -> Camera:
        """Read what `write` wrote.

        Raises
        ------
        InputError
            Naming the file: if it is no camera, or damaged.
        """
        return storage.read_camera(path, cls)


def _common(sigma):
    """`common_sigma` as an array (2, n_modes), or None."""
    if sigma is None:
        return None
    out = np.array(sigma, dtype=float)
    if out.ndim != 2 or len(out) != 2 or not np.all(out >= 0):
        raise InputError(
            f"common_sigma must be standard deviations (2, n_modes) in pixels, none negative or NaN, got {sigma!r}"
        )
    basis.degree_of(out.shape[1])  # refuses a number that is none of modes
    return out


def _common_map(coefficients, sigma):
    """`common_map` as an array (2, n_modes) of as many modes as its errors have; None as None."""
    if coefficients is None:
        return None
    out = np.array(coefficients, dtype=float)
    if out.ndim != 2 or len(out) != 2 or not np.isfinite(out).all():
        raise InputError(f"common_map must be finite numbers (2, n_modes), pixels, got {coefficients!r}")
    if sigma is None or sigma.shape[1] < out.shape[1]:
        raise InputError("common_map needs the errors of all of its modes: give common_sigma (2, n_modes)")
    return basis.change_degree(out, basis.degree_of(sigma.shape[1]))


def _place_errors(errors, n):
    """`place_errors` as an array (n, 3), or None."""
    if errors is None:
        return None
    out = np.array(errors, dtype=float)
    if out.shape != (n, 3) or not np.all(out >= 0):
        raise InputError(f"place_errors must be standard deviations ({n}, 3), none negative or NaN, got {errors!r}")
    return out


def _shifted(detector, first):
    """The detector in a focal plane whose origin lies at `first` of the one before."""
    layout = similarity.compose(detector.layout, np.column_stack([np.eye(2), first]))
    return replace(detector, layout=layout)


def _within(detector, field):
    size, outline = np.array(field[::-1]), detector.outline
    margin = MARGIN * size
    return bool(np.all(outline >= -margin - 0.5) and np.all(outline <= size + margin - 0.5))


def overlapping(detectors):
    """``{(id, id): part of the smaller}`` of ``{id: Detector}`` that lie on each other by more than `OVERLAP`."""
    shares = {pair: _overlap(*(detectors[key] for key in pair)) for pair in combinations(detectors, 2)}
    return {pair: share for pair, share in shares.items() if share > OVERLAP}


def _overlap(first, second):
    """Larger share of one of two detectors that lies on the other."""
    shares = []
    t = (np.arange(_SIDE) + 0.5) / _SIDE * 2 - 1
    for one, other in ((first, second), (second, first)):
        f = one.to_focal_plane(basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), one.shape))
        q = similarity.apply(other.layout, f)  # its distortion is no matter of percents, and means nothing far off
        shares.append(np.mean(np.all((q > -0.5) & (q < np.array(other.shape[::-1]) - 0.5), axis=1)))
    return float(max(shares))


def check_camera(camera):
    """Raise `InputError` unless an argument is a camera, or None."""
    if not isinstance(camera, Camera | None):
        raise InputError(f"camera must be a legdistort.Camera, got {type(camera).__name__}")
