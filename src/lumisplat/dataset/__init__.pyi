"""Training data for vision: views of a scene at random positions, with layers."""

from lumisplat.dataset.finish import DatasetSummary as DatasetSummary, finish_dataset as finish_dataset
from lumisplat.dataset.labels import DatasetThing as DatasetThing, DatasetView as DatasetView
from lumisplat.dataset.views import DatasetViews as DatasetViews, render_dataset as render_dataset

__all__: list[str]
