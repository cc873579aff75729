"""Files in and out: captures, meshes, scenes, cameras, images, chunks of large captures, training images."""

from lumisplat.dataset.views import load_dataset_config as load_dataset_config
from lumisplat.io.blocks.storage import (
    BlockIndex as BlockIndex,
)
from lumisplat.io.blocks.storage import (
    open_blocks as open_blocks,
)
from lumisplat.io.blocks.storage import (
    write_blocks as write_blocks,
)
from lumisplat.io.blocks.stream import PlyStream as PlyStream
from lumisplat.io.blocks.stream import can_stream as can_stream
from lumisplat.io.blocks.stream import stream_ply as stream_ply
from lumisplat.io.blocks.views import (
    BlockPart as BlockPart,
)
from lumisplat.io.blocks.views import (
    WorkerPlan as WorkerPlan,
)
from lumisplat.io.blocks.views import (
    all_blocks as all_blocks,
)
from lumisplat.io.blocks.views import (
    load_blocks as load_blocks,
)
from lumisplat.io.blocks.views import (
    plan_views as plan_views,
)
from lumisplat.io.blocks.views import (
    thin_blocks as thin_blocks,
)
from lumisplat.io.blocks.views import (
    visible_blocks as visible_blocks,
)
from lumisplat.io.document.entries import SceneEntry as SceneEntry
from lumisplat.io.document.scene_document import SceneDocument as SceneDocument
from lumisplat.io.images.joined_windows import join_windows as join_windows
from lumisplat.io.load_save import (
    change_config as change_config,
)
from lumisplat.io.load_save import (
    check_format as check_format,
)
from lumisplat.io.load_save import (
    load as load,
)
from lumisplat.io.load_save import (
    load_animation as load_animation,
)
from lumisplat.io.load_save import (
    load_camera_path as load_camera_path,
)
from lumisplat.io.load_save import (
    load_cameras as load_cameras,
)
from lumisplat.io.load_save import (
    load_config as load_config,
)
from lumisplat.io.load_save import (
    load_image as load_image,
)
from lumisplat.io.load_save import (
    load_radiance as load_radiance,
)
from lumisplat.io.load_save import (
    load_sequence as load_sequence,
)
from lumisplat.io.load_save import (
    save as save,
)
from lumisplat.io.load_save import (
    save_animation as save_animation,
)
from lumisplat.io.load_save import (
    save_cameras as save_cameras,
)
from lumisplat.io.load_save import (
    save_config as save_config,
)
from lumisplat.io.training_images.loading import (
    TrainingImage as TrainingImage,
)
from lumisplat.io.training_images.loading import (
    TrainingImages as TrainingImages,
)
from lumisplat.io.training_images.loading import (
    load_training_images as load_training_images,
)
from lumisplat.io.training_images.poses import find_poses as find_poses
from lumisplat.io.training_images.video_frames import extract_frames as extract_frames
from lumisplat.scene.animation.actors import GaussianSequence as GaussianSequence
