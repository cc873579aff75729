"""How well lighting fits and images agree: each metric by its definition, unit and source. None of it needs Warp."""
