"""How a solution was asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ..runtime.trees.facts import YEARS, number, text

_PIXELS = number(minimum=0, unit="pix")


@dataclass(frozen=True)
class Settings:
    """How `legdistort.solve` was called, in plain numbers and strings; None for what was left out.

    Attributes
    ----------
    degree : int
        Total degree of the fit; with ``degree="auto"`` the one that was chosen.
    prior, model : dict or None
        What they were: see `Prior.describe` (by detector or exposure, if they were given so), and ``parts``,
        ``fixed``, ``n_free`` of the model.
    static, layout, dynamic : str or None
    exposure_degree : int or None
        With ``static="fit"``: up to which exposures have modes of their own.
    gauge, loss, errors : str
    method : str
        "joint", "alternating"; or the name of a simpler correction (`legdistort.assessment.baselines`).
    clip, validate : float or None
    error_floor : float
        As it was stated; for the one in force see `legdistort.results.diagnostics.Diagnostics`.
    motion : {None, "proper", "parallax"}
        What of the motions of stars was fitted; ``motion="auto"`` chose it.
    motion_sigma : float or None
        Scatter of proper motions per axis, pixels a year, that was in force.
    motion_epoch : float or None
        Year of the positions, as it was asked for.
    night_sigma : float or None
        What was stated of the scatter of nights, pixels.
    layout_sigma : dict or None
        What was stated of the errors of the layout: ``shift`` [px], ``rotation`` [deg], ``scale``.
    pose_sigma : dict or None
        Errors of the poses that were known: ``shift`` [px], ``rotation`` [deg], ``scale``.
    terms : tuple of str
        Names of the terms.
    max_iterations : int or None
    pixel_scale : float or None
        Arcsec, as it was stated.
    """

    degree: int | str = field(default=3, metadata=number(minimum=0, maximum=30))
    prior: dict[str, Any] | None = None
    model: dict[str, Any] | None = None
    static: str | None = None
    layout: str | None = None
    dynamic: str | None = None
    exposure_degree: int | None = field(default=None, metadata=number(minimum=0, maximum=30))
    gauge: str = "minimal"
    method: str = "joint"
    loss: str = "linear"
    clip: float | None = field(default=None, metadata=number(minimum=0))
    error_floor: float = field(default=0.0, metadata=_PIXELS)
    errors: str = "stated"
    motion: str | None = field(default=None, metadata=text("proper", "parallax"))
    motion_sigma: float | str | None = field(default=None, metadata=number(minimum=0, unit="pix/yr"))
    motion_epoch: float | None = field(default=None, metadata=YEARS)
    night_sigma: float | None = field(default=None, metadata=_PIXELS)
    layout_sigma: dict[str, float] | None = None
    pose_sigma: dict[str, float] | None = None
    terms: tuple[str, ...] = ()
    max_iterations: int | None = field(default=None, metadata=number(minimum=0))
    validate: float | None = field(default=None, metadata=number(minimum=0, maximum=1))
    pixel_scale: float | None = field(default=None, metadata=number(minimum=0, unit="arcsec"))
