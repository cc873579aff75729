"""What leaves the viewer: pictures with all their samples, and captures as a page."""
