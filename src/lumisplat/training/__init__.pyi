"""Training captures from images with known poses."""

from lumisplat.config import TrainConfig as TrainConfig
from lumisplat.training.run_folder import HeldOutScore as HeldOutScore, forget_training as forget_training
from lumisplat.training.train import TrainResult as TrainResult
from lumisplat.training.trainer import DivergedError as DivergedError

__all__: list[str]
