"""Deep Gaussian shadow maps: the atlas, optical depth in closed form, lookups."""
