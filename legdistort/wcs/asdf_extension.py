"""Tells asdf to write our models and WCSs as the stock ones that do the same: files need nothing of ours to be read."""

from asdf.extension import Converter, Extension


class StockConverter(Converter):
    """Defers to the converter of the stock class."""

    tags = ()
    types = (
        "legdistort.geometry.models.FastLegendre2D",
        "legdistort.geometry.models.Similarity2D",
        "legdistort.geometry.tabulated.fast_tabular.FastTabular2D",
        "legdistort.geometry.tangent_plane.PlaneToSky",
        "legdistort.wcs.exposure_wcs.ExposureWCS",
    )

    def select_tag(self, obj, tags, ctx):
        """None: asdf then looks for the type that `to_yaml_tree` returns."""
        return

    def to_yaml_tree(self, obj, tag, ctx):
        """The stock object that does the same; of a series one that shares its parameters, as it is written at once."""
        return obj.stock_view() if hasattr(obj, "stock_view") else obj.stock()

    def from_yaml_tree(self, node, tag, ctx):
        """Never called: files hold stock objects only."""
        raise TypeError("files hold stock objects only")


class LegdistortExtension(Extension):
    """Write-only extension; it leaves no trace in files."""

    extension_uri = "asdf://legdistort/extensions/legdistort-1.0.0"
    converters = (StockConverter(),)
    tags = ()


def extensions():
    """Entry point ``asdf.extensions``."""
    return [LegdistortExtension()]
