"""What there is to render: frozen descriptions over NumPy. Nothing here imports Warp."""
