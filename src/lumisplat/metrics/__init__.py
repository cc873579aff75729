"""Metrics of images, shadows and lighting, each with its definition, unit and source. None of them needs Warp."""
