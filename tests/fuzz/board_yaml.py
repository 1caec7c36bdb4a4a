"""board.yaml, by itself and beside another folder's."""

from __future__ import annotations

from pathlib import Path

MODULES = ("calib.stages.camera.read", "calib.core.bounded_yaml")

WORDS = (
    b"corners:", b"square_m:", b"first_corner_m:", b"angle_rad:", b"first_corner_px:", b"[7, 5]", b"[7.0, 5]",
    b"[200, 3]", b"0.02", b"10", b"[0.1, .nan]", b"6.3", b"- 7\n- 5", b"7x5",
)  # fmt: skip


def check(data: bytes, folder: Path) -> None:
    """A board of sane numbers, or a refusal; the same board in two folders is one board."""
    from calib.stages.camera.read import board_of, read_board_file

    (folder / "other").mkdir(exist_ok=True)
    for place in (folder, folder / "other"):
        (place / "board.yaml").write_bytes(data)
    board = read_board_file(folder)
    if board.corners is not None:
        assert all(3 <= count <= 200 for count in board.corners)
    if board.square_m is not None:
        assert 1e-5 <= board.square_m < 10
    told, _hashes = board_of([folder, folder / "other"])
    assert told == board
