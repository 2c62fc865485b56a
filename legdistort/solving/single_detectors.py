"""Exposures of a camera as those of its single detectors, each with a pose and a distortion of its own."""

from dataclasses import replace

import numpy as np

from ..cameras.detector import map_alone
from ..cameras.header_layout import compare_headers
from ..exceptions import AssumptionWarning, warn
from ..geometry import basis, similarity
from ..inputs.exposure_names import detector_name
from ..matching.fields import apart
from ..priors.prior import Prior


def by_detector(matches, static):
    """Matches whose exposures are the detectors of every exposure, and what is known of each detector beforehand.

    Where a detector lies is then in the poses of its exposures, but for the shear of its layout.

    Parameters
    ----------
    matches : Matches
        With a camera.
    static : {None, "hold", "prior", "fit"}
        "prior", and None, take the uncertainties that detectors state; "hold" and "fit" leave them out.

    Returns
    -------
    Matches
        Exposures are named as by `legdistort.inputs.exposure_names.detector_name`.
    dict
        ``{detector: Prior}``.

    Raises
    ------
    MatchError
        If detectors have no star in common with others.
    """
    camera, table = matches.camera, matches.camera.on_detectors(matches.table)
    table["detector"] = camera.ids(table)
    parts = list(dict.fromkeys(zip(table["exposure"], table["detector"], strict=True)))
    table["exposure"] = [detector_name(*part) for part in zip(table["exposure"], table["detector"], strict=True)]
    own = {key: _known(detector, static) for key, detector in camera.detectors.items()}
    made = replace(
        matches,
        table=table,
        shapes={detector_name(*part): camera[part[1]].shape for part in parts},
        poses={detector_name(*part): similarity.compose(own[part[1]][0], matches.poses[part[0]]) for part in parts},
        left_out={detector_name(name, key): why for name, why in matches.left_out.items() for key in own},
        camera=None,
        start=None,
    )
    if len(groups := made.observations.groups) > 1:
        raise apart(
            groups,
            "each can be matched and solved by itself, from the frames or star lists of its detectors alone; all "
            "detectors together are solved with a distortion of the focal plane: leave dynamic='detector' (--dynamic "
            "detector) out",
        )
    made.observations.check()
    return made, {key: prior for key, (_, prior) in own.items()}


def headers_of_parts(matches, found):
    """The `HeaderLayout` of detectors that lie where the poses of their exposures have them, in the mean of these.

    Parameters
    ----------
    matches : Matches
        Of whole exposures.
    found : dict
        ``{exposure of one detector: (2, 3)}``.

    Returns
    -------
    `~legdistort.cameras.header_layout.HeaderLayout` or None

    Warns
    -----
    AssumptionWarning
        Of headers that have a detector elsewhere: they do not count for the place on the sky.
    """
    detectors = {}
    for key, each in matches.camera.detectors.items():
        parts = [(found.get(detector_name(name, key)), pose) for name, pose in matches.poses.items()]
        layouts = [similarity.compose(part, similarity.invert(pose)) for part, pose in parts if part is not None]
        if layouts:
            placed = {"layout": np.mean(layouts, axis=0), "layout_sigma": None, "layout_covariance": None}
            detectors[key] = replace(each, **placed)
    headers = compare_headers(detectors)
    if headers is not None and (words := headers.sentence("the stars put it")):
        warn(f"{words}; the place on the sky, its scale and its rotation are by those that agree", AssumptionWarning)
    return headers


def _known(detector, static):
    """The same with what is known of the rest, as a `Prior`."""
    pose, mean = map_alone(detector)
    degree = basis.degree_of(mean.shape[1])
    placed = detector.layout_sigma is None or np.isinf(detector.layout_sigma).all()  # nothing but its shear counts
    widths = [None if placed else detector.layout_sigma, detector.static_sigma]
    sigma = None
    if static in (None, "prior") and any(w is not None for w in widths):
        layout, own = (0.0 if w is None else basis.change_degree(w, degree) for w in widths)
        low = np.arange(basis.n_modes(degree)) < 3
        sigma = np.where(low, layout, own) * np.ones((2, 1))
    return pose, Prior(mean, sigma="evidence" if static != "fit" else None, static_sigma=sigma, shape=detector.shape)
