"""Data sets for computer vision: random views of a scene with depth, normals, masks and other layers."""

from lumisplat.dataset.finish import DatasetSummary as DatasetSummary, finish_dataset as finish_dataset
from lumisplat.dataset.labels import DatasetThing as DatasetThing, DatasetView as DatasetView
from lumisplat.dataset.views import DatasetViews as DatasetViews, render_dataset as render_dataset

__all__: list[str]
