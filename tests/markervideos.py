"""Rendered videos of an orange disc that moves: light, blur, noise, other orange things, and the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from calib.core.arrays import AnyArray, FloatArray

_FINE = 4
"""Samples of a pixel to each side."""


@dataclass(frozen=True)
class Scene:
    """A marker before a desk.

    Attributes
    ----------
    exposure : share of the frame's time in which light is gathered: the marker moves meanwhile.
    flicker : by how much the light changes.
    shift_px : of the disc from where it else is.
    other : "none", "block" (a rectangle), "disc" (a smaller one), "way" (a rectangle that the marker passes).
    """

    size_px: tuple[int, int] = (640, 480)
    rate_hz: float = 60.0
    radius_px: float = 9.0
    exposure: float = 0.5
    flicker: float = 0.35
    other: str = "block"
    noise: float = 3.0
    gamma: float = 1.6
    seed: int = 0
    shift_px: tuple[float, float] = (0.0, 0.0)

    def centre_px(self, t_s: float | FloatArray) -> FloatArray:
        """Where the disc is: loops with up to 7 px between frames."""
        width, height = self.size_px
        t = np.asarray(t_s)
        u = width * (0.5 + 0.27 * np.cos(2.1 * t) + 0.03 * np.sin(7.0 * t))
        v = height * (0.5 + 0.3 * np.sin(1.7 * t) + 0.02 * np.cos(9.0 * t))
        return np.stack([u, v], axis=-1) + self.shift_px

    def frames(self, count: int) -> Iterator[tuple[float, AnyArray]]:
        """Times of the middles of the exposures, and frames (H, W, 3) in BGR."""
        rng = np.random.default_rng(self.seed)
        width, height = self.size_px
        coarse = rng.uniform(0.05, 0.45, (height // 40 + 1, width // 40 + 1, 3)).astype(np.float32)
        desk = cv2.resize(coarse, self.size_px, interpolation=cv2.INTER_CUBIC).clip(0.02, 0.6)
        # Nothing on the desk has the marker's colour.
        desk = (0.7 * desk.mean(axis=2, keepdims=True) + 0.3 * desk[..., ::-1] * [1.0, 0.9, 0.6]).astype(
            np.float32
        )
        orange = np.array([0.03, 0.25, 0.85], dtype=np.float32)
        if self.other == "block":
            desk[40:90, 60:150] = 0.9 * orange
        elif self.other == "way":
            desk[300:400, 420:470] = 0.9 * orange
        elif self.other == "disc":
            cv2.circle(desk, (120, 70), 6, (0.9 * orange).tolist(), -1, cv2.LINE_AA)
        u = np.broadcast_to(np.arange(width), (height, width))
        for k in range(count):
            t = k / self.rate_hz
            around = self.centre_px(t)
            reach = int(self.radius_px + 20)
            left, top = (np.floor(around) - reach).astype(int)
            n = 2 * reach
            grid = (np.arange(n * _FINE) + 0.5) / _FINE - 0.5
            share = np.zeros((n * _FINE, n * _FINE), dtype=np.float32)
            during = (np.arange(8) + 0.5) / 8 - 0.5
            for step in during:
                cu, cv = self.centre_px(t + step * self.exposure / self.rate_hz) - [left, top]
                distance = np.hypot(grid[None, :] - cu, grid[:, None] - cv)
                share += np.clip((self.radius_px - distance) * _FINE + 0.5, 0, 1).astype(np.float32)
            share /= len(during)
            share = cv2.GaussianBlur(share, (0, 0), 0.6 * _FINE)
            share = share.reshape(n, _FINE, n, _FINE).mean(axis=(1, 3))[..., None]
            frame = desk.copy()
            rows, columns = (
                slice(max(top, 0), min(top + n, height)),
                slice(max(left, 0), min(left + n, width)),
            )
            part = share[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
            frame[rows, columns] = (1 - part) * frame[rows, columns] + part * orange
            light = 0.9 + self.flicker * np.sin(3.0 * t) + 0.25 * (u / width - 0.5) * np.cos(1.3 * t)
            tint = 1 + 0.08 * np.sin(2.0 * t) * np.array([-1.0, 0.0, 1.0])
            seen = 255 * np.clip(frame * light[..., None] * tint, 0, 1) ** (1 / self.gamma)
            seen += self.noise * rng.standard_normal(seen.shape, dtype=np.float32)
            yield t, np.clip(np.rint(seen), 0, 255).astype(np.uint8)
