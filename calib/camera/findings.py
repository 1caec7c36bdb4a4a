"""What a check has found about a calibration, and the limits that a finding is held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = [
    "INCONSISTENT",
    "OK",
    "POOR",
    "REMARK",
    "UNIDENTIFIABLE",
    "VERDICTS",
    "Finding",
    "Limits",
    "listed",
]

OK = "ok"
POOR = "poor"
INCONSISTENT = "inconsistent"
UNIDENTIFIABLE = "unidentifiable"
REMARK = "remark"

VERDICTS = (OK, POOR, INCONSISTENT, UNIDENTIFIABLE)
"""From the best to the worst; the worst finding decides."""


@dataclass(frozen=True)
class Finding:
    """A sentence, its weight (one of `VERDICTS` but `OK`, or `REMARK`) and what to do about it."""

    kind: str
    text: str
    advice: str = ""


def listed(names: Sequence[str], most: int = 6) -> str:
    """Names for a sentence, the rest counted."""
    if len(names) <= most:
        return ", ".join(names)
    return ", ".join(names[:most]) + f" and {len(names) - most} more"


@dataclass(frozen=True)
class Limits:
    """Where a calibration stops being good.

    Attributes
    ----------
    views : unique views below which nothing is left over to check the answer with.
    focal_remark, focal_poor, focal_free : relative standard deviation of a focal length. Distances
        told by the camera are off by the same share.
    spread_poor_deg, spread_free_deg : largest angle between two boards. Focal length comes from
        perspective alone, which goes with the tilt.
    area_poor : share of the image that the points span.
    view_poor : share of the image that a typical view spans.
    projection_share : standard deviation of projection inside of what was seen, over the width.
    centre_poor, centre_remark : offset of the principal point from the image's centre, over its side.
    lens_remark, lens_poor, lens_poor_px : share, and pixels, of the RMS that a richer lens model would
        take away.
    rms_px : residuals above which something is wrong whatever it is, at up to 1000 pixels' width.
    view_bad, view_remark : RMS of a view over the others'.
    point_factor, point_floor_px, points_poor : a point off by this many medians and pixels is an
        outlier; share of outliers.
    heavy_remark : share of the squared residuals that the worst percent of points may hold.
    repeated_remark : error that repeats at the same points over what independent errors leave.
    repeat_share : share of unique views below which the copies rule the answer.
    decrement : standard deviations that the solver may stop short of a minimum.
    split_ratio, change_ratio : two cameras, in any order and one after the other: the statistic over
        what chance reaches. One camera reaches 1.2 in a hundred sets, two that differ by three
        percent 2 to 50.
    split_sigma, split_least : largest difference of an intrinsic over its standard deviation, and
        the difference of focal length or principal point, as a share of the focal length or
        width, that matters.
    aspect_bad, aspect_remark, aspect_sigma : squares that are not square, as a share, and over its
        standard deviation. Printers stretch by up to half a percent.
    pixel_aspect : fx over fy where the board cannot tell whether it is to blame.
    bow_bad, bow_remark, bow_sigma : departure from flatness over the board's size, and over its
        standard deviation.
    bow_focal, bow_focal_remark : share by which a bend that is there may move the focal length.
    fragile : share by which a bend of half a percent of the size may do so.
    rival_cost, rival_focal : another minimum with a cost up to this much higher and a focal length
        this share away is a rival.
    """

    views: int = 4
    focal_remark: float = 0.015
    focal_poor: float = 0.03
    focal_free: float = 0.10
    spread_poor_deg: float = 12.0
    spread_free_deg: float = 5.0
    area_poor: float = 0.20
    view_poor: float = 0.01
    projection_share: float = 0.002
    centre_poor: float = 0.15
    centre_remark: float = 0.10
    lens_remark: float = 0.1
    lens_poor: float = 0.33
    lens_poor_px: float = 0.1
    rms_px: float = 1.0
    view_bad: float = 5.0
    view_remark: float = 3.0
    point_factor: float = 8.0
    point_floor_px: float = 0.5
    points_poor: float = 0.01
    heavy_remark: float = 0.2
    repeated_remark: float = 1.6
    repeat_share: float = 0.5
    decrement: float = 2.0
    split_ratio: float = 1.5
    change_ratio: float = 1.3
    split_sigma: float = 4.0
    split_least: float = 0.007
    aspect_bad: float = 0.007
    aspect_remark: float = 0.003
    aspect_sigma: float = 4.0
    pixel_aspect: float = 0.02
    bow_bad: float = 0.010
    bow_remark: float = 0.005
    bow_sigma: float = 4.0
    bow_focal: float = 0.015
    bow_focal_remark: float = 0.005
    fragile: float = 0.03
    rival_cost: float = 1.10
    rival_focal: float = 0.10
