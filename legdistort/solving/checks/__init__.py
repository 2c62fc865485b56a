"""What a referee would ask of a solution, answered from its residuals."""
