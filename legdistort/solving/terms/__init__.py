"""Terms of the model beside stars, poses and distortions: physics that displaces stars in a way of its own."""
