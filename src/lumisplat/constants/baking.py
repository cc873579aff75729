"""Constants of baking: lit Gaussians as captures."""

BAKE_DIRECTIONS = 32
"""From which each Gaussian is looked at: twice as many as the harmonics of degree 3, as half of them see its back."""

BAKE_SAMPLES = 8
"""Paths a direction; even, so that both halves tell the noise."""

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

SIGHT_REACH = 3.0
"""Standard deviations from the middle of a Gaussian up to which rays look at it, of those seen together."""

SIGHT_MIN = 0.005
"""Share of a ray below which a Gaussian is left out of it: half of those that it meets, and 1 % of what it shows."""

COVERED_MIN = 0.05
"""Share of a ray that Gaussians must cover for it to tell of them."""

OTHERS_MAX = 0.02
"""Share of a ray up to which what is not baked may show on it."""

CHANGE_SPREAD = 0.045
"""Standard deviation of the changes that are expected of coefficients by what is seen together. At 0.07, frames of
degree 3 are 0.1 dB worse to 0.25 dB better in three scenes, of degree 0 up to 0.4 dB better, but a single Gaussian in
a furnace is off by 0.065, not 0.045: by noise of its rays."""

MISFIT = 0.03
"""Error of blended harmonics that is expected besides noise, display-referred."""

TOGETHER_STEPS = 10
"""Of conjugate gradients: with 60, frames are the same to 0.2 dB."""

TOGETHER_GAUSSIANS = 2**14
"""Gaussians that are changed together: with 32 rays each, some 2 GB of the host's memory."""
