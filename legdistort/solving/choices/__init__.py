"""What the exposures themselves say of degree and prior widths."""
