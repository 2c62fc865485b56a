"""From matches to a `Solution`."""
