"""Which frames of a recording are worth keeping: those that add most to what is known of the camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.stages.camera.bundle import calibrate
from calib.stages.camera.checks import evidence, repeated_views
from calib.stages.camera.model import View, pack

# A view's information about the intrinsics, with its own pose eliminated, is S_i (see `checks`), over the
# square of its residuals, so that a blurred or a smeared frame counts less. Views are taken one by one, each
# the one that lowers the volume of the error ellipsoid most: the largest log det(S + S_i), of each place of
# the board one.

MOST = 30
_FEWEST = 20
_WORTH = 0.01
"""Mean lowering of the sigmas, in shares, that a further frame has to bring."""
_MODEL = "radial2"
_LITTLE = 1e-6


def most_informative(views: Sequence[View], image_size_px: tuple[int, int]) -> list[int]:
    """Indices of the views to keep, in their own order; all where they are few or fit no camera."""
    every = list(range(len(views)))
    if len(views) <= _FEWEST:
        return every
    packed = pack(views)
    try:
        fit = calibrate(packed, image_size_px, _MODEL, tolerance=1e-2, max_iterations=40)
        S = evidence(fit).S
    except (np.linalg.LinAlgError, ValueError):
        return every
    G, rms = len(fit.free), fit.view_rms_px
    S = S / np.maximum(rms, np.median(rms))[:, None, None] ** 2
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->i", S), 1e-300))
    S = S * scale * scale[:, None]
    total = _LITTLE * np.eye(G)
    place = repeated_views(packed, max(image_size_px))
    chosen: list[int] = []
    while len(chosen) < min(MOST, len(np.unique(place))):
        gain = np.linalg.slogdet(total + S)[1] - np.linalg.slogdet(total)[1]
        gain[np.isin(place, place[chosen])] = -np.inf
        best = int(np.argmax(gain))
        if len(chosen) >= _FEWEST and gain[best] < 2.0 * G * _WORTH:
            break
        chosen.append(best)
        total = total + S[best]
    return sorted(chosen)
