"""The folder of a live session: pictures, board.yaml, rig.yaml. What is on the disk is the session."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from calib.core.errors import BadInputError
from calib.core.files import shown
from calib.core.options import options_of
from calib.core.rig import SECTIONS
from calib.core.stage import Files
from calib.core.writing import (
    RIG_FILE,
    Kind,
    begins,
    check_folder,
    check_writable,
    make_folder,
    move,
    write_atomically,
)
from calib.io.pictures import holds_pictures, list_pictures
from calib.stages import stage
from calib.stages.camera.model import View
from calib.stages.camera.options import Told
from calib.stages.camera.read import BOARD_FILE, BoardFile, read_board_file, read_views

if TYPE_CHECKING:
    from calib.stages.camera.intrinsics import Intrinsics
    from calib.stages.camera.section import Camera, Plane

MOST_PICTURES = 300
"""Pictures of one session."""
_DROPPED = "dropped"
_PICTURE = Kind("a picture", (".png",), lambda path: False)
"""One that is there is never written over."""
_BOARD = Kind("a board.yaml", (".yaml",), begins(b"corners: "))


@dataclass(frozen=True)
class Album:
    """A folder with `images/`, `images/board.yaml`, `images/dropped/` and `rig.yaml`."""

    folder: Path

    @property
    def images(self) -> Path:
        """Where the pictures are."""
        return self.folder / "images"

    @property
    def plane(self) -> Path:
        """Where the picture of the board in the plane of motion is."""
        return self.images / "plane"

    @property
    def logs(self) -> Path:
        """Where recordings are."""
        return self.folder / "logs"

    @property
    def rig(self) -> Path:
        """The rig's file."""
        return self.folder / RIG_FILE

    @property
    def dropped(self) -> Path:
        """Pictures that are left out; sub-folders of a folder of pictures are not read."""
        return self.images / _DROPPED

    def open(self, told: Told) -> tuple[BoardFile, tuple[View, ...], tuple[int, int] | None]:
        """The board as far as it is known, the views of an earlier session, and the size of its pictures.

        Raises `BadInputError` where the folder cannot be made, read or written, or tells another board than
        `told`.
        """
        check_folder(self.images)
        make_folder(self.images)
        check_writable(self.rig, SECTIONS)
        board = read_board_file(self.images)
        stated = None if board.corners is None else (board.corners[0], board.corners[1])
        for flag, here, there in (
            ("--corners", told.corners, stated),
            ("--square", told.square_m, board.square_m),
        ):
            if here is not None and there is not None and here != there:
                raise BadInputError(
                    f"{shown(self.images / BOARD_FILE)}: tells another board than {flag} ({there}, not "
                    f"{here}); give another folder for another board"
                )
        if not holds_pictures(self.images):
            return board, (), None
        found = read_views([self.images], told)
        return board, found.views, found.image_size_px

    def names(self) -> list[str]:
        """Pictures that count, in the order in which they are read."""
        return _names(self.images)

    def left_out(self) -> list[str]:
        """Pictures that were dropped."""
        return _names(self.dropped)

    def new_name(self) -> str:
        """A name for the next picture, with a number that no picture here has."""
        taken = [
            int(found[1]) for name in (*self.names(), *self.left_out()) if (found := _NUMBER.search(name))
        ]
        return f"view{max(taken, default=0) + 1:03d}.png"

    def add(self, name: str, png: bytes) -> None:
        """Write a picture as it was taken. Raises `BadInputError`."""
        write_atomically(self.images / name, png, _PICTURE)

    def describe(self, board: BoardFile) -> None:
        """Write board.yaml where there is none."""
        path = self.images / BOARD_FILE
        if not path.exists():
            write_atomically(path, _written(board), _BOARD)

    def picture(self, name: str) -> Path | None:
        """Where a picture of this name is, dropped or not; None for what is none."""
        for folder, names in ((self.images, self.names()), (self.dropped, self.left_out())):
            if name in names:
                return folder / name
        return None

    def drop(self, name: str) -> bool:
        """Put a picture aside; whether there was one."""
        if name not in self.names():
            return False
        make_folder(self.dropped)
        move(self.images / name, self.dropped / name)
        return True

    def take_back(self, name: str) -> bool:
        """Let a picture that was dropped count again; whether there was one."""
        if name not in self.left_out():
            return False
        move(self.dropped / name, self.images / name)
        return True

    def lay(self, png: bytes, board: BoardFile) -> Plane:
        """Save a picture of the board in the plane and where it lies; what `calib extrinsics` makes of it.

        An earlier picture, and what was written of it, goes into `images/plane/dropped/`.

        Raises `BadInputError` where it shows no plane; it is not kept then, and an earlier one stays.
        """
        before = [path for path in self.plane.glob("*") if path.is_file()]
        aside = self.plane / _DROPPED
        place = next(one for k in count(1) if not (one := aside / str(k)).exists())
        make_folder(self.plane)
        if before:
            make_folder(place)
        for path in before:
            move(path, place / path.name)
        new = [self.plane / BOARD_FILE, self.plane / "plane001.png"]
        try:
            write_atomically(new[0], _written(board), _BOARD)
            write_atomically(new[1], png, _PICTURE)
            plane: Plane = self._carried_out("extrinsics", self.plane)
        except BadInputError:
            for path in new:
                path.unlink(missing_ok=True)
            for path in before:
                move(place / path.name, path)
            raise
        return plane

    def new_log(self, name: str) -> Path:
        """Where the next recording of this name goes; no other one is there."""
        make_folder(self.logs)
        return next(path for k in count(1) if not (path := self.logs / f"{name}{k}.csv").exists())

    def calibrate(self) -> Camera:
        """What `calib intrinsics images/` makes of the pictures, written into rig.yaml by its stage.

        Raises `BadInputError` where they make no camera.
        """
        camera: Camera = self._carried_out("intrinsics", self.images)
        return camera

    def _carried_out(self, verb: str, pictures: Path) -> Any:
        from calib.runner.work import carry_out

        made = stage(verb)
        files = Files((pictures,), self.rig, figures=False, keep=False)
        return carry_out(made, files, options_of(made.options, {}), self.rig)[0]


def fit_of(album: Album | None) -> Intrinsics | None:
    """Calibrate an album's pictures as `Album.calibrate`, for a process of its own; None makes that ready."""
    import calib.runner.work  # noqa: F401  takes longer to load than some pictures to fit

    return None if album is None else album.calibrate().evidence


def _written(board: BoardFile) -> str:
    """board.yaml of what is known of a board."""
    known = board.model_dump(exclude_none=True, exclude_unset=True)
    return str(yaml.safe_dump(known, sort_keys=False, default_flow_style=None if board.corners else False))


def _names(folder: Path) -> list[str]:
    there = folder.is_dir() and holds_pictures(folder)
    return [path.name for path in list_pictures([folder])] if there else []


_NUMBER = re.compile(r"(\d{1,9})\.\w+$")
