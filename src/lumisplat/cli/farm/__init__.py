"""Makes frames in this process, or with workers on this machine or on a Ray cluster."""
