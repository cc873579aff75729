"""Deep Gaussian shadow maps: tabulated transmittance of a light through Gaussians (docs/method/deep_shadow_maps.md)."""
