"""Where frames come from when it is not the browser: a camera, a stream, a video, or a folder that fills."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import cv2

from calib.core.arrays import AnyArray
from calib.core.errors import BadInputError
from calib.core.files import read_bytes, shown
from calib.io.frames import next_frame, opened_video
from calib.io.pictures import declared_pixels, decode, decoded_heic, holds_pictures, is_heic, list_pictures

os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")
MOST_PIXELS = 30_000_000
"""Pixels of a frame."""
_AGAIN_S = 2.0
_LOOK_AGAIN_S = 0.3
_SETTLED_S = 0.5
"""A file that has not grown for so long is whole."""


class Source(Protocol):
    """Frames, (H, W) or (H, W, 3) of uint8.

    `single`: each frame is a picture that somebody took. `fault`: why there are none at the moment, "" else.
    """

    single: bool
    fault: str

    def read(self) -> AnyArray | None:
        """The newest frame that was not read yet; None where there is none within a moment."""

    def close(self) -> None:
        """Let go of the camera."""


class Capture:
    """A device, stream or video that OpenCV opens; it is opened again when it is lost.

    Raises `BadInputError` where it cannot be opened at first.
    """

    single = False

    def __init__(self, where: int | str) -> None:
        self.fault = ""
        self._where, self._name = where, f"camera {where}" if isinstance(where, int) else shown(where)
        self._file = isinstance(where, str) and "://" not in where
        self._newest: AnyArray | None = None
        self._ready, self._over = threading.Condition(), False
        video = opened_video(self._where)
        if video is None:
            raise BadInputError(
                f"{self._name}: cannot be opened, expected the number of a camera, a stream's address, a "
                "video or a folder; without any the browser's camera is used"
            )
        self._thread = threading.Thread(target=self._run, args=(video,), daemon=True)
        self._thread.start()

    def _run(self, video: cv2.VideoCapture | None) -> None:
        period_s = 1.0 / max(video.get(cv2.CAP_PROP_FPS) or 30.0, 1.0) if video is not None else 0.0
        due = time.monotonic()
        while not self._over:
            if video is None:
                time.sleep(_AGAIN_S)
                video = None if self._over else opened_video(self._where)
                continue
            frame = next_frame(video)
            if frame is None or frame.shape[0] * frame.shape[1] > MOST_PIXELS:
                video.release()
                if self._file:
                    self.fault = f"{self._name} has ended."
                    return
                self.fault = f"{self._name} is lost; it is tried again."
                video = None
                continue
            with self._ready:
                self.fault, self._newest = "", frame
                self._ready.notify()
            if self._file:
                due += period_s
                time.sleep(max(0.0, due - time.monotonic()))
        if video is not None:
            video.release()

    def read(self) -> AnyArray | None:
        """As `Source.read`."""
        with self._ready:
            if self._newest is None:
                self._ready.wait(_LOOK_AGAIN_S)
            frame, self._newest = self._newest, None
        return frame

    def close(self) -> None:
        """As `Source.close`."""
        self._over = True
        self._thread.join(2.0)


class Watched:
    """Pictures that appear in a folder, one after the other, those that are there first.

    One that changes is looked at again: what comes over a network may stand still half-written.
    """

    single = True

    def __init__(self, folder: Path, now: Callable[[], float] = time.time) -> None:
        self.fault, self._folder, self._now = "", folder, now
        self._done: dict[str, tuple[int, int]] = {}

    def read(self) -> AnyArray | None:
        """As `Source.read`."""
        there: list[Path] = []
        # It may go at any moment, as that of a network or a card does.
        with contextlib.suppress(BadInputError):
            there = list_pictures([self._folder]) if holds_pictures(self._folder) else []
        gone = f"{shown(self._folder)}: is gone, or is no folder any more; it is looked for again."
        if not self._folder.is_dir():
            self.fault = gone
        elif self.fault == gone:
            self.fault = ""
        for path in there:
            try:
                found = path.stat()
            except OSError:
                continue
            stamp = found.st_size, found.st_mtime_ns
            # A clock that is ahead, as a phone's or a server's, says nothing of how long ago it was.
            if self._done.get(path.name) == stamp or abs(self._now() - found.st_mtime) <= _SETTLED_S:
                continue
            self._done[path.name] = stamp
            self.fault = ""
            frame = None
            try:
                data = read_bytes(path)
                pixels = declared_pixels(data)
                if pixels > MOST_PIXELS:
                    raise BadInputError(f"{shown(path)}: has more than {MOST_PIXELS // 10**6} million pixels")
                if pixels > 0:
                    frame = decoded_heic(data, shown(path)) if is_heic(data) else decode(data, colour=True)
            except BadInputError as error:
                self.fault = str(error)
                return None
            if frame is None:
                self.fault = f"{shown(path)} is not a picture that can be decoded (yet)."
            return frame
        time.sleep(_LOOK_AGAIN_S)
        return None

    def close(self) -> None:
        """As `Source.close`."""


def source_of(words: str | None, own: Path) -> Source | None:
    """The source that a person names; None for the browser's camera.

    Raises `BadInputError` where it is not there, or is the folder into which the pictures go (`own`).
    """
    if words is None:
        return None
    if words.isdecimal():
        return Capture(int(words))
    if "://" in words:
        return Capture(words)
    path = Path(words)
    if path.is_dir():
        if path.resolve() == own.resolve():
            raise BadInputError(
                f"{shown(path)}: is where pictures are saved, expected another folder to watch"
            )
        return Watched(path)
    if not path.exists():
        raise BadInputError(
            f"{shown(path)}: does not exist, expected a camera's number, an address or a path"
        )
    return Capture(words)
