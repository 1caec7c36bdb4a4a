"""All figures of the source that runs of our own can stand for, in its order."""

from __future__ import annotations

from thesis import (
    drawn_angle,
    drawn_ellipse,
    drawn_lengths,
    drawn_models,
    drawn_pumps,
    drawn_schemes,
    drawn_sensors,
    drawn_swings,
)
from thesis.drawn import Drawn

__all__ = ["ALBUM"]

ALBUM: tuple[Drawn, ...] = (
    *drawn_sensors.FIGURES,
    *drawn_models.FIGURES,
    *drawn_swings.ORIGINAL,
    *drawn_pumps.STEADY,
    *drawn_swings.IMPROVED,
    *drawn_pumps.MOVING,
    *drawn_angle.FIGURES[:4],
    drawn_schemes.clamping,
    *drawn_angle.FIGURES[4:],
    drawn_schemes.with_feedforward,
    *drawn_lengths.BEFORE,
    *drawn_ellipse.BEFORE,
    *drawn_lengths.AFTER,
    *drawn_ellipse.AFTER,
)
"""Every figure once."""
