"""Splatting: footprints of Gaussians at pixels, as ellipses or along rays, and the compositors that blend them."""
