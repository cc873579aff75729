"""Gaussians rasterised along the rays of any lens: sigma points find the tiles, rays the response (3DGUT)."""
