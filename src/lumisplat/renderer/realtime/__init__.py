"""Real-time global illumination over sequences of frames: one host pass a stage, with its kernels beside it."""
