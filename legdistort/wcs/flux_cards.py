"""The card FLXSCALE of images, by which SWarp multiplies their values before it adds them."""

import logging
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from astropy.io import fits

from ..cameras.star_scales import flux_factors

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FluxCards:
    """FLXSCALE of the images of a solution: the factors by the fluxes of their common stars, where these tell them."""

    solution: Any

    @cached_property
    def factors(self):
        """`~legdistort.cameras.star_scales.FluxFactors`; without any, why there are none."""
        return flux_factors(self.solution)

    def of(self, view):
        """Header with the card of an image; empty where nothing tells it."""
        if self.factors.unknown:
            return fits.Header()
        return fits.Header([("FLXSCALE", self.factors.of(view.name, view.detector), "by stars, to the mean depth")])

    def tell(self, views):
        """Say which factors the texts of some images have, or that they have none."""
        n_all = len(self.solution)
        if n_all < 2:
            log.warning(
                "no FLXSCALE in the text: nothing tells the depth of one exposure alone; with others, solve --base "
                "RESULTS brings it into their solution, and attach --head writes the texts of all of them"
            )
            return
        if self.factors.unknown:
            log.warning(
                "no FLXSCALE in the texts: %s; SWarp adds their values as they are, whatever exposure times and "
                "transparency, unless it is given factors of the files in their order, such as the mean exposure time "
                "over that of each (-FSCALE_DEFAULT 1.2,0.8,...)", self.factors.unknown,
            )  # fmt: skip
            return
        scales = [self.factors.of(view.name, view.detector) for view in views]
        log.info(
            "FLXSCALE %.3g to %.3g by the fluxes of %d stars brings values to an exposure of mean depth; "
            "SWarp leaves it out with -FSCALE_KEYWORD NONE", min(scales), max(scales), self.factors.n_stars,
        )  # fmt: skip
        if (n := len({view.name for view in views})) < n_all:
            log.warning(
                "texts of %d of the %d exposures of the solution: their mean depth is that of all %d, and not that of "
                "texts which another solution wrote; a stack takes all its texts from one", n, n_all, n_all,
            )  # fmt: skip
