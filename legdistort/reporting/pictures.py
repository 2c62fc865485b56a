"""The pictures of a report, each drawn once, with its sentence."""

from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup

from ..assessment.pulls import exposure_rms
from ..exceptions import FoldError, LegdistortError
from ..plots import (
    completeness_plots,
    motion_plots,
    psf_plots,
    residual_plots,
    solution_plots,
    stack_plots,
    trend_plots,
)
from ..results.accuracy import sizes
from ..results.view import error_map
from .svg import detached_figure, svg_of

#: Spaces between panels that have a title each.
_PANELS = {"wspace": 0.06, "hspace": 0.14, "top": 0.6}


def _quick_figure(*size):
    return detached_figure(*size, layout=None)


@dataclass(frozen=True)
class Picture:
    """A picture of the page.

    Attributes
    ----------
    svg : `~markupsafe.Markup`
    caption : str
    width : int
        Largest on the page, CSS pixels.
    """

    svg: Markup
    caption: str
    width: int


@dataclass
class Gallery:
    """Draws the pictures of one page."""

    drawn: list = field(default_factory=list)

    def add(self, figure, caption, **spaces):
        """The `Picture` of a figure; see `svg_of` for the spaces of one without layout."""
        svg = svg_of(figure, f"p{len(self.drawn)}", **spaces)
        self.drawn.append(Picture(svg, caption, round(96 * figure.get_figwidth())))
        return self.drawn[-1]

    def steps(self, solution):
        """What the correction does; none of one exposure, where a distortion folds, or too few stars show it."""
        if len(solution) < 2:
            return None
        try:
            panels = residual_plots.plot_steps(solution, fig=_quick_figure())
        except LegdistortError:
            return None
        return self.add(
            panels[0].figure,
            "From the mean of each star to its position in every exposure: first with what registration alone does, "
            "last with the distortion of every exposure solved, magnified like the panel before it.",
            top=0.55,
            wspace=0.04,
        )

    def error_map(self, solution):
        """The error of the correction over the exposure with the most stars; none where its distortion folds."""
        name = solution.names[int(np.argmax(exposure_rms(solution)[2]))]
        try:
            drawn = error_map(solution[name])
        except FoldError:
            return None
        ax = solution_plots.plot_sigma_map(*drawn, ax=_quick_figure(6.4, 5.4).subplots())
        return self.add(
            ax.figure,
            "Relative error of the correction, rms per axis, over the exposure with the most stars: what it adds to "
            "that of a new position, once a common map of the fitted degree is taken off. Grey is outside the stars, "
            "where the correction is extrapolated. Absolute errors are those of the row Gauge.",
        )

    def mean_residuals(self, solution):
        """Residuals over the detector."""
        place = "on the detector" if not solution.camera.has_focal_plane else "in the focal plane, with its detectors"
        ax = residual_plots.plot_mean_residuals(solution, ax=_quick_figure(6.0, 6.0).subplots())
        return self.add(
            ax.figure,
            f"Mean residuals of all exposures by their place {place}, with the errors of the means: arrows that leave "
            "their circles over a region would mean a distortion that the polynomials do not follow.",
        )

    def pulls(self, pulls, against):
        """Residuals over those expected."""
        ax = residual_plots.plot_pulls(pulls, against=against, ax=_quick_figure(6.4, 4.2).subplots())
        words = {
            "brightness": "Rms residual of every star over what its errors and the fit lead to expect. Stars above the "
            "band are variable, blended or moving; if all bright ones are, their errors are stated too small.",
            "time": "The same of every exposure, in their order in time.",
        }
        return self.add(ax.figure, words[against])

    def coefficients(self, solution):
        """Coefficients beyond the linear ones; none where there are none."""
        if solution.degree < 2 and not np.any(solution.coefficients[:, :, 3:]):
            return None
        panels = solution_plots.plot_coefficients(solution, lowest=2, fig=_quick_figure())
        return self.add(
            panels[0].figure,
            "Coefficients of the Legendre modes of degree 2 and up, mean of the exposures but for those of nights "
            "that are odd, beside the prior if there is one. Scatter: from one exposure to the next; 1σ error: of one "
            "exposure. Where a few exceed all others by far, the axis is logarithmic beyond its linear middle. Large "
            "values in the highest orders that were fitted would mean a degree too low or too few stars.",
            bottom=0.8,
            left=0.85,
            hspace=0.08,
        )

    def mosaic(self, solution, mosaic):
        """The co-added image."""
        stars = None
        if getattr(mosaic, "offset", None) is not None and len(solution.estimate.star_names) <= 2000:
            stars = solution.estimate.positions - mosaic.offset
        ax = stack_plots.plot_mosaic(mosaic, stars=stars, max_size=800, ax=_quick_figure(7.5, 7.5).subplots())
        return self.add(
            ax.figure,
            "The co-added image less its smooth sky, pale blue where no exposure contributes, the stars of the "
            "solution circled: double or elongated stars, more so towards one edge, would mean that the exposures are "
            "not aligned there.",
        )

    def completeness(self, completeness):
        """What the catalogue of all exposures misses."""
        return self.add(
            completeness_plots.plot_completeness(completeness, ax=_quick_figure(6.4, 4.4).subplots()).figure,
            f"The part of {len(completeness.stars)} artificial stars, put into all exposures at random places, that "
            "the catalogue finds, with binomial errors; above the signal-to-noise ratio of all exposures together. "
            "Less than all bright stars found would mean stars hidden in a crowd.",
            top=0.6,
        )

    def distortions(self, solution):
        """Small multiples of the dozen exposures that depart most: whole distortion, and dynamic part over a prior."""
        departing = np.sort(np.argsort(-sizes(solution)[1], kind="stable")[: solution_plots.PANELS])
        names = [solution.names[i] for i in departing]
        which = "each exposure" if len(names) == len(solution.names) else f"the {len(names)} exposures that depart most"
        part = "nonlinear" if solution.coefficients.shape[2] > 3 else "total"  # shears would hide the rest
        scale = solution_plots.distortion_scale(solution, names, part=part)
        shown = {"names": names, "part": part, "scale": scale}
        panels = solution_plots.plot_distortions(solution, **shown, fig=_quick_figure())
        yield self.add(
            panels[0].figure,
            f"Distortion of {which}{', without its linear part' * (part == 'nonlinear')}, magnified {scale:g} times: "
            "a regular grid (grey) as the detector sees it; a panel unlike the others, or lines that cross or crowd at "
            "an edge, would be worrying.",
            **_PANELS,
        )
        if np.any(solution.estimate.prior_mean):
            shown = {"names": names, "part": "dynamic", "scale": None}
            panels = solution_plots.plot_distortions(solution, **shown, fig=_quick_figure())
            yield self.add(
                panels[0].figure,
                "What is left when the static distortion is taken off, on a scale of its own: the same pattern in all "
                "panels would mean that the static distortion is not that of this instrument any more.",
                **_PANELS,
            )

    def trends(self, solution, pulls, quality):
        """What changes from exposure to exposure."""
        panels = trend_plots.plot_trends(
            solution, pulls.time, pulls.time_label, dynamic=sizes(solution)[1], fig=_quick_figure(),
            fwhm={name: size for name, (size, *_) in ((quality or {}).get("exposures") or {}).items()},
        )  # fmt: skip
        return self.add(
            panels[0].figure,
            "Rotation and scale against their mean, size of the dynamic distortion and, where it was measured, the "
            "seeing of every exposure: a drift is a sign of flexure or of the atmosphere.",
            hspace=0.1,
            left=0.95,
        )

    def motions(self, solution):
        """Proper motions, where they were fitted."""
        if solution.estimate.motions is None or not np.isfinite(solution.estimate.motions.values).any():
            return
        origin = (
            "tied to those of the reference" if solution.gauge.drift.n_tied else "relative to the mean of the stars"
        )
        yield self.add(
            motion_plots.plot_motions(solution, ax=detached_figure(6.0, 6.0).subplots()).figure,
            f"Proper motion of every star with its relative errors, {origin}: groups are stars that belong together; "
            "single ones far off may be mismatched.",
        )
        yield self.add(
            motion_plots.plot_motion_errors(solution, ax=detached_figure(6.4, 5.6).subplots()).figure,
            "Errors of the motions against brightness: stars far above the others are seen less often, or over a "
            "shorter time.",
        )

    def camera(self, camera):
        """The detectors."""
        return self.add(
            camera.plot(ax=detached_figure(6.4, 6.4).subplots()).figure,
            "The detectors in the focal plane with their static distortion, common to all exposures.",
        )

    def psf(self, name, psf):
        """What stars were measured with."""
        return self.add(
            psf_plots.plot_psf(psf, fig=detached_figure())[0],
            f"The effective PSF of {name}, what it leaves of the stars that made it, and how it varies over the field: "
            "rings or lobes of more than some per cent that are left would mean positions that depend on brightness.",
        )
