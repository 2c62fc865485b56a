"""Options of `legdistort.solve`, checked before anything is computed."""

from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path

import numpy as np

from ..exceptions import InputError
from ..geometry import basis, fitter
from ..geometry.detector_modes import affine_widths
from ..geometry.epochs import year
from ..inputs.references.catalogue import check_stated, read_reference
from ..inputs.references.gaia import check_gaia, gaia_around, is_gaia
from ..inputs.start_poses import POSE_ERRORS, check_place_errors, check_pose_sigma
from ..matching.fields import apart
from ..matching.matches import Matches, alone
from ..results.settings import Settings
from ..results.solution import Solution
from ..runtime.checks import LARGEST, check_choice
from ..runtime.words import CAMERA, DYNAMIC, ERRORS, GAUGES, LOSSES, METHODS, MOTIONS
from .choices import prior_widths
from .choices.degree_choice import AUTO
from .equations.problem import check_error_floor, check_prior
from .knowledge.known_stars import known_stars


class Unasked:
    """The value of an option that was not given: it yields to others that exclude it."""


class _UnaskedInteger(Unasked, int):
    pass


class _UnaskedNumber(Unasked, float):
    pass


#: Total degree, unless the caller gives another, or a model that has one.
DEGREE = _UnaskedInteger(3)
#: Standard errors beyond which an observation is left out, unless the caller gives another limit.
CLIP = _UnaskedNumber(5.0)


@dataclass(frozen=True, eq=False)
class SolveOptions(Settings):
    """Those arguments of `legdistort.solve` that can be judged without data, with the prior and the model themselves.

    Raises
    ------
    InputError
        For options that are out of range or contradict one another.
    """

    degree: int | str = DEGREE
    clip: float | None = CLIP

    def __post_init__(self):
        object.__setattr__(self, "motion_epoch", year(self.motion_epoch))
        object.__setattr__(self, "layout_sigma", check_place_errors(self.layout_sigma, "layout_sigma"))
        self._check_distortion()
        self._check_published()
        check_error_floor(self.error_floor)
        if self.pixel_scale is not None and not (isinstance(self.pixel_scale, Real) and 0 < self.pixel_scale < np.inf):
            raise InputError(f"pixel_scale must be a positive number of arcsec, got {self.pixel_scale!r}")
        check_choice(self.loss, LOSSES, "loss")
        check_choice(self.errors, ERRORS, "errors")
        if self.errors != "stated" and self.loss != "linear":
            raise InputError(
                f"errors={self.errors!r} compares chi2 with its expectation, which loss={self.loss!r} changes; use clip"
            )
        if self.errors in ("floor", "correlated") and self.error_floor:
            raise InputError(f"errors={self.errors!r} finds the error floor itself: leave error_floor out")
        if self.errors == "by-brightness" and self.error_floor:
            raise InputError("errors='by-brightness' finds the errors, their floor too: leave error_floor out")
        if self.max_iterations is not None and not (isinstance(self.max_iterations, int) and self.max_iterations > 0):
            raise InputError(f"max_iterations must be a positive integer, got {self.max_iterations!r}")
        self._check_motion()
        self._check_nights()
        if self.terms and self.validate is not None:
            raise InputError("terms do not go with validate, for which stars kept out have none: leave one of them out")
        if self.clip is not None and not (isinstance(self.clip, Real) and 1 < self.clip < LARGEST):
            raise InputError(
                f"clip must be a number of standard errors above 1, got {self.clip!r}; clip=None (--clip 0) keeps all"
            )

    def _check_published(self):
        """Refuse what is the paper's alone."""
        for name, words in (("gauge", GAUGES), ("method", METHODS)):
            value = getattr(self, name)
            if isinstance(value, str) and value in words[1:]:
                raise InputError(
                    f"{name}={value!r} is that of the published method, which legdistort.paper.solve has; leave it out"
                )
            check_choice(value, words[:1], name)

    def _check_nights(self):
        sigma = self.night_sigma
        real = isinstance(sigma, Real) and not isinstance(sigma, bool)
        if sigma is not None and not (real and 0 <= sigma < LARGEST):
            raise InputError(f"night_sigma must be a finite number of pixels, 0 or more, got {sigma!r}")

    def _check_motion(self):
        """What is sought of the motions of stars, and what is known of them beforehand."""
        check_choice(self.motion, (None, *MOTIONS), "motion")
        sigma = self.motion_sigma
        real = isinstance(sigma, Real) and not isinstance(sigma, bool)
        named = isinstance(sigma, str) and sigma == "evidence"
        if sigma is not None and not named and not (real and 0 < sigma < LARGEST):
            raise InputError(f"motion_sigma must be a positive number of pixels a year, or 'evidence', got {sigma!r}")
        if self.motion is None:
            if sigma is not None or self.motion_epoch is not None:
                raise InputError("motion_sigma and motion_epoch belong to motion='proper', 'parallax' or 'auto'")
            return
        for word, excluded in (
            ("pose_sigma", self.pose_sigma is not None),
            ("errors='correlated'", self.errors == "correlated"),
            ("validate", self.validate is not None),
        ):
            if excluded:
                raise InputError(f"motion={self.motion!r} does not go with {word}, for which stars stay where they are")

    def _check_distortion(self):
        """The degree, what is shared, what is known, what is kept out, and a model that states all of it."""
        if not isinstance(self.degree, str):
            basis.check_degree(self.degree)
        elif not self.chooses_degree:
            raise InputError(f"degree must be an integer or {AUTO!r}, got {self.degree!r}")
        real = isinstance(self.validate, Real) and not isinstance(self.validate, bool)
        if self.validate is not None and not (real and 0 < self.validate < 0.5):
            raise InputError(f"validate must be a fraction of the stars between 0 and 0.5, got {self.validate!r}")
        if self.chooses_degree and self.static == "fit":
            raise InputError("static='fit' needs a degree in numbers, not 'auto'")
        self._check_static()
        check_prior(self.prior)
        if self.model is not None:
            self._check_model()

    def _check_model(self):
        if self.chooses_degree or self.static is not None:
            raise InputError("a model states what is fitted in every exposure: leave degree='auto' and static out")
        if self.prior is not None:
            raise InputError("the static distortion is in the coefficients of model: leave prior out")
        fitter.free_coefficients(self.model)  # refuses what is no map of the plane, ties and bounds

    def _check_static(self):
        check_choice(self.static, (None, *CAMERA), "static")
        check_choice(self.layout, (None, *CAMERA), "layout")
        if self.static != "fit":
            if self.exposure_degree is not None:
                raise InputError(
                    "exposure_degree belongs to static='fit', where exposures share the modes above it: give that "
                    "too, or leave exposure_degree out"
                )
            return
        if self.exposure_degree is not None:
            basis.check_degree(self.exposure_degree, "exposure_degree")
        if self.own_degree >= self.degree or self.degree < 2:
            raise InputError(
                f"static='fit' shares the modes above exposure_degree={self.own_degree} up to degree={self.degree}: "
                f"there are none; raise degree to {max(self.own_degree + 1, 2)} or more, or lower exposure_degree"
            )

    @property
    def chooses_degree(self):
        """Whether the degree is to be found from the stars."""
        return self.degree == AUTO

    @property
    def own_degree(self):
        """Up to which degree exposures have modes of their own; None if they share nothing."""
        if self.static != "fit":
            return None
        return 1 if self.exposure_degree is None else int(self.exposure_degree)


