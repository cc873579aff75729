"""Deep Gaussian shadow maps: tables of the transmittance from a light through Gaussians.

The method is in docs/method/deep_shadow_maps.md.
"""
