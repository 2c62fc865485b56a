"""The WCS of an exposure: gwcs, ASDF file, FITS headers, attached to frames."""
