"""Renders rectangular windows of frames, so that several processes or machines can share a frame."""

from lumisplat.frame.sample_part import SamplePart
from lumisplat.renderer.shared_samples import merge_samples, render_samples, sample_blocks

__all__ = ["SamplePart", "merge_samples", "render_samples", "sample_blocks"]
