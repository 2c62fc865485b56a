"""Covariances read from a file."""


class StoredUncertainty:
    """Covariances read from a file; the same attributes as `Uncertainty`."""

    def __init__(self, coefficients, stars):
        self.coefficients, self.stars = coefficients, stars

    def stored(self):
        """The arrays that a file keeps."""
        return {"coefficients": self.coefficients, "stars": self.stars}
