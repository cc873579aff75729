"""Reads and writes files: captures, meshes, scenes, cameras, images, blocks of large captures, training images."""

from lumisplat.dataset.views import load_dataset_config as load_dataset_config
from lumisplat.io.blocks.storage import (
    BlockIndex as BlockIndex,
    open_blocks as open_blocks,
    write_blocks as write_blocks,
)
from lumisplat.io.blocks.stream import PlyStream as PlyStream, can_stream as can_stream, stream_ply as stream_ply
from lumisplat.io.blocks.views import (
    BlockPart as BlockPart,
    WorkerPlan as WorkerPlan,
    all_blocks as all_blocks,
    load_blocks as load_blocks,
    plan_views as plan_views,
    thin_blocks as thin_blocks,
    visible_blocks as visible_blocks,
)
from lumisplat.io.document.entries import SceneEntry as SceneEntry
from lumisplat.io.document.scene_document import SceneDocument as SceneDocument
from lumisplat.io.images.joined_windows import join_windows as join_windows
from lumisplat.io.load_save import (
    change_config as change_config,
    check_format as check_format,
    load as load,
    load_animation as load_animation,
    load_camera_path as load_camera_path,
    load_cameras as load_cameras,
    load_config as load_config,
    load_image as load_image,
    load_radiance as load_radiance,
    load_sequence as load_sequence,
    save as save,
    save_animation as save_animation,
    save_cameras as save_cameras,
    save_config as save_config,
)
from lumisplat.io.training_images.loading import (
    TrainingImage as TrainingImage,
    TrainingImages as TrainingImages,
    load_training_images as load_training_images,
)
from lumisplat.io.training_images.poses import find_poses as find_poses
from lumisplat.io.training_images.video_frames import extract_frames as extract_frames
from lumisplat.scene.animation.actors import GaussianSequence as GaussianSequence

__all__: list[str]
