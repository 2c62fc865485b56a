"""How much of the light of a star each exposure has: zero points, from the stars themselves."""

import numpy as np
from scipy.ndimage import map_coordinates

_BRIGHT = 50.0  # signal-to-noise ratio of the stars that determine them
_FEWEST = 5  # stars: with fewer that are bright, the brightest that there are
_LOOK = 50  # stars, at least, the brightest, of which it is looked which are seen
_OUTLIER = 5.0  # deviations from the median
_ROUNDS = 3


def start(field, xy, left_out):
    """Stars of known places put into a `JointScene` that has none, with fluxes and transmissions by a matched filter.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
    xy : ndarray, shape (n, 2)
        In the reference plane.
    left_out : ndarray of bool, shape (m, n)
        Images that do not tell where a star is.
    """
    light, norm = np.zeros((2, len(field.layers), len(xy)))
    for k, layer in enumerate(field.layers):
        signal, weight = layer.scene.likelihood()
        pixel = np.nan_to_num(layer.local(xy)[0], nan=-9.0)[:, ::-1].T
        signal, weight = (map_coordinates(each, pixel, order=1, output=float) for each in (signal, weight))
        seen = weight > 0
        light[k, seen], norm[k, seen] = signal[seen] / weight[seen], weight[seen]
    error = np.where(norm > 0, np.maximum(norm, 1e-30) ** -0.5, np.inf)
    for _ in range(_ROUNDS):
        t = np.array([[layer.transmission] for layer in field.layers])
        total = (t**2 * norm).sum(axis=0)
        flux = (t * norm * light).sum(axis=0) / np.maximum(total, 1e-30)
        for layer, own, its in zip(field.layers, light, error, strict=True):
            layer.transmission = _ratio(own, its, flux, flux * np.sqrt(total))[0]
    seen = total > 0
    field.add(xy[seen], np.maximum(flux, 3 / np.sqrt(np.maximum(total, 1e-30)))[seen])
    for layer, out in zip(field.layers, left_out, strict=True):
        layer.trusted = ~out[seen]


def update(field):
    """Transmissions by the fluxes that the stars have in each exposure now; their relative errors by layer."""
    snr, errors = field.snr(), []
    for layer in field.layers:
        stars, t = layer.stars, layer.transmission
        order = np.argsort(-snr[stars], kind="stable")
        order = order[: max(np.count_nonzero(snr[stars] >= _BRIGHT), _LOOK)]
        flux, error = field.fluxes(layer, order)
        layer.transmission, error = _ratio(t * flux, t * error, field.flux[stars[order]], snr[stars[order]], t)
        errors.append(error / layer.transmission)
    level = np.exp(np.mean([np.log(layer.transmission / layer.unit) for layer in field.layers]))
    for layer in field.layers:
        layer.transmission /= level
    field.flux *= level
    field.refresh()
    return np.array(errors)


def _ratio(light, error, flux, snr, known=1.0):
    """Light over flux of the bright stars, and its error; `known` and infinite without a star."""
    use = np.isfinite(error) & (flux > 0)
    limit = min(_BRIGHT, np.sort(snr[use])[-min(_FEWEST, use.sum())]) if use.any() else _BRIGHT
    use &= snr >= limit
    if not use.any():
        return known, np.inf
    ratio, sigma = light[use] / flux[use], error[use] / flux[use]
    middle = np.median(ratio)
    spread = 1.4826 * np.median(np.abs(ratio - middle))
    sigma = np.hypot(sigma, spread)
    use = np.abs(ratio - middle) <= _OUTLIER * sigma
    weights = 1 / sigma[use] ** 2
    mean = float((weights * ratio[use]).sum() / weights.sum())
    return (mean if mean > 0 else known), float(weights.sum() ** -0.5)
