"""Finds the hits of rays: camera rays' hits, traced hits on Gaussians and meshes, and reflected and refracted rays."""
