"""Views from tables: what is checked beyond the table's own form, and what is left as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.core.errors import BadInputError
from calib.stages.camera.read import Told, read_views
from synthetic import views_of

SIZE = (640, 480)


@pytest.fixture
def table(tmp_path: Path):
    def write(change=lambda x, y, u, v: (x, y, u, v)) -> Path:
        rows = ["view,x_m,y_m,u_px,v_px"]
        for view in views_of(3):
            points = np.hstack([view.target_m, view.pixels]).tolist()
            rows += [",".join([view.name, *map(repr, change(*point))]) for point in points]
        path = tmp_path / "points.csv"
        path.write_text("\n".join(rows))
        return path

    return write


def test_a_distant_target_is_moved_to_its_origin(table) -> None:
    path = table(lambda x, y, u, v: (x + 500.0, y - 300.0, u, v))
    found = read_views([path], Told(image_size_px=SIZE))
    moved = [view.target_m - truth.target_m for view, truth in zip(found.views, views_of(3), strict=True)]
    # The same for all views, to what the table's digits hold of a millimetre at 500 m.
    assert np.ptp(np.concatenate(moved), axis=0).max() < 1e-12
    assert max(np.abs(view.target_m).max() for view in found.views) < 0.2


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda x, y, u, v: (x, y, u + 500, v), "points lie outside a picture of 640x480 px"),
        (lambda x, y, u, v: (x, y, u, v - 480), "points lie outside a picture of 640x480 px"),
        (lambda x, y, u, v: (x * 1e6, y, u, v), "its target lies 2e\\+05 m away, expected metres"),
        (lambda x, y, u, v: (x * 1e-9, y * 1e-9, u, v), "its target measures 2e-10 m, expected metres"),
    ],
)
def test_points_that_cannot_be(table, change, says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        read_views([table(change)], Told(image_size_px=SIZE))


def test_a_table_beyond_the_memory_is_refused_by_its_size(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("view,x_m,y_m,u_px,v_px\n")
    with path.open("r+b") as stream:
        # A file with holes takes no room on the disk.
        stream.truncate(2_000_000_000)
    with pytest.raises(BadInputError, match="is larger than 500 MB"):
        read_views([path], Told(image_size_px=SIZE))
