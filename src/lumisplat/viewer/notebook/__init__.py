"""Live frames in the cells of notebooks."""
