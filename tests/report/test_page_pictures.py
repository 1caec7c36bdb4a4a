"""Small copies of pictures and figures, kept by what they were made from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from calib.show.page import data_uri, keep_pictures, kept_picture, size_of, small_figure


def _png(path: Path, width: int, height: int, seed: int = 0) -> Path:
    noise = np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    return path


def test_changed_and_missing_pictures_are_followed(tmp_path: Path) -> None:
    path, kept = _png(tmp_path / "a.png", 60, 40), tmp_path / "kept"
    keep_pictures([path], kept)
    before = kept_picture("a.png", kept)
    keep_pictures([path], kept)
    assert kept_picture("a.png", kept) == before
    keep_pictures([_png(path, 60, 40, seed=1)], kept)
    assert kept_picture("a.png", kept) != before
    keep_pictures([], kept)
    assert kept_picture("a.png", kept) is None


def test_a_figure_is_smaller_and_made_once(tmp_path: Path) -> None:
    shades = np.linspace(0, 255, 600, dtype=np.uint8)
    figure = tmp_path / "f.png"
    Image.fromarray(np.stack([np.add.outer(shades, shades) // k for k in (1, 2, 3)], axis=-1)).save(figure)
    small = small_figure(figure, tmp_path / "figures")
    assert len(small) < figure.stat().st_size and size_of(small) == (600, 600)
    assert small_figure(figure, tmp_path / "figures") == small
    assert len(list((tmp_path / "figures").iterdir())) == 1
    assert data_uri(small).startswith("data:image/png;base64,")
    vector = tmp_path / "v.svg"
    vector.write_text("<svg/>")
    assert data_uri(small_figure(vector, tmp_path / "figures")).startswith("data:image/svg+xml;")
