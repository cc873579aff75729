"""Commands that lead from photographs to a capture and measure it against them."""
