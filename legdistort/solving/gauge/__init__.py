"""What the data do not determine, and the convention that fixes it."""
