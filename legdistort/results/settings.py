"""How a solution was asked for."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """How `legdistort.solve` was called, in plain numbers and strings; None for what was left out.

    Attributes
    ----------
    degree : int
        Total degree of the fit; with ``degree="auto"`` the one that was chosen.
    method : str
        "joint", "alternating"; or the name of a simpler correction (`legdistort.assessment.baselines`).
    gauge, static, loss, errors : str or None
    exposure_degree : int or None
        With ``static="fit"``: up to which exposures have modes of their own.
    clip, validate : float or None
    error_floor : float
        As it was stated; for the one in force see `legdistort.results.diagnostics.Diagnostics`.
    max_iterations : int or None
    prior, model : dict or None
        What they were: see `Prior.describe` (by detector or exposure, if they were given so), and ``parts``,
        ``fixed``, ``n_free`` of the model.
    """

    degree: int
    method: str
    gauge: str | None = None
    static: str | None = None
    exposure_degree: int | None = None
    loss: str | None = None
    clip: float | None = None
    errors: str | None = None
    error_floor: float = 0.0
    max_iterations: int | None = None
    validate: float | None = None
    prior: dict | None = None
    model: dict | None = None
