"""The programme of recordings of a connected board, and what comes in meanwhile.

`calib record` runs in a process of its own, so that no tick waits for a picture that is being fitted. What is
plotted is read from the log as it grows: it is on the disk already.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import threading
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calib.core.errors import BadInputError
from calib.core.units import plain_number
from calib.io.experiments import EXPERIMENTS
from calib.live.album import Album

PROGRAMME = {
    "static": "Nothing moves, and nothing touches the rig.",
    "swing": "Take the hoses off, pull the head aside by 20 to 30 degrees, start, and let go.",
    "ellipse": "Slow motion to large angles both ways.",
    "steps": "Commands in steps, and the hoses on.",
    "deflate": "Commands up, then off, and the hoses on.",
}
"""What is to be done for each recording; how long it takes is in `calib.io.experiments`."""


def _duration(name: str) -> str:
    return f"{EXPERIMENTS[name].seconds:g}s"


SERIES = {
    "marker (px)": ("u_px", "v_px"),
    "angle (rad)": ("board_phi_rad",),
    "rates (rad/s)": ("gx_radps", "gy_radps", "gz_radps"),
    "commands (PWM)": ("pwm1", "pwm2"),
}
"""What is plotted, by the names of the log's columns; those that it has not are left out."""
_PLOTTED_S = 20.0
_MOST_SENT = 300
_MOST_WORDS = 400
_PATIENCE_S = 8.0


@dataclass
class Board:
    """Records one log after the other from a port."""

    album: Album
    port: str
    path: Path | None = None
    last: str = ""
    done: list[str] = field(default_factory=list)
    _process: subprocess.Popen[str] | None = None
    _heads: list[str] = field(default_factory=list)
    _read: int = 0
    _there: set[Path] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _rows: deque[list[float | None]] = field(default_factory=lambda: deque(maxlen=4000))

    @property
    def at_work(self) -> bool:
        """Whether a recording is under way."""
        return self._process is not None

    def start(self, name: str) -> None:
        """Begin a recording. Raises `BadInputError` for one that is unknown, or during another."""
        if self._process is not None:
            raise BadInputError("a recording is under way: stop it first")
        if name not in PROGRAMME:
            raise BadInputError(f"there is no recording {name[:40]!r}, expected {', '.join(PROGRAMME)}")
        with self._lock:
            self.last = ""
            self._begin(self.album.new_log(name))
            self._there = set(self.album.logs.iterdir())
        words = ["record", self.port, "-o", str(self.path), "--duration", _duration(name), "--json"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "calib", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # Ctrl-C at the terminal ends the page, which then ends the recording as a person would.
            start_new_session=True,
        )

    def stop(self) -> None:
        """End the recording at hand as Ctrl-C does, and wait for its end."""
        process = self._process
        if process is not None:
            # Not SIGINT: of a page that was started in the background its children ignore that.
            process.terminate()
            try:
                process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            self.ended()

    def ended(self) -> bool:
        """Whether the recording at hand has come to its end; what it said is kept then."""
        with self._lock:
            process = self._process
            if process is None or process.poll() is None:
                return False
            out, said = process.communicate()
            self._more()
            if process.returncode == 0 and self.path is not None:
                logs = json.loads(out)["record"]["logs"]
                told = (f"{one['ticks']} ticks in {one['log']}, {one['lost']} lost" for one in logs)
                self.last = "; ".join(told)
                self.done.append(self.path.name)
            else:
                lines = [line.removeprefix("calib: ") for line in said.strip().splitlines() if line]
                self.last = (lines or ["the recording ended without a word"])[-1][:_MOST_WORDS]
            # Whoever sees that it is over finds what it said.
            self._process = None
            return True

    def _begin(self, path: Path) -> None:
        self.path, self._heads, self._read = path, [], 0
        self._rows.clear()

    def _more(self) -> None:
        """Rows that the log has got since it was last read, of the board's last start."""
        if self.path is None or not self.path.exists():
            return
        # As `calib record` names the log of a further start.
        if new := set(self.album.logs.glob(f"{self.path.stem.split('-')[0]}-*.csv")) - self._there:
            self._there |= new
            self._begin(max(new, key=lambda path: (len(path.name), path.name)))
        with self.path.open("rb") as stream:
            stream.seek(self._read)
            data = stream.read(1 << 20)
        whole = data[: data.rfind(b"\n") + 1]
        self._read += len(whole)
        for row in csv.reader(whole.decode("ascii", "replace").splitlines()):
            if not self._heads:
                self._heads = row
            elif len(row) == len(self._heads):
                self._rows.append([_number(cell) for cell in row])

    def shown(self) -> dict[str, Any]:
        """State for a page, as JSON takes it."""
        with self._lock:
            self._more()
            at, rows = {name: k for k, name in enumerate(self._heads)}, list(self._rows)
            recording = self.path.name if self.path is not None and self.at_work else None
        end = rows[-1][at["t_s"]] if rows and "t_s" in at else None
        if end is not None:
            rows = [row for row in rows if (row[at["t_s"]] or 0.0) >= end - _PLOTTED_S]
        rows = rows[:: max(1, len(rows) // _MOST_SENT)]
        plots = [
            {
                "title": title,
                "names": [name for name in names if name in at],
                "rows": [[row[at["t_s"]], *(row[at[name]] for name in names if name in at)] for row in rows],
            }
            for title, names in SERIES.items()
            if "t_s" in at and any(name in at for name in names)
        ]
        return {
            "port": self.port,
            "programme": [[name, _duration(name), what] for name, what in PROGRAMME.items()],
            "recording": recording,
            "seconds": None if end is None else round(end, 1),
            "last": self.last,
            "done": self.done,
            "plots": plots,
        }


def _number(cell: str) -> float | None:
    value = plain_number(cell)
    return value if value is not None and abs(value) < 1e12 else None
