"""What moves: actors, keyframes, rigs, clips, sequences and Gaussians bound to them."""