def with_stated(matches, pose_sigma, layout, layout_sigma):
    """Matches with the errors of poses and of the layout of detectors that are given, in place of those they state.

    Raises
    ------
    InputError
        For what are no matches, what is no error of a place, and for a layout that is exact, or missing.
    """
    if not isinstance(matches, Matches):
        raise InputError(
            f"matches must be Matches (from match(...) or Matches.from_table(...)), got {type(matches).__name__}"
        )
    if pose_sigma is not None:
        matches = replace(matches, pose_sigma=check_pose_sigma(pose_sigma))
    if layout_sigma is None:
        return matches
    check_detectors(matches.camera.has_focal_plane, layout, None, None, layout_sigma)
    errors = dict.fromkeys(POSE_ERRORS, np.inf) | (check_place_errors(layout_sigma, "layout_sigma") or {})
    if "scale" not in layout_sigma:
        errors["scale"] = np.radians(errors["rotation"])
    detectors = {
        key: replace(each, layout_sigma=affine_widths(errors.values(), each.shape), layout_covariance=None)
        for key, each in matches.camera.detectors.items()
    }
    return replace(matches, camera=replace(matches.camera, detectors=detectors))


def check_detectors(several, layout, static, dynamic, layout_sigma=None):
    """Raise `InputError` for what is no choice, and for choices about a camera without several detectors."""
    given = {"layout": (layout, CAMERA), "static": (static, CAMERA), "dynamic": (dynamic, DYNAMIC)}
    for name, (value, words) in given.items():
        check_choice(value, (None, *words), name)
        if not several and value is not None and name != "static":
            raise InputError(
                f"{name}={value!r} is for exposures with several detectors, and these have one each: leave it out, or "
                "name the camera (camera=, --camera)"
            )
    if layout_sigma is None:
        return
    if not several:
        raise InputError("layout_sigma is for exposures with several detectors, and these have one each: leave it out")
    if layout not in (None, "prior"):
        raise InputError(f"layout_sigma is for layout='prior', got layout={layout!r}: leave one of them out")


