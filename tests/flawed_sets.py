"""Sets of `dense_model` with one fault that has a cure; numpy alone."""

import dense_model
import numpy as np


def flawed(kind, seed):
    """A set with errors or a distortion that are not those stated; with fluxes, errors go as their inverse."""
    data, rng = dense_model.drawn_set(seed)[0], np.random.default_rng(seed)
    err = data["err"]
    data["flux"] = 1 / err[:, 0]
    if kind == "half":
        data["err"] = err / 2
    elif kind == "double":
        data["err"] = 2 * err
    elif kind == "one for all":
        data["err"] = np.full_like(err, 0.05)
    elif kind == "floor":
        data["xy"] = data["xy"] + 0.03 * rng.normal(size=err.shape)
    elif kind == "degree":
        modes = dense_model.basis(data["xy"], 4, data["n"])[0][:, 10:]
        data["xy"] = data["xy"] + np.einsum("nm,nam->na", modes, 0.1 * rng.normal(size=(11, 2, 5))[data["exposure"]])
    return data


#: What is wrong: the option that cures it.
CURES = {
    "half": ("errors", "scale"),
    "double": ("errors", "scale"),
    "one for all": ("errors", "by-brightness"),
    "floor": ("errors", "floor"),
    "degree": ("degree", "4"),
}
