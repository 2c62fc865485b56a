"""The one place where arrays of a fit become a `Solution`, in the order and the words of the user."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..geometry.epochs import ONE_EPOCH
from ..results.diagnostics import Diagnostics
from ..results.estimate import Estimate
from ..results.motions import StarMotions
from ..results.solution import Solution
from ..runtime import provenance
from .checks.night_departures import found_nights
from .checks.solution_checks import check_solution
from .equations import criterion
from .equations.elimination import inverse_star_blocks
from .equations.star_terms import packed


def assemble(matches, problem, state, blocks, gauge, uncertainty, *, settings, status, dof, chi2=None,
             diagnostics=None, form=None):  # fmt: skip
    """A solution from where a fit ended.

    Parameters
    ----------
    matches : Matches
    problem : Problem
        Made of them, with the weights that were in force: zero for what was not used.
    state : State
    blocks : Blocks
        With these weights, at this state.
    gauge : Gauge
    uncertainty : Uncertainty
    settings : Settings
    status : str
    dof : int
    chi2 : float, optional
        That of the blocks, if not given.
    diagnostics : Diagnostics, optional
    form : `legdistort.solving.model_forms.Form`, optional

    Returns
    -------
    Solution
    """
    table = QTable(matches.table, copy=False)
    table["dx"], table["dy"] = u.Quantity(problem.in_table_order(blocks.residual), u.pix, copy=False)
    table["used"] = problem.in_table_order(problem.weight[0] > 0)
    motions = _motions(problem, state, blocks) if problem.terms.n else None
    positions = state.positions.T.copy()
    positions[blocks.v[0] <= 0] = np.nan
    return Solution(
        names=problem.names,
        degree=problem.degree,
        poses=dict(zip(problem.names, state.poses, strict=True)),
        coefficients=state.coefficients if form is None else form.hold(problem.names, state.coefficients),
        residuals=table,
        chi2=blocks.chi2 if chi2 is None else chi2,
        dof=dof,
        status=status,
        gauge=replace(gauge, responses=uncertainty),
        settings=settings,
        diagnostics=Diagnostics() if diagnostics is None else diagnostics,
        sky=matches.sky,
        left_out=dict(sorted(matches.left_out.items())),
        provenance=provenance.stamp(),
        camera=matches.camera,
        estimate=Estimate(
            star_names=np.asarray(matches.stars),
            positions=positions,
            shapes=dict(matches.shapes),
            prior_mean=problem.prior_mean,
            uncertainty=uncertainty,
            motions=motions,
            form=form,
            nights=cache(partial(found_nights, problem=problem, state=state, blocks=blocks)),
            checked=partial(
                check_solution,
                problem=problem,
                state=state,
                blocks=blocks,
                uncertainty=uncertainty,
                times=matches.times,
                header_distortion=matches.header_distortion if problem.static_errors.knows_nothing else None,
            ),
        ),
    )


def _motions(problem, state, blocks):
    """The `StarMotions` of a state."""
    terms, used = problem.terms, problem.weight[0] > 0
    values = state.stars[2:].T.copy()
    determined = inverse_star_blocks(blocks.v)[np.diag(packed(problem.n_star))[2:]].T > 0
    values[~determined] = np.nan
    years, star = terms.years[problem.exposure[used]], problem.star[used]
    order = np.lexsort([years, star])
    years, star = years[order], star[order]
    new = np.diff(star, prepend=-1) != 0
    first, last = np.flatnonzero(new), np.append(np.flatnonzero(new)[1:], len(star)) - 1
    later = ~new & (np.diff(years, prepend=0.0) > ONE_EPOCH)
    span = np.zeros(problem.n_stars)
    span[star[first]] = years[last] - years[first]
    return StarMotions(
        names=terms.names,
        values=values,
        epoch=terms.epoch,
        years=terms.years,
        chi2=np.bincount(problem.star, criterion.squares(problem, blocks.residual), problem.n_stars),
        n_epochs=np.bincount(star[first], minlength=problem.n_stars)
        + np.bincount(star[later], minlength=problem.n_stars),
        span=span,
    )
