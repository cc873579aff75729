"""Colours captures by how far their materials may be off, for the views `ERROR_VIEWS`."""

from __future__ import annotations

import math
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

import lumisplat as ls
from lumisplat.viewer.session import ERROR_VIEWS

_STOPS = np.array([[0.078, 0.0, 0.285], [0.821, 0.241, 0.242], [0.999, 0.957, 0.696]])
"""Colours of no error, of half the error that is shown yellow, and of that error: violet, red and pale yellow."""

_COLORED: dict[str, WeakKeyDictionary[ls.Gaussians, ls.Gaussians]] = {
    view: WeakKeyDictionary[ls.Gaussians, ls.Gaussians]() for view in ERROR_VIEWS
}
"""Result of `_colored` by view and capture, so that renderers upload a capture once."""


def shown_scene(scene: ls.Scene, view: str) -> ls.Scene:
    """Returns the scene that a view renders: unlit captures coloured by the view's error, or ``scene`` in other views.

    Violet is an error of 0, yellow that in `ERROR_VIEWS` or more. Captures without the error are black.
    """
    if view not in ERROR_VIEWS:
        return scene
    plain = [replace(one, gaussians=_colored(one.gaussians, view), material=None) for one in scene.splats]
    return replace(scene, splats=plain)


def _colored(gaussians: ls.Gaussians, view: str) -> ls.Gaussians:
    found = _COLORED[view].get(gaussians)
    if found is None:
        error = getattr(gaussians, view)
        colors = np.zeros((gaussians.count, 3))
        if error is not None:
            at = 2.0 * error / ERROR_VIEWS[view]
            for channel in range(3):
                colors[:, channel] = np.interp(at, (0.0, 1.0, 2.0), _STOPS[:, channel])
        sh = 2.0 * math.sqrt(math.pi) * (colors - 0.5)  # the first SH basis function is 1 / (2 sqrt(pi))
        found = _COLORED[view][gaussians] = replace(gaussians, sh=sh[:, None].astype(np.float32), albedo=None)
    return found
