"""Known distortions in all forms, and cameras: several detectors in one focal plane."""
