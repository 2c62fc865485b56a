"""The numbers behind a solution: arrays of stars and exposures, and their covariances."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..geometry.distortion import Distortion
from ..geometry.tabulated.covariance_table import CovarianceTable
from ..geometry.tabulated.displacement_table import DisplacementTable
from ..runtime.trees.facts import array
from .errors.camera_errors import CameraErrors
from .errors.coefficient_covariance import Coupled, exposure_block
from .errors.common_maps import CommonFit
from .gauge import UnknownDirection
from .motions import StarMotions

if TYPE_CHECKING:
    from ..solving.equations.covariances import Uncertainty


@dataclass(frozen=True, eq=False)
class Estimate:
    """The numbers behind a `Solution`, in the order of its exposures and stars.

    Attributes
    ----------
    star_names : ndarray, shape (n_stars,)
        Sorted.
    positions : ndarray, shape (n_stars, 2)
        X_ref, reference-plane pixels; NaN for a star without a used observation.
    shapes : dict
        ``{exposure: (ny, nx)}``, of the focal plane where there is one.
    prior_mean : ndarray, shape (n_exposures, 2, n_modes)
        Static distortion A_0 around which the solution lies (zero without a prior).
    uncertainty : Uncertainty
        Covariances in the gauge.
    motions : StarMotions or None
        Motions of the stars, where they were fitted.
    form : `legdistort.solving.model_forms.Form` or None
        The model that was given to `solve`. Files do not keep it: of a solution that was read, `View.model` has the
        usual form, which is the same function.
    checked : callable or tuple of Check
        The checks, or a function that makes them from the solution.
    nights : callable or `legdistort.results.nights.NightsFound`
        What nights show, or a function that makes it from the solution; None where it was not looked for.
    certified : dict
        ``{exposure: Distortion}`` that views have made, or a file has, with their certified inverses; they count as
        long as the coefficients and tables are the same.
    displacement_tables, static_tables : dict
        ``{exposure: DisplacementTable}`` and ``{detector: DisplacementTable}``: what the distortion of an exposure has
        beside its series, of its own and of its detector. `table_of` is the sum.
    table_errors : dict
        ``{exposure: CovarianceTable}``: covariance of what is measured in an exposure with a random field, by the
        errors of field and distortion together, relative to a common map.
    """

    star_names: np.ndarray
    positions: np.ndarray
    shapes: dict[str, tuple[int, int]]
    prior_mean: np.ndarray
    uncertainty: Uncertainty
    motions: StarMotions | None = None
    form: object = None
    checked: Any = field(default=(), repr=False)
    nights: Any = field(default=None, repr=False)
    certified: dict[str, Distortion] = field(default_factory=dict, repr=False)
    displacement_tables: dict[str, DisplacementTable] = field(default_factory=dict)
    static_tables: dict[str, DisplacementTable] = field(default_factory=dict)
    table_errors: dict[str, CovarianceTable] = field(default_factory=dict)

    def table_of(self, exposure: str, detector: str | None) -> DisplacementTable | None:
        """What an exposure has beside its series, by itself and by its detector; None for nothing."""
        own, static = self.displacement_tables.get(exposure), self.static_tables.get(detector or "")
        return own + static if own is not None and static is not None else static if own is None else own

    def certified_as(self, made: Distortion) -> Distortion:
        """The distortion of an exposure as it was made before, or with the inverse of another that is the same map."""
        known = self.certified.get(made.name)
        if known is not None and known.same_as(made):
            return known
        for each in self.certified.values() if made.table is not None else ():  # their inverses take long
            if "inverse" in vars(each) and each.same_as(made, rounding=1e-12):
                made = replace(made, certified=each.inverse)
                break
        self.certified[made.name] = made
        return made


@dataclass(frozen=True, eq=False)
class StoredUncertainty:
    """Covariances as files and pickles have them; see `legdistort.solving.equations.covariances.Uncertainty`."""

    coefficients: np.ndarray | Coupled = field(
        metadata=array(
            "n_exposures 2 n_modes",
            "n_exposures 2 n_modes",
            blocks=("n_exposures", "2 n_modes", "2 n_modes"),
            unit="pix2",
            covariance=True,
        )
    )
    stars: np.ndarray = field(metadata=array(3, "n_stars", unit="pix2", packed=True, nan=True))
    directions: np.ndarray = field(metadata=array("n_stars", 2, "2 n_plane_modes", nan=True))
    weak: tuple[UnknownDirection, ...]
    common: CommonFit | None = None
    star_unknowns: np.ndarray | None = field(
        default=None, metadata=array("n_star_pairs", "n_stars", packed=True, nan=True)
    )
    drift_directions: np.ndarray | None = field(
        default=None, metadata=array("n_stars", "2 + n_terms", "2 n_plane_modes + n_drift", nan=True)
    )
    camera: CameraErrors | None = None

    def of_exposure(self, i: int, n_exposures: int) -> np.ndarray:
        """Covariance of the coefficients of exposure i of so many alone, shape (2 n_modes, 2 n_modes)."""
        return exposure_block(self.coefficients, n_exposures, i)


def plain_covariances(estimate):
    """The `StoredUncertainty` of an `Estimate`: numbers alone, without the equations that they came from."""
    left_out = ("star_unknowns", "drift_directions") if estimate.motions is None else ()
    names = [each.name for each in fields(StoredUncertainty) if each.name not in left_out]
    return StoredUncertainty(**{name: getattr(estimate.uncertainty, name) for name in names})
