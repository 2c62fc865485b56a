"""Which detections are the same star."""
