"""What a person says of a camera's pictures, and how the camera is to be calibrated from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from calib.core.options import option
from calib.core.units import parse_corners, parse_image_size, parse_square_m


@dataclass(frozen=True)
class Told:
    """What is said of the board and the pictures; None where nothing is."""

    corners: tuple[int, int] | None = option(
        None,
        "Inner corners, columns x rows, as 7x5. [default: board.yaml, else found]",
        metavar="CxR",
        parse=parse_corners,
    )
    square_m: float | None = option(
        None,
        "Side of a square with its unit, as 20mm. [default: board.yaml]",
        flag="square",
        metavar="LENGTH",
        parse=parse_square_m,
    )
    dictionary: str | None = option(
        None,
        "Markers of a ChArUco board, as 4X4_50. [default: board.yaml, else found]",
        metavar="NAME",
    )
    topic: str | None = option(None, "Image topic of a bag. [default: the only one]", metavar="NAME")
    image_size_px: tuple[int, int] | None = option(
        None,
        "Size of the pictures in px, for tables, as 640x480.",
        flag="image-size",
        metavar="WxH",
        parse=parse_image_size,
    )


@dataclass(frozen=True)
class Choices:
    """How to calibrate; what is "auto", and a skew of None, is chosen by views held back.

    Views and points that `keep_all` keeps are named all the same.
    """

    model: Literal["auto", "pinhole", "radial2", "radial3", "fisheye4", "brown5", "rational8"] = option(
        "auto", "Lens model; auto compares all on views held back."
    )
    skew: bool | None = option(
        None, "Estimate the skew, or never. [default: with --model auto where the views show one]"
    )
    loss: Literal["none", "huber", "cauchy"] = option("none", "Robust loss of the residuals.")
    board: Literal["rigid", "warp", "released", "auto"] = option(
        "auto",
        "The board: flat, bent by two parameters, with free corners; auto compares them on views held back "
        "where the views contradict a flat one.",
    )
    keep_all: bool = option(
        False, "Use pictures and points as well that do not agree with the others; by default they leave."
    )


BY_DEFAULT = Choices()


@dataclass(frozen=True)
class IntrinsicsOptions(Choices, Told):
    """How a camera is calibrated."""
