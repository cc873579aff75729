"""Thresholds of the viewer: what its page may send, and when frames are drawn how finely."""

UPLOAD_BYTES_MAX = 2**28
"""Largest file that a page may upload, bytes."""

MESSAGE_BYTES_MAX = 2**22
"""Largest message from a page, bytes: files come in parts of half a megabyte."""

SETTLED_S = 0.25
"""Time without a change after which a view is at rest, seconds: finer frames before would flicker while it moves."""

INTERRUPT_S = 0.5
"""How late a Ctrl C may end the viewer, seconds."""

LEVEL_FRACTIONS = (1.0, 0.25, 0.0625)
"""Share of the Gaussians of a capture in each of its levels."""

LEVEL_GAUSSIANS_MIN = 20_000
"""Levels of scenes have no fewer Gaussians than this: fewer of them take no less time."""

LEVEL_CAPTURE_MIN = 500
"""Levels of a single capture have no fewer: many small ones make a large scene."""

LEVEL_BLOCK = 2**15
"""Gaussians of a capture that are merged at a time, at most: a third of a second, between which views that move have
the processor to themselves."""

LEVEL_DELAY_S = 1.0
"""How long levels wait for a view that moves before they begin, seconds: the first picture comes before them."""

MOVING_GAUSSIANS_MAX = 500_000
"""Gaussians of a view that moves until it is known how long it takes, at most. Scenes of more are thinned until their
levels are there."""

PIXEL_SCALES = (1.0, 0.71, 0.5, 0.35)
"""Width and height of frames while a view moves, as shares of those at rest."""

DETAIL_HEADROOM = 0.75
"""A finer step is tried where it is expected to take less than this share of the budget."""

DETAIL_HOLD_FRAMES = 8
"""Frames between two changes of the step, so that a view does not flicker between two of them."""

SAMPLES_AT_REST = 1024
"""Samples a pixel at which a view at rest is finished, unless the settings say how many."""

REALTIME_FRAMES_AT_REST = 128
"""Frames in real time after which a view at rest is finished."""

ANSWER_S = 0.5
"""How long a page that has never answered may take to say that a frame is there before the next one is sent, seconds:
after that, it gets frames as they come."""

BUSY_ANSWER_S = 5.0
"""The same of a page that has answered before: it is busy, or hidden."""

DEPTH_STRIDE = 4
"""Pixels of a frame to one of its depth, along each axis, that gizmos hide behind."""

NOISE_AT_REST = 0.005
"""Relative error at which a view at rest is finished, unless the settings say another."""

JPEG_QUALITY_MOVING = 80
"""Of the JPEGs of a view that moves, 1 to 95."""

JPEG_QUALITY_AT_REST = 95
"""Of those of a view at rest."""

UNDO_MAX = 200
"""Edits that can be undone: what they have replaced is kept in memory."""

UNDO_BYTES_MAX = 2**30
"""Memory of assets that undoing edits alone would need, bytes: beyond it, the oldest edits cannot be undone."""

DRAG_ENDS_S = 1.0
"""A drag that has not moved for so long, seconds, has ended: its page may be gone."""

BEFORE_SAMPLES = 16
"""Samples a pixel of the left part of a split picture at rest."""

PLAY_STEPS_PER_S = 30.0
"""Times a second that an animation is moved on while it plays."""

DETAIL_TIME_DECAY = 0.995
"""Factor by which a step that was too slow is taken to be quicker with every frame, until it is tried again."""

HEIGHTS = (90, 2160)
"""Rows that pictures at rest may have."""

BUDGETS_MS = (10.0, 500.0)
"""What a frame of a view that moves may be given, milliseconds."""

MERGE_S = 1.5
"""Edits of one control that follow each other within this time, seconds, are undone as one."""
