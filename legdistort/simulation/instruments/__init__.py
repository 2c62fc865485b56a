"""What an instrument measures of stars of given magnitudes: presets, point-spread functions of files, star counts."""
