"""Sets of `dense_model.drawn_set` as the package takes them."""

from astropy.table import Table

import legdistort as ld


def as_matches(data):
    """The matches of a set, whose exposures are e00, e01 and so on."""
    names = [f"e{i:02d}" for i in data["exposure"]]
    table = Table({"exposure": names, "star": data["star"], "x": data["xy"][:, 0], "y": data["xy"][:, 1]})
    table["x_err"], table["y_err"] = data["err"].T
    for name in {"colour", "flux", "epoch"} & set(data):
        table[name] = data[name]
    poses = {f"e{i:02d}": pose for i, pose in enumerate(data["poses"])}
    return ld.Matches.from_table(table, shape=(data["n"],) * 2, poses=poses)
