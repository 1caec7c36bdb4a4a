"""The marker before the camera as a log: what `calib track` does, while one looks at it."""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from calib.core.arrays import AnyArray
from calib.core.errors import BadInputError, UsageError
from calib.core.files import shown
from calib.core.writing import appending, write_atomically
from calib.io.frames import Times
from calib.live.album import Album
from calib.stages.camera.marker import (
    TRACK,
    TRACK_COLUMNS,
    Colour,
    Disc,
    Tracker,
    colour_at,
    parse_colour,
    track_rows,
    track_text,
)

_HEAD = ",".join(TRACK_COLUMNS) + "\n"
_MOST_FRAMES = 500_000
"""Of one recording: more than two hours at 60 frames a second."""
_PLOTTED_S = 20.0


@dataclass
class Marker:
    """Follows the marker, and records it where that is asked for.

    Rows are on the disk as they come; at the end they are written once more, with the times from the first
    one on and with the scatter of the whole track in their standard deviations.
    """

    album: Album
    colour: Colour = field(default_factory=lambda: parse_colour("orange"))
    tracker: Tracker | None = None
    path: Path | None = None
    last: str = ""
    _frame: AnyArray | None = None
    _stream: BinaryIO | None = None
    _times: Times = field(default_factory=lambda: Times(arrival=True, rate_hz=0.0))
    _discs: list[Disc | None] = field(default_factory=list)
    _plot: deque[tuple[float, float | None, float | None]] = field(default_factory=lambda: deque(maxlen=600))

    @property
    def recording(self) -> bool:
        """Whether a recording is under way."""
        return self._stream is not None

    def follow(self, frame: AnyArray, t_s: float) -> dict[str, Any]:
        """What a page is told of a frame (H, W, 3) that was taken at a time; a row where that is recorded."""
        if frame.ndim == 2:
            return {"code": "dark", "says": "The picture has no colours: a marker cannot be told in it."}
        if self.recording and self._frame is not None and frame.shape != self._frame.shape:
            self.stop()
            self.last += "; it ended where frames of another size came"
        self._frame = frame
        if self.tracker is None:
            self.tracker = Tracker(self.colour)
        one = self.tracker.follow(frame)
        if self._stream is not None:
            self._record(one, t_s)
        size = [frame.shape[1], frame.shape[0]]
        while self._plot and self._plot[0][0] < t_s - _PLOTTED_S:
            self._plot.popleft()
        if one is None:
            self._plot.append((t_s, None, None))
            says = "The marker is not seen: click on it."
            if self.tracker.doubled:
                says = "Several discs have its colour: click on the marker."
            return {"code": "no board", "says": says, "size": size}
        u, v = one.centre_px.tolist()
        self._plot.append((t_s, round(u, 2), round(v, 2)))
        marker = {"u": round(u, 2), "v": round(v, 2), "radius": round(one.radius_px, 2)}
        says = f"Recording: {len(self._discs)} frames." if self._stream else "The marker is seen."
        return {"code": "hold", "says": says, "size": size, "marker": marker | {"sigma": one.sigma_px}}

    def click(self, at_px: tuple[float, float]) -> None:
        """Follow the disc at a pixel, in its own colour. Raises `BadInputError` where there is no colour."""
        self._only_between()
        learnt = None if self._frame is None else colour_at(self._frame, at_px)
        if learnt is None:
            raise BadInputError("there is no colour where you clicked, expected the marker")
        self.colour, self.tracker = learnt, Tracker(learnt, at_px)

    def named(self, colour: str) -> None:
        """Follow the only disc of a colour. Raises `BadInputError` for what is none."""
        self._only_between()
        try:
            self.colour = parse_colour(colour[:40])
        except UsageError as error:
            raise BadInputError(str(error).removeprefix("--colour: ")) from error
        self.tracker = None

    def _only_between(self) -> None:
        if self._stream is not None:
            raise BadInputError("the marker is being recorded: stop first")

    def start(self) -> None:
        """Record from the next frame on. Raises `BadInputError` where nothing can be written."""
        self._only_between()
        self.path = self.album.new_log("track")
        self._stream = appending(self.path, TRACK)
        self._stream.write(_HEAD.encode())
        self._times, self._discs = Times(arrival=True, rate_hz=0.0), []
        self.tracker = Tracker(self.colour) if self.tracker is None else self.tracker
        self.tracker.begin()

    def _record(self, one: Disc | None, t_s: float) -> None:
        stamps = self._times.stamps_s
        if stamps and t_s <= stamps[-1]:
            return
        stamps.append(t_s)
        self._discs.append(one)
        if self.tracker is not None:
            self.tracker.take_back(self._discs)
        assert self._stream is not None and self.path is not None
        try:
            self._stream.write(track_text(track_rows([t_s - stamps[0]], [one])).encode())
            self._stream.flush()
        except OSError as error:
            self._close()
            self.last = f"ended: {shown(self.path)} cannot be written: {error.strerror or error}"
        if len(stamps) >= _MOST_FRAMES:
            self.stop()

    def _close(self) -> None:
        if self._stream is not None:
            # What cannot be written has been told, or is written once more.
            with contextlib.suppress(OSError):
                self._stream.close()
        self._stream = None

    def stop(self) -> None:
        """End a recording, and say what it is worth; without effect where there is none."""
        if self._stream is None or self.path is None:
            return
        self._close()
        rows = track_rows(self._times.settled_s(), self._discs) if self._discs else []
        if not rows:
            self.path.unlink(missing_ok=True)
            self.last = "nothing was recorded: the marker was not seen"
            return
        try:
            write_atomically(self.path, _HEAD + track_text(rows), TRACK)
        except BadInputError as error:
            self.last = f"{error}; it has the rows that came before"
            return
        seen = f"marker in {len(rows)} of {len(self._discs)} frames, written to {shown(self.path)}"
        sigma = float(np.median([row[3] for row in rows]))
        doubt = "" if self.tracker is None else self.tracker.doubt(self._times.settled_s())
        told = (seen, doubt, f"sigma of the centre {sigma:.2f} px", self._times.words())
        self.last = "; ".join(part for part in told if part)

    def shown(self) -> dict[str, Any]:
        """State for a page, as JSON takes it."""
        begin = self._plot[0][0] if self._plot else 0.0
        return {
            "hue_deg": round(self.colour.hue_deg),
            "recording": None if self._stream is None or self.path is None else self.path.name,
            "last": self.last,
            "plot": [[round(t - begin, 3), u, v] for t, u, v in self._plot],
            "logs": [path.name for path in sorted(self.album.logs.glob("*.csv"))][:100],
        }
