"""What `lumisplat fit` writes: the scene in the light that was found, and how well that explains photographs."""
