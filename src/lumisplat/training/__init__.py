"""From photographs to Gaussians: parameters, loss, optimiser, and how Gaussians come and go."""
