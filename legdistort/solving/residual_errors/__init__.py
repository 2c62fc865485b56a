"""Errors of positions found from the residuals: by brightness, and those that exposures share."""
