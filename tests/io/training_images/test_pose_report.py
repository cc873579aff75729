"""Remarks on the quality of estimated poses."""

from __future__ import annotations

from dataclasses import replace

from lumisplat.io.training_images.poses import PoseReport

NAMES = [f"{k:04}.jpg" for k in range(40)]
GOOD = PoseReport(NAMES, NAMES, model_sizes=[40], points=9000, points_per_image=700.0, error=0.6, fov_degrees=60.0)


def test_report_on_well_estimated_camera_poses_has_no_remarks() -> None:
    """All images have poses, with many points, small errors and a usual field of view."""
    assert GOOD.remarks() == []


def test_report_on_estimated_camera_poses_has_one_remark_per_fault() -> None:
    """Each fault gives one line and no other."""
    for found, words in (
        (replace(GOOD, with_pose=NAMES[:38]), "no pose was found for 2 of 40 images (0038.jpg, 0039.jpg)"),
        (replace(GOOD, with_pose=NAMES[:20]), "extract more frames"),
        (replace(GOOD, model_sizes=[20, 12, 8]), "3 separate models, of 20, 12 and 8 images: the largest"),
        (
            replace(GOOD, points_per_image=20.0),
            "an image observes 20 of 9,000 points on average, expected 50 or more: poses are likely wrong",
        ),
        (replace(GOOD, error=1.8), "error is 1.8 pixels, expected below 1.5: poses are likely wrong"),
        (replace(GOOD, fov_degrees=5.0), "field of view is 5 degrees, expected 15 to 130"),
        (replace(GOOD, fov_degrees=160.0), "field of view is 160 degrees"),
    ):
        (line,) = found.remarks()
        assert words in line
    few = replace(GOOD, with_pose=NAMES[:38]).remarks()[0]
    assert "extract more frames" not in few
