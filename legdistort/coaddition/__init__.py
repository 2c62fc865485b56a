"""From exposures and a `Solution` to a mosaic."""
