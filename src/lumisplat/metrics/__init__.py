"""How well lighting fits and images agree: each metric by its definition, unit and source. Nothing here imports Warp."""
