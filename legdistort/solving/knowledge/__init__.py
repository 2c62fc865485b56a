"""What is known beforehand as factors, the posterior that they make with the data, and tests of one by the rest."""
