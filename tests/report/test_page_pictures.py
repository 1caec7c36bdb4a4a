"""Small copies of pictures and figures, kept by what they were made from."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from calib.report.page_pictures import data_uri, keep_pictures, kept_picture, size_of, small_figure


def _png(path: Path, width: int, height: int, seed: int = 0) -> Path:
    noise = np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    return path


def test_pictures_are_kept_by_name_with_their_own_size(tmp_path: Path) -> None:
    paths = [_png(tmp_path / "wide.png", 1300, 500), _png(tmp_path / "a\nb.png", 60, 40)]
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"\x89PNG")
    keep_pictures([*paths, broken], tmp_path / "kept")
    wide = kept_picture("wide.png", tmp_path / "kept")
    assert wide is not None and (wide.width_px, wide.height_px) == (1300, 500)
    with Image.open(io.BytesIO(wide.data)) as image:
        assert image.size == (640, 246)
    assert kept_picture("a\nb.png", tmp_path / "kept") is not None
    assert kept_picture("broken.png", tmp_path / "kept") is None


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


def test_a_damaged_copy_is_not_shown_and_made_again(tmp_path: Path) -> None:
    path, kept = _png(tmp_path / "a.png", 60, 40), tmp_path / "kept"
    keep_pictures([path], kept)
    before = kept_picture("a.png", kept)
    (place,) = kept.iterdir()
    place.write_bytes(place.read_bytes()[:-3])
    assert kept_picture("a.png", kept) is None
    keep_pictures([path], kept)
    assert kept_picture("a.png", kept) == before


def test_a_figure_of_few_colours_is_taken_as_it_is_or_narrowed(tmp_path: Path) -> None:
    figure = tmp_path / "f.png"
    shades = np.linspace(0, 255, 600, dtype=np.uint8)
    Image.fromarray(np.add.outer(shades, shades) // 2).convert("P").save(figure)
    assert small_figure(figure, tmp_path / "figures") == figure.read_bytes()
    assert not (tmp_path / "figures").exists()
    assert size_of(small_figure(figure, tmp_path / "figures", 300)) == (300, 300)
    assert small_figure(figure, tmp_path / "figures", 900) == figure.read_bytes()


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
