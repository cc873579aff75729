"""From a scene and a camera to a frame: the passes, each as a host module beside its kernels."""
