"""A camera of two small detectors."""

import numpy as np

import legdistort


def two_chips_small():
    """Detectors 1 and 2 with a gap of 15 px between them, the second turned, both with a static distortion."""
    angle, static = np.radians(0.4), np.zeros((2, 10))
    static[0, 3], static[1, 5], static[0, 8] = 1.2, -0.7, 0.4
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return legdistort.Camera(
        "TWO",
        {
            1: legdistort.Detector((300, 200), layout=np.eye(2, 3), static=static),
            2: legdistort.Detector((300, 200), layout=np.column_stack([turn, turn @ [-215.0, 1.0]]), static=-static),
        },
    )
