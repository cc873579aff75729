"""Limits and time constants of the viewer: uploads, levels of detail, frame pacing, JPEG quality and undo."""

UPLOAD_BYTES_MAX = 2**28
"""Largest file that a page may upload, bytes."""

MESSAGE_BYTES_MAX = 2**22
"""Largest message from a page, bytes. Pages upload files in parts of half a megabyte."""

SETTLED_S = 0.25
"""Time without a change after which a view counts as still, seconds. Earlier full frames would flicker during motion.
"""

INTERRUPT_S = 0.5
"""Longest delay until Ctrl+C ends the viewer, seconds."""

LEVEL_FRACTIONS = (1.0, 0.25, 0.0625)
"""Fraction of a capture's Gaussians in each level of detail."""

LEVEL_GAUSSIANS_MIN = 20_000
"""Fewest Gaussians of a scene's level of detail; fewer do not render faster."""

LEVEL_CAPTURE_MIN = 500
"""Fewest Gaussians in a level of one capture. The limit is low because many small captures can form a large scene."""

LEVEL_BLOCK = 2**15
"""Most Gaussians of a capture that are merged at a time. A block takes a third of a second, and moving views get the
processor between blocks."""

LEVEL_DELAY_S = 1.0
"""Longest time that building levels waits for a moving view, seconds, so that the first image comes before the levels.
"""

MOVING_GAUSSIANS_MAX = 500_000
"""Most Gaussians in a moving view whose frame time is not known yet. Larger scenes are thinned until their levels
exist."""

PIXEL_SCALES = (1.0, 0.71, 0.5, 0.35)
"""Width and height of frames of a moving view, as fractions of the size of a still view."""

DETAIL_HEADROOM = 0.75
"""Fraction of the time budget below which the expected time of a finer step must lie before the step is tried."""

DETAIL_HOLD_FRAMES = 8
"""Fewest frames between two refinements, so that a view does not flicker between two steps."""

SAMPLES_AT_REST = 1024
"""Samples per pixel at which a still view is finished, unless the settings specify a number."""

REALTIME_FRAMES_AT_REST = 128
"""Number of realtime frames after which a still view is finished."""

ANSWER_S = 0.5
"""Longest wait for a page to acknowledge its first frame, seconds. After that, frames are sent without waiting."""

BUSY_ANSWER_S = 5.0
"""Longest wait for an acknowledgement by a page that has sent one before, seconds: the page may be busy or hidden."""

DEPTH_STRIDE = 4
"""Step in pixels, along each axis, at which the depth of a frame is sent to the page to occlude gizmos."""

NOISE_AT_REST = 0.005
"""Relative error at which a still view is finished, unless the settings specify a value."""

JPEG_QUALITY_MOVING = 80
"""JPEG quality of a moving view, 1 to 95."""

JPEG_QUALITY_AT_REST = 95
"""JPEG quality of a still view, 1 to 95."""

UNDO_MAX = 200
"""Largest number of edits that can be undone; the states before them stay in memory."""

UNDO_BYTES_MAX = 2**30
"""Memory limit for assets that only the undo history uses, bytes. Beyond it, the oldest edits cannot be undone."""

DRAG_ENDS_S = 1.0
"""Time without movement after which a drag counts as ended, seconds, because its page may have closed."""

BEFORE_SAMPLES = 16
"""Samples per pixel on the left side of the comparison in a still view."""

PLAY_STEPS_PER_S = 30.0
"""Number of times per second that playback advances the animation time."""

DETAIL_TIME_DECAY = 0.995
"""Factor per frame by which the remembered time of a finer step shrinks, so that a slow step is tried again later."""

HEIGHTS = (90, 2160)
"""Smallest and largest image height of a still view, pixels."""

BUDGETS_MS = (10.0, 500.0)
"""Smallest and largest time budget of a frame of a moving view, milliseconds."""

MERGE_S = 1.5
"""Longest time between two edits of one control that are undone as one, seconds."""
