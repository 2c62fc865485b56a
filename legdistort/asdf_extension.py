"""Tells asdf to write `FastLegendre2D` as the stock Legendre2D, so that files need nothing of ours to be read."""

from asdf.extension import Converter, Extension


class FastLegendreConverter(Converter):
    """Defers to the converter of the stock model."""

    tags = ()
    types = ("legdistort.distortion.FastLegendre2D",)

    def select_tag(self, obj, tags, ctx):
        """None: asdf then looks for the type that `to_yaml_tree` returns."""
        return

    def to_yaml_tree(self, obj, tag, ctx):
        """The stock model of the same function."""
        return obj.stock()

    def from_yaml_tree(self, node, tag, ctx):
        """Never called: files hold the stock model only."""
        raise TypeError("FastLegendre2D is never written")


class LegdistortExtension(Extension):
    """Write-only extension; it leaves no trace in files."""

    extension_uri = "asdf://legdistort/extensions/legdistort-1.0.0"
    converters = (FastLegendreConverter(),)
    tags = ()


def extensions():
    """Entry point ``asdf.extensions``."""
    return [LegdistortExtension()]
