"""What comes out of `legdistort.solve`, and the files made from it."""
