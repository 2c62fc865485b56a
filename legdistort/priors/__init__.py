"""What is known of a static distortion beforehand: maps from objects and files, as Legendre series with widths."""
