"""Parts of frames that several processes or machines render."""

from lumisplat.frame.sample_part import SamplePart
from lumisplat.renderer.shared_samples import merge_samples, render_samples, sample_blocks

__all__ = ["SamplePart", "merge_samples", "render_samples", "sample_blocks"]
