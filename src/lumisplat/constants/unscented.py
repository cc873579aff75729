"""Constants of rasterised Gaussians whose response is that along each pixel's ray (Wu et al. 2025, 3DGUT)."""

UNSCENTED_ALPHA = 1.0
"""Spread of the sigma points; 3DGUT's value, as the next two: sqrt(3) standard deviations from the mean."""

UNSCENTED_BETA = 2.0
"""What is known of the distribution; 2 is best for a Gaussian (Wan and van der Merwe 2000)."""

UNSCENTED_KAPPA = 0.0
"""The other number that spreads the sigma points."""

UNSCENTED_SINE_MAX = 0.02
"""Sine of half the angle under which a Gaussian is seen, up to which sigma points bound it. They know the projection
along its three axes only, and extrapolate: where it bends within the Gaussian, they miss some of it."""

UNSCENTED_MARGIN = 0.1
"""By this share of themselves bounds by sigma points are wider: within 0.02 radians, projections of pinholes up to 157
degrees across bend by less, tan(78.5 degrees) times 0.02."""

UNSCENTED_SLACK_PX = 0.5
"""And by so many pixels, for lenses that nearly stop to magnify, as at the edge of what they show."""

OUTLINE_POINTS = 16
"""Points on the outline of a Gaussian that is seen under a larger angle."""

OUTLINE_SLACK = 0.5
"""Its bounds are wider by this share of the largest second difference of the points: four times what a smooth curve
strays from the chord between two of them."""

SHUTTER_STEPS = 5
"""Steps in which the row that sees a point finds the time at which it is exposed. 3DGUT's number."""

FIELD_MARGIN = 0.1
"""Radians beyond the last ray of a pinhole's image up to which points are projected as they are. From there on they
move outwards with their angle, where tangents would leave all bounds."""

FIELD_MAX = 1.56
"""Largest angle of that kind, radians."""
