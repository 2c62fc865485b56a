"""Degree and prior widths as the exposures themselves determine them."""
