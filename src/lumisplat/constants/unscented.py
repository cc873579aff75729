"""Constants of rasterised Gaussians whose response is that along each pixel's ray (Wu et al. 2025, 3DGUT)."""

UNSCENTED_ALPHA = 1.0
"""Spread of the sigma points; 3DGUT's value, as the next two: sqrt(3) standard deviations from the mean."""

UNSCENTED_BETA = 2.0
"""What is known of the distribution; 2 is best for a Gaussian (Wan and van der Merwe 2000)."""

UNSCENTED_KAPPA = 0.0
"""The other number that spreads the sigma points."""

UNSCENTED_SINE_MAX = 0.02
"""Half the size of a Gaussian, as a share of its distance from where the projection is not smooth, up to which sigma
points bound it. They know the projection along its three axes only, and extrapolate: where it bends within the
Gaussian, they miss some of it."""

PLANE_SHARE = 5.0
"""A pinhole's plane counts as so many times farther away: within 0.02 of that, tangents grow by up to a tenth."""

UNSCENTED_MARGIN = 0.1
"""By this share of themselves bounds by sigma points are wider: projections bend by less within 0.02 of the distance
above."""

UNSCENTED_SLACK_PX = 0.5
"""And by so many pixels, for lenses that nearly stop to magnify, as at the edge of what they show."""

OUTLINE_POINTS = 16
"""Points around the outline of a Gaussian that is seen under a larger angle."""

OUTLINE_SLACK = 0.5
"""Its bounds are wider by this share of the largest second difference of the points: four times what a smooth curve
strays from the chord between two of them."""

OUTLINE_MARGIN = 0.1
"""A Gaussian is all around the image when the direction against the axis is within its outline, wider by this."""

SHUTTER_STEPS = 5
"""Steps in which the row that sees a point finds the time at which it is exposed. 3DGUT's number."""

FIELD_MARGIN = 0.1
"""Radians beyond the last ray of a pinhole's image up to which points are projected as they are. From there on they
move outwards with their angle, where tangents would leave all bounds."""

FIELD_MAX = 1.56
"""Largest angle of that kind, radians."""
