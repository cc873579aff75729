"""Constants of baking: lit Gaussians as captures."""

BAKE_DIRECTIONS = 32
"""From which each Gaussian is looked at: twice as many as the harmonics of degree 3, as half of them see its back."""

BAKE_SAMPLES = 8
"""Paths a ray; even, so that both halves tell the noise."""

VIEWS_AT_ONCE = 2**17
"""Views that are on the device at once: some 60 MiB."""

VIEW_SPREAD = 0.5
"""Within how much of a Gaussian it is seen, standard deviations of its own. Frames blur once more what they blend of
neighbours: at 1, edges are blurred twice, and Gaussians see around corners (1.1 dB in a room); at 0, the edge of a
shadow is jagged."""

PILOT_DIRECTIONS = 8
"""From which each Gaussian is seen first, to know on which side it is seen; with two paths each."""

SIDE_MIN = 0.05
"""Share of what counts below which a side is not looked at any further: the other one gets all directions."""

BACK_SHARE = 0.02
"""How much views of the back of Gaussians count whose normals are known, relative to those of their front."""

DARK_SIDE_MIN = 1e-3
"""Least factor of views of a side that is dark, where the other one is lit: it is the inside of something closed."""

RIDGE = 3e-4
"""Penalty of (l (l + 1))^2 times the square of a coefficient of degree l, where an even view counts 1: what nobody sees
stays smooth. Of degree 3, it takes 4 % of what is seen from everywhere."""

SIGNAL_MIN = 1e-8
"""Variance of colours over directions below which they are taken to be one, display-referred: 0.03 of 255."""

BAKE_DIRECTIONS_MAX = 1024
"""More directions of a Gaussian are a typing error: harmonics of degree 3 have 16 coefficients."""

RAYS_A_DIRECTION = 2
"""Rays to Gaussians that are seen together, for each direction from which they are seen alone."""

LINE_ROUNDS = 8
"""Rounds of as many lines as a Gaussian is to have rays, to those that lack any: in closed rooms, a quarter
to a half of the lines show the back of something, or what is not baked, and near corners up to nine in ten."""

GOLDEN_STEP = 0.6180339887498949
"""Fraction of the golden ratio: its multiples are spread evenly, however many there are."""

SHARED_COLOR_MIN = 0.02
"""Share of even light that rays show below which differences between rays count less: what they reflect is not noise of
light that others have, too."""

DIRECT_SLOPE = 2.0
"""How fast rays keep more of their own direct light as they differ from what is shared by more than their noise: by 1,
edges of shadows are drawn to the mean, too, which costs 0.5 dB in a room."""

BOUNCED_PART = 2
"""One in so many paths of each ray bounces: what has bounced is shared among rays, so that fewer tell enough."""

BOUNCED_MIN = 2
"""Paths of each half of the samples that bounce at least, if there are as many."""

SIGHT_REACH = 3.0
"""Standard deviations from the middle of a Gaussian up to which rays look at it, of those seen together."""

SIGHT_MIN = 0.005
"""Share of a ray below which a Gaussian is left out of it: half of those that it meets, and 1 % of what it shows."""

COVERED_MIN = 0.05
"""Share of a ray that Gaussians must cover for it to tell of them."""

OTHERS_MAX = 0.02
"""Share of a ray up to which what is not baked may show on it; it is not shaded."""

SPAN_PAST = 1e-4
"""How far behind the last Gaussian rays end before meshes, of its distance: more than float32 leaves uncertain."""

LINES_AT_ONCE = 2**17
"""Lines whose Gaussians are listed at once: some 200 MB of the host's memory."""

CHANGE_SPREAD = 0.15
"""Standard deviation of the changes that are expected of coefficients by what is seen together, of degree 0; of degree
l a part of 1 / (l + 1), so that noise of rays does not go into how matt surfaces change with the direction."""

MISFIT = 0.03
"""Error of blended harmonics that is expected besides noise, display-referred."""

TOGETHER_STEPS = 40
"""Most steps of conjugate gradients: with 10, a room has 0.3 dB less, a statue 0.3, a ball of rough metal 0.6."""

TOGETHER_ERROR = 1e-6
"""Relative residual at which these end: what single precision on the device resolves."""

TOGETHER_RAYS = 2**19
"""Rays to Gaussians that are changed together: to 8,192 of them with 32 directions."""
