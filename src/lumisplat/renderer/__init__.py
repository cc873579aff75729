"""From a scene and a camera to a frame: the passes, each a host module beside its kernels."""
