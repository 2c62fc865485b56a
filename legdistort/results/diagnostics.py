"""What `solve` found out by the way, as its settings keep it, in words."""

import numpy as np

#: Settings that are results, for summaries.
FOUND = "widths", "effective_modes", "departure_ratio", "selection", "validation"


def in_words(settings):
    """Sentences on the widths of a prior, the degree chosen, and the stars that were kept out.

    Parameters
    ----------
    settings : dict
        Of a `legdistort.results.solution.Solution`.

    Returns
    -------
    dict
        ``{"widths" | "modes" | "degree" | "kept": sentence}``, those that there is something to say on.
    """
    words = {}
    if (widths := settings.get("widths")) is not None:
        words["widths"] = f"scatter of a coefficient, found from the exposures: {_widths(widths)}"
    if (effective := settings.get("effective_modes")) and _has_widths(settings.get("prior")):
        number = np.array(list(effective.values()))
        words["modes"] = (
            f"{number.min():.1f} to {number.max():.1f} an exposure, both axes together, are determined by the data, "
            "the others by the prior or the gauge"
        )
        if (ratio := settings.get("departure_ratio")) is not None:
            words["modes"] += (
                f"; departures from the prior mean are {ratio:.2f} of those that its widths lead to expect"
            )
    if (chosen := settings.get("selection")) is not None:
        words["degree"] = chosen["sentence"]
    if (kept := settings.get("validation")) is not None:
        words["kept"] = (
            f"{kept['n_stars']} stars, {kept['n_observations']} observations: they scatter by {kept['scatter']:.4f} px "
            f"per axis, {kept['expected']:.4f} expected from the errors (ratio {kept['ratio']:.2f})"
        )
    return words


def _widths(widths):
    if isinstance(widths, dict):
        return "; ".join(f"{name} {_widths(each)}" for name, each in widths.items() if each is not None)
    return ", ".join(f"{width:.3g}" for width in widths) + " px at degree 1, 2, ..."[: 14 + 3 * len(widths)]


def _has_widths(prior):
    """Whether a description of a prior, or one of a dict of them, has widths."""
    if not isinstance(prior, dict):
        return False
    if "sigma" in prior:
        return prior["sigma"] is not None
    return any(_has_widths(each) for each in prior.values())
