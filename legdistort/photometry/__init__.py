"""Every star measured in all exposures at once: one position and one flux, the exposures' maps known."""
