"""Finds the hits of rays: primary hits, traced hits on Gaussians and meshes, and the waves of reflected rays."""
