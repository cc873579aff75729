"""Limits and time constants of the viewer: uploads, levels of detail, frame times, JPEG quality and undo."""

UPLOAD_BYTES_MAX = 2**28
"""Largest file that a page may upload, bytes."""

MESSAGE_BYTES_MAX = 2**22
"""Largest message from a page, bytes. Pages upload files in parts of half a megabyte."""

SETTLED_S = 0.25
"""Longest time since the last change of camera or scene after which a view counts as still and gets full frames,
seconds. Shorter times would make full and reduced frames alternate when the scene changes in steps.
"""

SETTLED_GAPS = 3.0
"""A camera that has sent no message for this many times the usual gap between messages of its motion has stopped, also
if its page has not said so."""

GAP_DECAY = 0.9
"""Factor per message on the largest recent gap between two messages of a camera, so that the gaps before a motion are
forgotten within two dozen messages."""

DIRECT_MS = 150.0
"""Longest time of a full frame for which a camera that its page says has stopped gets no reduced frame before,
milliseconds."""

CLOSE_S = 10.0
"""Longest wait of a closing viewer for the event that it handles, seconds; the event itself may have closed it."""

INTERRUPT_S = 0.5
"""Interval at which the main thread wakes to handle Ctrl+C, seconds; the longest delay until the viewer ends."""

LEVEL_FRACTIONS = (1.0, 0.25, 0.0625)
"""Fraction of a capture's Gaussians that each level of detail keeps, by level number; level 0 keeps all."""

LEVEL_GAUSSIANS_MIN = 20_000
"""Smallest number of Gaussians to which a whole scene is reduced; fewer would not render faster."""

LEVEL_CAPTURE_MIN = 500
"""Smallest number of Gaussians to which a single capture is reduced. The limit is low because many small captures can
form a large scene."""

LEVEL_BLOCK = 2**15
"""Largest number of Gaussians merged at a time when a level of detail is built. Merging a block takes a third of a
second; moving views get the processor between blocks."""

LEVEL_DELAY_S = 1.0
"""Longest time that building the levels of a capture is postponed while a view moves or has no image yet, seconds."""

MOVING_GAUSSIANS_MAX = 500_000
"""Largest number of Gaussians in a moving view's first frame, while its frame time is unknown. Captures of larger
scenes are thinned to every N-th Gaussian until their levels of detail are built."""

PIXEL_SCALES = (1.0, 0.71, 0.5, 0.35)
"""Resolutions that a moving view's frames may have: width and height as fractions of a still view's."""

DETAIL_HEADROOM = 0.75
"""A finer detail step is tried only if its expected frame time is below this fraction of the time budget."""

DETAIL_HOLD_FRAMES = 8
"""Smallest number of frames after a change of the detail step before a finer step is tried, to avoid flicker."""

SAMPLES_AT_REST = 1024
"""Samples per pixel at which a still view stops refining, unless the render settings specify a number."""

REALTIME_FRAMES_AT_REST = 128
"""Number of frames of the realtime pipeline after which a still view stops refining."""

ANSWER_S = 0.5
"""Longest wait for the first acknowledgement of a page, and for each of a notebook cell, seconds. A page that has not
acknowledged by then gets its frames without waiting."""

BUSY_ANSWER_S = 5.0
"""Longest wait for an acknowledgement from a page that has acknowledged a frame before, seconds: it may be busy or
hidden."""

DEPTH_STRIDE = 4
"""Pages get the depth of every N-th pixel of a frame along each axis, N = 4, so that surfaces occlude gizmos."""

NOISE_AT_REST = 0.005
"""Estimated relative error at which a still view stops refining, unless the render settings specify a value."""

JPEG_QUALITY_MOVING = 80
"""JPEG quality, 1 to 95, of images sent to pages while the camera or the scene changes."""

JPEG_QUALITY_AT_REST = 95
"""JPEG quality, 1 to 95, of images sent to pages while neither camera nor scene changes."""

UNDO_MAX = 200
"""Largest number of edits that can be undone. Each undo step keeps the document before its edit in memory."""

UNDO_BYTES_MAX = 2**30
"""Memory limit for captures and meshes that only the undo history holds, bytes; beyond it, the oldest steps are
dropped."""

DRAG_ENDS_S = 1.0
"""Time since a gizmo last moved after which its drag counts as ended, seconds: the page may have closed in the middle.
"""

BEFORE_SAMPLES = 16
"""Samples per pixel of the earlier state that option *compare* shows on the left side of a still view."""

PLAY_STEPS_PER_S = 30.0
"""Number of times per second that playback advances the animation time."""

DETAIL_TIME_DECAY = 0.995
"""Factor per frame on the remembered frame time of a finer detail step that was too slow, so that it is tried again
later."""

HEIGHTS = (90, 2160)
"""Smallest and largest value of the view option ``height``, the image height of a still view, pixels."""

BUDGETS_MS = (10.0, 500.0)
"""Smallest and largest value of the view option ``budget_ms``, the time budget of a moving view's frame, milliseconds.
"""

MERGE_S = 1.5
"""Longest time between two edits of one control that are undone as one, seconds."""
