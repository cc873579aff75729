"""What draws the Gaussians that are learnt by rays: traced ones, or those of pixels that are rasterised along them."""
