"""How good a solution and a mosaic are, compared with other corrections."""
