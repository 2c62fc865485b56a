"""Predictions as text and tables."""

from itertools import zip_longest

import numpy as np

from ..results.gauge import CURE
from ..runtime.notebook import Column, Grid, Heading, Sentence

#: What a plan can state in place of what is done with exposures.
_CURE = "give a prior (--prior) or its size (--static-sigma), or, in Python, poses of a camera that is turned (poses=)"
_MOTIONS = {"motion": "proper motions, relative [{}/yr]", "motion_abs": "proper motions, absolute [{}/yr]"}
_MOTIONS |= {"parallax": "parallaxes, relative [{}]", "parallax_abs": "parallaxes, absolute [{}]"}


def decimals(prediction, scale=1.0):
    """Decimal places that show three digits of errors like those of a `Prediction`, times a scale."""
    return max(4 if scale == 1 else 0, 3 - int(np.floor(np.log10(scale * prediction.sigma_meas))))


def unit_of(prediction):
    """The unit in which errors are shown, and its number in a pixel."""
    scale = prediction.settings.pixel_scale
    return ("px", 1.0) if scale is None else ("mas", 1e3 * scale)


def finite_rms(values):
    """Rms of those values that are finite; NaN if none is."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else np.nan


def parts(prediction):
    """A `Prediction` as it is shown: both criteria, aliasing where any is assumed, slopes and rules of thumb."""
    solution, instrument = prediction.solution, prediction.settings.instrument
    ny, nx = solution.estimate.shapes[solution.names[0]]
    low, high = prediction.stars_per_exposure.min(), prediction.stars_per_exposure.max()
    unit, scale = unit_of(prediction)
    return [
        Heading(
            f"Prediction: {prediction.n_exposures} exposures of {ny} x {nx} px, {prediction.n_stars} stars "
            f"({low if low == high else f'{low} to {high}'} on each), degree {prediction.degree}, "
            f"errors of {scale * prediction.sigma_meas:.4g} {unit}"
        ),
        _expected(prediction, unit, scale),
        *(Sentence(f"found beside, of the size that is stated: {term!r}") for term in prediction.settings.terms),
        *(() if instrument is None else _by_magnitude(prediction)),
        Sentence(f"All but what is called absolute is relative: {_relative(prediction)}", wrapped=True),
        Sentence(
            f"gauge {solution.gauge.kind}; thumb: s_b = 1/sqrt(n_im), s_sigma = sqrt((1 - 1/n_im)(1 + n_modes/n_star))"
        ),
    ]


def _expected(prediction, unit, scale):
    """The table of the criteria."""
    thumb_b, thumb_sigma = prediction.thumb
    aliased = np.any(prediction.folded != 0)  # NaN included
    places = decimals(prediction, scale)

    def row(label, noise, aliasing=None, *slopes):
        values = [noise]
        if aliased:
            values += [None, None] if aliasing is None else [aliasing, np.hypot(noise, aliasing)]
        cells = ["" if v is None else "not known" if np.isnan(v) else f"{scale * v:.{places}f}" for v in values]
        return [label, *cells, *(f"{slope:.3f}" for slope in slopes)]

    b, sigma = (prediction.b, prediction.b_alias), (prediction.sigma, prediction.sigma_alias)
    rows = [
        row("b, star positions, relative", *b, prediction.s_b, thumb_b),
        row(_absolute(prediction), prediction.b_abs),
        row("sigma, new positions inside the contour", *sigma, prediction.s_sigma, thumb_sigma),
    ]
    if prediction.settings.instrument is not None:
        rows.append(row("of this the error of the correction", prediction.sigma_correction))
    rows.append(
        row("sigma, new positions over the whole field", prediction.sigma_field, finite_rms(prediction.alias_map))
    )
    rows += [row(_MOTIONS[name].format(unit), error) for name, error in prediction.motion_errors.items()]
    heads = ["noise", *(["aliasing", "together"] if aliased else []), "/ sigma", "thumb"]
    labels, *numbers = zip_longest(*rows, fillvalue="")
    columns = [Column(f"expected, rms per axis [{unit}]", labels, 44, words=True)]
    return Grid(columns + [Column(*each, 11) for each in zip(heads, numbers, strict=True)], gap="")


def _by_magnitude(prediction):
    """What an instrument measures, and the errors by magnitude."""
    instrument, stars = prediction.settings.instrument, prediction.by_magnitude()
    bright, faint = instrument.limits
    from_bright = f"from {bright:.2f} " if np.isfinite(bright) else ""
    mag, n, error, joint = zip(*stars.iterrows(), strict=True)
    columns = [
        Column("mag", [f"{each:.1f}" for each in mag], 8),
        Column("stars", list(map(str, n)), 8),
        Column("one exposure [mas]", [f"{each.value:.4g}" for each in error], 22),
        Column("joint [mas]", [f"{each.value:.4g}" for each in joint], 15),
    ]
    yield Sentence(f"{repr(instrument)[1:-1]}: stars {from_bright}to {faint:.2f} mag")
    yield Grid(columns, gap="")


def _absolute(prediction):
    if prediction.solution.gauge.unknown_names and np.isfinite(prediction.b_abs):
        return "b, absolute, without what is not determined"
    return "b, absolute (mean dynamic distortion too)"


def _relative(prediction):
    words = f"what is left once a common map of degree {prediction.degree} is taken off"
    warning = prediction.solution.gauge.warning.replace(CURE, _CURE)
    return "; ".join(filter(None, [words, warning]))


def describe_plans(plans):
    """The table of `Prediction.alternatives` as text: criteria (aliasing if any is known), slopes, rules of thumb."""
    criteria = ["b", "b_alias", "b_abs", "sigma", "sigma_alias", *(f"{name}_error" for name in _MOTIONS)]
    criteria = [c for c in criteria if c in plans.colnames and np.nansum(plans[c]) > 0]
    if (scale := plans.meta["pixel_scale"]) is not None:
        plans = plans.copy()
        units = {name: "mas/yr" if name.startswith("motion") else "mas" for name in criteria}
        for name, unit in units.items():
            places = max(0, int(plans[name].info.format[1:-1]) - int(np.round(np.log10(1e3 * scale))))
            plans[name] = 1e3 * scale * np.asarray(plans[name])
            plans[name].info.format = f".{places}f"
            plans.rename_column(name, f"{name} [{unit}]")
        criteria = [f"{name} [{unit}]" for name, unit in units.items()]
    columns = ["n_exposures", "degree", "n_stars", *criteria, "s_b", "thumb_b", "s_sigma", "thumb_sigma"]
    lines = plans[columns].pformat(max_lines=-1, max_width=-1)
    return "\n".join(lines + [f"{change}: {reason}" for change, reason in plans.meta["failed"].items()])
