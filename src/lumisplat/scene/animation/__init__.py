"""Animation: actors and keyframes, rigs with their clips, sequences of frames, Gaussians bound to rigs."""
