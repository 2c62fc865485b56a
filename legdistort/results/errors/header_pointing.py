"""How well the headers agree on where the plane lies on the sky, and which of them contradict the stars."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...exceptions import some_of
from ...runtime.trees.facts import number

#: Names in a sentence.
_MOST_NAMED = 6
#: What is done about headers that contradict the others.
CURE = "a reference (--reference) tells where the field lies; legdistort attach writes headers that are right"


@dataclass(frozen=True)
class HeaderPointing:
    """Headers beside the stars: those in use, what they scatter by, and those that contradict them.

    Attributes
    ----------
    n_used : int
        Exposures whose headers agree on where the plane lies; 0 where no majority does, and the sky is not known.
    shift : float
        Least error of the pointing of the plane [pix, per axis], by the scatter of these headers, which does not show
        what all have wrong alike; NaN of a single one.
    turn : float
        That of its rotation [degrees].
    off : dict
        ``{exposure: (pixels, degrees)}`` by which the headers of others are off, and are turned against those in use.
    groups : tuple of tuple of str
        Exposures whose headers agree with one another, where no majority does.
    """

    n_used: int = field(metadata=number(minimum=0))
    shift: float = field(metadata=number(minimum=0, nan=True, unit="pix"))
    turn: float = field(metadata=number(minimum=0, nan=True, unit="deg"))
    off: dict[str, tuple[float, ...]] = field(default_factory=dict)
    groups: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def of_meta(cls, meta: Mapping[str, Any]) -> HeaderPointing:
        """That of plain lists and dicts, as files of matches have it."""
        off = {name: tuple(each) for name, each in meta["off"].items()}
        shift, turn = (float("nan") if meta[key] is None else meta[key] for key in ("shift", "turn"))
        return cls(meta["n_used"], shift, turn, off, tuple(map(tuple, meta["groups"])))

    @property
    def sentence(self) -> str:
        """Which headers contradict the stars, by how much, and what came of it; empty for none."""
        if self.groups:
            listed = " | ".join(some_of(list(group), _MOST_NAMED) for group in self.groups)
            return (
                f"the header WCSs contradict the stars and one another; they are ignored, and the sky stays unknown "
                f"(headers that agree with one another: {listed})"
            )
        if not self.off:
            return ""
        far, turns = max(pixels for pixels, _ in self.off.values()), [abs(turn) for _, turn in self.off.values()]
        turned = ", ".join(dict.fromkeys(f"{turn:.3g}" for turn in turns if turn > 1))
        return (
            f"the header WCS of {some_of(list(self.off), _MOST_NAMED)} contradicts the stars by up to {far:.0f} px"
            f"{f' (turned by {turned} deg)' if turned else ''}; the sky is that of the other headers, {self.n_used} of "
            f"{self.n_used + len(self.off)}"
        )

    def error(self, pixel_scale: float, camera: str = "", errors: tuple[float, float] | None = None) -> str:
        """What their scatter tells of their errors on a sky of this scale [arcsec], in words; empty without scatter.

        That is the least that these can be: guide stars and rolls that all have wrong alike do not scatter. With the
        name of the `camera` that has the scale, and the rotation beside the headers, from a reference, and its
        `header_errors`.
        """
        if not np.isfinite(self.shift):
            return ""
        error = 1000 * pixel_scale * self.shift
        size = f"{error:.2g}" if error < 100 else f"{error:.0f}"
        turn = f", of its rotation {self.turn:.2g} deg" if np.isfinite(self.turn) else ""
        scale = "as they state it"
        if camera:
            of_scale, of_turn = ("", "") if errors is None else (f"{errors[0]:.1g} ", f" ({errors[1]:.1g} deg)")
            scale = (
                f"{of_scale}by a reference of camera {camera}, as is the rotation{of_turn} but for by how much their"
            )
            scale += " rolls differ"
        return (
            f"by their scatter the error of its pointing is {size} mas per axis at least{turn}; what they all have "
            "wrong alike (guide stars, roll) adds to that and is not known; ra_error_abs and dec_error_abs leave this "
            f"out, and the error of its scale, which is {scale}"
        )