def prior_as_asked(prior, static):
    """The prior of plain images with the static distortion as exact ("hold"), or with the widths it has ("prior").

    Raises
    ------
    InputError
        If nothing is known of it, or no uncertainty is stated.
    """
    if static not in ("hold", "prior"):
        return prior
    named = prior if isinstance(prior, dict) else {None: prior}
    if any(each is None or (static == "hold" and not each.states_mean) for each in named.values()):
        raise InputError(
            f"static={static!r} is for a static distortion that is known: give it (prior, --prior), or leave static out"
        )
    if static == "prior" and all(each.static_sigma is None for each in named.values()):
        raise InputError(
            "static='prior' needs the uncertainty of the static distortion (static_sigma of the prior, "
            "--static-sigma): give it, or static='hold'"
        )
    if static == "hold":
        named = {name: each.with_static_sigma(None) for name, each in named.items()}
    return named if isinstance(prior, dict) else named[None]


def check_reference(reference, *, error=None, degree=None, epoch=None):
    """The arguments of `solve` that concern a reference catalogue, checked: the catalogue read, and the epoch in years.

    Raises
    ------
    InputError
        For options out of range and for what is no catalogue.
    """
    epoch = year(epoch)
    if reference is None:
        for name, value in (("reference_error", error), ("reference_degree", degree)):
            if value is not None:
                raise InputError(f"{name} is for the catalogue of reference: leave it out, or give that")
        return None, epoch
    if is_gaia(reference):  # which is asked once it is known where the field lies
        check_gaia()
        check_stated(error, degree)
        return reference, epoch
    is_file = isinstance(reference, (str, Path)) and (Path(reference).is_dir() or Path(reference).suffix == ".asdf")
    solution = Solution.read(reference) if is_file else reference
    if not isinstance(solution, Solution):
        return read_reference(reference, error, degree), epoch
    if error is not None:
        raise InputError("a solution states the errors of its stars: leave reference_error out")
    if degree is not None:
        raise InputError("a solution states what is known of its plane: leave reference_degree out")
    name = reference if is_file else "solution"
    return known_stars(solution, f"the reference {name}"), epoch


def _check_fields(matches, options, reference):
    """Raise `MatchError` for groups of exposures without a common star that share nothing sought or known."""
    if not matches.fields.any():
        return
    prior = options.prior.values() if isinstance(options.prior, dict) else [options.prior]
    known = matches.camera.has_focal_plane or reference is not None or any(each is not None for each in prior)
    if not known and options.static != "fit":
        raise apart(
            matches.observations.groups,
            "solve each group by itself, or all together for the distortion of their detector: static='fit' "
            "(--static fit), or a prior",
        )


def check_tie(matches, asked, reference, **tying):
    """What `check_reference` gives, for these matches and the `SolveOptions` asked for; Gaia is asked here.

    Raises
    ------
    MatchError
        For one exposure without a reference, and groups of exposures that share nothing.
    InputError
        As there; with one exposure for options that compare exposures with one another.
    """
    _check_fields(matches, asked, reference)
    reference = gaia_around(matches) if is_gaia(reference) else reference
    catalogue, epoch = check_reference(reference, **tying)
    if catalogue is not None and catalogue.maps is not None and asked.motion is not None:
        raise InputError(
            f"motion={asked.motion!r} with a solution as reference, of whose rates common errors are not kept: "
            "solve all exposures together, or give its table of stars (stars.ecsv)"
        )
    if catalogue is not None and catalogue.degree and asked.motion is not None:
        raise InputError(
            f"motion={asked.motion!r} with a map of the reference alone (reference_degree) is not supported: "
            "leave one of them out"
        )
    if catalogue is not None and asked.pose_sigma is not None:
        raise InputError(
            "pose_sigma and reference both say where the reference plane lies: take the reference where half a dozen "
            "of its stars or more are on the exposures, and leave pose_sigma (--pose-sigma) out; else leave the "
            "reference (--reference) out"
        )
    if len(matches.names) > 1:
        return catalogue, epoch
    (name,) = matches.names
    if catalogue is None:
        raise alone(name)
    comparing = {"errors": asked.errors != "stated", "degree": asked.chooses_degree}
    sought = ("fit", "prior") if matches.camera.has_focal_plane else ("fit",)
    comparing |= {option: getattr(asked, option) in sought for option in ("static", "layout")}
    comparing |= {option: getattr(asked, option) is not None for option in ("validate", "motion", "layout_sigma")}
    for option in filter(comparing.get, comparing):
        raise InputError(
            f"{option}={getattr(asked, option)!r} compares exposures with one another, and there is only one ({name}): "
            "leave it out"
        )
    if prior_widths.sought(asked.prior):
        raise InputError(
            "sigma='evidence' of the prior (--prior-sigma evidence) is found from several exposures, and there is only "
            f"one ({name}): give widths in pixels (--prior-sigma 0.05), or leave sigma out"
        )
    return catalogue, epoch
