"""Nights, or other blocks of exposures, of a solution: how well each is fitted, and how far it is from the others."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..inputs import column_contract
from ..runtime.notebook import Column, Grid, Sentence, text_of
from ..runtime.trees.facts import array, number


@dataclass(frozen=True)
class NightTest:
    """How far what the exposures of a night have in common is from the static distortion of the other nights.

    Attributes
    ----------
    departure : float or None
        Pixels, rms length, both axes together, over the detector; None if there are no others.
    ratio : float
        Root of its mean square over that of its errors and of the scatter of the other nights.
    chi2, dof : float
        Of the departure, under the sum of these, in the directions that are determined.
    p : float
        Probability of so large a departure by chance.
    odd : bool
        Whether it is named as one that departs farther than the others do.
    """

    departure: float | None = field(default=None, metadata=number(minimum=0, unit="pix"))
    ratio: float = field(default=0.0, metadata=number(minimum=0))
    chi2: float = field(default=0.0, metadata=number(minimum=0))
    dof: float = field(default=0.0, metadata=number(minimum=0))
    p: float = field(default=1.0, metadata=number(minimum=0, maximum=1))
    odd: bool = False


@dataclass(frozen=True, eq=False)
class NightStatic:
    """The static distortion of a detector that nights scatter about, as known of one that comes.

    Attributes
    ----------
    mean : ndarray, shape (2, n_modes)
        Pixels.
    sigma : ndarray, shape (2, n_modes)
        Of a night that comes: the error of the mean and the scatter of nights; infinite where it is not determined.
    n_nights : int
        From which it was found.
    covariance : ndarray, shape (2 n_modes, 2 n_modes), or None
        That of which `sigma` is the diagonal; None in files that have none.
    """

    mean: np.ndarray = field(metadata=array(2, "n_series", unit="pix"))
    sigma: np.ndarray = field(metadata=array(2, "n_series", unit="pix", minimum=0, infinite=True))
    n_nights: int = field(metadata=number(minimum=1))
    covariance: np.ndarray | None = field(
        default=None, metadata=array("2 n_series", "2 n_series", unit="pix2", covariance=True, infinite=True)
    )


@dataclass(frozen=True, eq=False)
class NightsFound:
    """What nights show: the test of every one, in the order of their numbers, and the static distortion of detectors.

    Attributes
    ----------
    tests : tuple of NightTest
    statics : tuple of NightStatic, or callable
        Of every detector, or a function that makes them; empty where there are no two nights.
    """

    tests: tuple[NightTest, ...] = ()
    statics: tuple[NightStatic, ...] = ()


def blocks(solution):
    """Number of the night (n_exposures,), label of every night (n_nights,), and year (n_exposures,), NaN if unknown."""
    table = solution.residuals
    names, rows = np.unique(column_contract.labels(table, "exposure"), return_index=True)
    first = rows[np.searchsorted(names, solution.names)]
    return column_contract.nights_of(table, first)


def found(solution):
    """The `NightsFound` of a solution, whole; nothing where it was not looked for."""
    nights = _found(solution)
    return replace(nights, statics=nights.statics()) if callable(nights.statics) else nights


def _found(solution):
    nights = solution.estimate.nights
    return (nights(solution) if callable(nights) else nights) or NightsFound()


def table(solution):
    """`Solution.nights`; see there."""
    number, labels, years = blocks(solution)
    observed = solution.residuals[np.asarray(solution.residuals["used"])]
    exposure = column_contract.labels(observed, "exposure")
    order = np.argsort(solution.names)
    night = number[order][np.searchsorted(np.array(solution.names)[order], exposure)]
    offset = np.column_stack([observed[each].to_value(u.pix) for each in ("dx", "dy")])
    stated = np.column_stack([observed[each].to_value(u.pix) for each in ("x_err", "y_err")])
    freedom = offset.size / max(solution.dof, 1)
    rows = []
    for n, (label, test) in enumerate(zip(labels, _found(solution).tests or (NightTest(),) * len(labels), strict=True)):
        mine, own = night == n, number == n
        known = years[own][np.isfinite(years[own])]
        rows.append(
            {
                "name": label,
                "block": n,
                "epoch": known.mean() if len(known) else np.nan,
                "n_exposures": np.count_nonzero(own),
                "n_stars": len(np.unique(observed["star"][mine])),
                "rms": _rms(offset[mine]),
                "rms_ratio": _rms((offset / stated)[mine]) * np.sqrt(freedom),
                "departure": np.nan if test.departure is None else test.departure,
                "ratio": test.ratio,
                "chi2": test.chi2,
                "dof": test.dof,
                "p": test.p,
                "odd": test.odd,
                "exposures": ", ".join(np.array(solution.names)[own]),
            }
        )
    out = NightsTable(rows=sorted(rows, key=lambda row: (not row["odd"], row["p"], -row["ratio"])))
    for name, unit in {"epoch": u.yr, "rms": u.pix, "departure": u.pix}.items():
        out[name] = out[name] * unit
    for name, shown in _FORMATS.items():
        out[name].info.format = shown
    return out


_FORMATS = {"epoch": ".4f", "rms": ".4f", "rms_ratio": ".3f", "departure": ".4f", "ratio": ".2f", "chi2": ".1f"}
_FORMATS |= {"dof": ".0f", "p": ".2g"}


class NightsTable(QTable):
    """Nights, printed with what counts in the width of a terminal: lists of exposures are as long as nights are."""

    def __str__(self) -> str:
        return text_of([_grid(self)]) if {"name", *_SHOWN, "odd"} <= set(self.colnames) else super().__str__()


_SHOWN = "n_exposures", "n_stars", "rms", "rms_ratio", "departure", "ratio", "dof", "p"


def parts(solution):
    """What `print` of a solution shows of them; nothing of a single one."""
    nights = solution.nights
    return [Sentence(), _grid(nights)] if len(nights) > 1 else []


def _grid(nights):
    known = nights["dof"] > 0

    def column(name, head, size, form, unit="", where=None):
        texts = [f"{value:{form}}" for value in np.asarray(nights[name])]
        return Column(head, texts if where is None else np.where(known, texts, where).tolist(), size, unit)

    columns = [
        Column("night", list(nights["name"]), max([10, *map(len, nights["name"])]), words=True),
        column("n_exposures", "exposures", 9, "d"),
        column("n_stars", "stars", 5, "d"),
        column("rms", "rms", 7, ".4f", "px"),
        column("rms_ratio", "rms/error", 9, ".3f"),
        column("departure", "departure", 9, ".4f", "px length", "-"),
        column("ratio", "ratio", 6, ".2f", where=""),
        column("p", "p", 8, ".2g", where=""),
        Column("", [" odd" * bool(odd) for odd in nights["odd"]], words=True),
    ]
    return Grid(columns)


def _rms(values):
    return float(np.sqrt(np.mean(values**2))) if values.size else np.nan
