"""Deep Gaussian shadow maps: how much of a light passes Gaussians, tabulated (docs/method/deep_shadow_maps.md)."""
