"""Stars of all exposures that may be two: the exposure that sees it best proposes, all decide."""

import numpy as np

from ..measurement.scene import splitting


def pairs(field, rows):
    """Some stars fitted as two each, as `legdistort.measurement.scene.splitting.pairs` does in one frame.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
    rows : ndarray of int, shape (n,)

    Returns
    -------
    params : ndarray, shape (n, 2, 3)
        x, y [pix] of the reference plane, flux.
    gain : ndarray, shape (n,)
        By how much chi2 falls, summed over the exposures; 0 for sources that are wider than stars.
    """
    out, total, best = np.zeros((len(rows), 2, 3)), np.zeros(len(rows)), np.zeros(len(rows))
    for layer in field.layers:
        there = np.flatnonzero(layer.rows[rows] >= 0)
        if not len(there):
            continue
        own = layer.rows[rows[there]]
        params, gain = splitting.pairs(layer.scene, own)
        total[there] += gain
        better = gain > best[there]
        best[there[better]] = gain[better]
        back = np.linalg.inv(layer.places.slopes(field.xy[rows[there[better]]]))
        step = params[better, :, :2] - layer.scene.xy[own[better]][:, None]
        out[there[better], :, :2] = field.xy[rows[there[better]]][:, None] + np.einsum("nab,nkb->nka", back, step)
        out[there[better], :, 2] = params[better, :, 2] / layer.transmission
    return out, np.where(field.wide[rows], 0, total)
