"""Pictures of finished objects."""
