"""Real-time global illumination over sequences of frames: each stage is a host pass with its kernels beside it."""
