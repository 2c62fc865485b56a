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
#: Relative error of the scale from which on it contradicts what the headers state: static distortions and
#: dithers alone, which headers know nothing of, make it some tenths of a per cent.
_SCALE_OFF = 8e-3
#: Errors of the place of the plane by headers of detectors that contradict one another [pix] up to this are said alone.
_APART = 20.0
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
    scale : float
        Least error of the scale of the plane, relative, by the scatter of these headers, in scale and rotation, and of
        sizes of pixels of detectors about theirs; NaN of a single header of one detector.
    detectors : dict
        ``{detector: pixels}`` of a camera by which the headers of some are off; of all of them with NaN where nothing
        shows which are right, and the sky is not known.
    apart : float
        Error of the pointing of the plane [pix, per axis], as headers of detectors contradict one another, and nothing
        shows which of them are wrong; it is in `shift`.
    """

    n_used: int = field(metadata=number(minimum=0))
    shift: float = field(metadata=number(minimum=0, nan=True, unit="pix"))
    turn: float = field(metadata=number(minimum=0, nan=True, unit="deg"))
    off: dict[str, tuple[float, ...]] = field(default_factory=dict)
    groups: tuple[tuple[str, ...], ...] = ()
    scale: float = field(default=float("nan"), metadata=number(minimum=0, nan=True))
    detectors: dict[str, float] = field(default_factory=dict)
    apart: float = field(default=0.0, metadata=number(minimum=0, unit="pix"))

    @classmethod
    def of_meta(cls, meta: Mapping[str, Any]) -> HeaderPointing:
        """That of plain lists and dicts, as files of matches have it."""
        off = {name: tuple(each) for name, each in meta["off"].items()}
        shift, turn = (float("nan") if meta[key] is None else meta[key] for key in ("shift", "turn"))
        scale, detectors = meta.get("scale"), meta.get("detectors", {})
        return cls(
            meta["n_used"], shift, turn, off, tuple(map(tuple, meta["groups"])),
            float("nan") if scale is None else scale,
            {name: float("nan") if each is None else each for name, each in detectors.items()},
            meta.get("apart", 0.0),
        )  # fmt: skip

    @property
    def sentence(self) -> str:
        """Which headers contradict the stars, or those of other detectors, and what came of it; empty for none."""
        return "; ".join(words for words in (self._of_exposures, self._of_detectors, self._of_scale) if words)

    @property
    def is_undecided(self) -> bool:
        """Whether headers that are in use contradict one another so that the sky may be off by much."""
        return self.apart > _APART or self.scale > _SCALE_OFF or any(map(np.isnan, self.detectors.values()))

    @property
    def _of_detectors(self) -> str:
        named, far = some_of(list(self.detectors), _MOST_NAMED), list(self.detectors.values())
        if far and np.isnan(far).any():
            return (
                f"the header WCSs of detectors {named} contradict one another in orientation, parity or scale, and "
                "nothing shows which of them are right: they are ignored, and the sky stays unknown"
            )
        words = []
        if far:
            words.append(
                f"the header WCS of detector {named} contradicts those of the other detectors by up to {max(far):.0f} "
                "px; the sky is that of the others"
            )
        if self.apart > _APART:
            words.append(
                "the header WCSs of detectors contradict one another by more than their scale and rotation explain, "
                "and nothing shows which are right: scale and rotation of the sky are those that each states, its "
                f"place is the mean, with an error of {self.apart:.2g} px per axis"
            )
        return "; ".join(words)

    @property
    def _of_scale(self) -> str:
        if not self.scale > _SCALE_OFF:
            return ""
        return (
            f"the header WCSs contradict the stars in their scale: that of the sky has an error of "
            f"{100 * self.scale:.2g} per cent by how they differ"
        )

    @property
    def _of_exposures(self) -> str:
        """Which headers of exposures contradict the stars, by how much, and what came of it; empty for none."""
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
        scale = f"{self.scale:.1g} of it at least" if self.scale > 0 else "as they state it"
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
