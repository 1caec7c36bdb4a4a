"""What a rig folder holds: pictures, pictures of the plane, logs at rest, of poses and in motion.

A symbolic link that leads out of the folder is left out and named: a folder that somebody else made
must not bring files of this machine into a page that is passed on.
"""

from __future__ import annotations

import stat
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from calib.core.errors import BadInputError
from calib.core.files import PICTURES, VIDEOS, file_sha256, inside, one_line, shown, slug, to_be
from calib.core.options import NOTHING_STATED, LogOptions
from calib.core.words import several

LOGS = (".csv", ".tsv", ".parquet", ".mcap", ".bag", ".db3")
"""Endings of logs in logs/."""


@dataclass(frozen=True)
class LogFile:
    """A log of the folder.

    Attributes
    ----------
    slug : a name that is safe as a file's name, different for each log.
    columns : that it has, None where it cannot be told.
    kind : "rest", "poses" or "motion", by the file's name.
    """

    path: Path
    slug: str
    columns: tuple[str, ...] | None
    kind: str

    def has(self, *names: str) -> bool:
        """Whether the log may have all these columns."""
        return self.columns is None or all(name in self.columns for name in names)


@dataclass(frozen=True)
class Folder:
    """A rig folder.

    Attributes
    ----------
    pictures, plane : picture files, where there are none videos, of the plane one; board, plane_board : their
        board.yaml, None without.
    logs : in the order of their names.
    rig : the folder's own rig.yaml, None without.
    left_out : sentences on files that were not taken.
    options : what a person states of the logs.
    """

    root: Path
    pictures: tuple[Path, ...]
    board: Path | None
    plane: tuple[Path, ...]
    plane_board: Path | None
    logs: tuple[LogFile, ...]
    rig: Path | None
    left_out: tuple[str, ...]
    options: LogOptions = NOTHING_STATED

    def files(self) -> tuple[Path, ...]:
        """Every file that is read."""
        single = (self.board, self.plane_board, self.rig)
        return (
            *self.pictures,
            *self.plane,
            *(path for path in single if path is not None),
            *with_beside(log.path for log in self.logs),
        )

    def name_of(self, path: Path) -> str:
        """Name relative to the folder, the same wherever the folder lies."""
        return path.relative_to(self.root).as_posix()


def read_folder(root: Path, follow_links: bool = False, options: LogOptions = NOTHING_STATED) -> Folder:
    """What a rig folder holds; `options` are what a person states of its logs.

    Raises `BadInputError` where there is no such folder, or nothing in it.
    """
    from calib.io.columns import is_arm_log
    from calib.io.logs import read_column_names
    from calib.io.states import STATES_FILE

    if not root.is_dir():
        what = "is a file" if root.exists() else "is not there"
        raise BadInputError(f"{shown(root)}: {what}, expected a folder with images/ and logs/")
    root = root.absolute()
    left_out: list[str] = []

    def taken(path: Path) -> bool:
        try:
            regular = stat.S_ISREG(path.stat().st_mode)
        except OSError:
            left_out.append(f"{_named(path, root)}: leads nowhere and was left out")
            return False
        if not regular:
            return False
        if not follow_links and not inside(path, root):
            left_out.append(
                f"{_named(path, root)}: is a link out of the folder and was left out; --follow-links takes it"
            )
            return False
        return True

    # Pictures alone may lie in the folder itself.
    flat = not any((root / name).is_dir() for name in ("images", "logs"))
    pictures, board = _pictures(root if flat else root / "images", taken)
    plane, plane_board = _pictures(root / "images" / "plane", taken, videos=1)
    logs: list[LogFile] = []
    states: list[Path] = []
    for path in _listed(root / "logs", LOGS):
        if not all(taken(part) for part in with_beside([path])):
            continue
        if STATES_FILE.ours(path):
            states.append(path)
        else:
            name = slug(path.stem, (log.slug for log in logs))
            logs.append(LogFile(path, name, read_column_names(path, options), _kind(path.name)))
    own = root / "rig.yaml"
    rig = own if own.is_file() and taken(own) else None
    beside = [
        path
        for path in _listed(root, LOGS)
        if path.is_file()
        and not path.is_symlink()
        and read_column_names(path, options)
        and not STATES_FILE.ours(path)
    ]
    left_out += _passed_over(root, flat, beside, {*pictures, *plane})
    if states:
        left_out.append(f"logs/: states that calib replay has written, left out: {_names(states)}")
    if arms := [log.path for log in logs if is_arm_log(log.columns or ())]:
        left_out.append(f"logs/: of a bending arm, which calib identify arm takes: {_names(arms)}")
    if not (pictures or plane or logs):
        raise BadInputError(
            f"{shown(root)}: holds no pictures in images/ and no logs in logs/, found "
            f"{_names(_entries(root)) or 'nothing'}; {left_out[0] if left_out else 'see calib run --help'}"
        )
    return Folder(root, pictures, board, plane, plane_board, tuple(logs), rig, tuple(left_out), options)


def _named(path: Path, root: Path) -> str:
    return one_line(path.relative_to(root).as_posix())


def _pictures(
    folder: Path, taken: Callable[[Path], bool], videos: int | None = None
) -> tuple[tuple[Path, ...], Path | None]:
    """Pictures, where there are none videos, so many at most; and what says which board they show."""
    pictures = tuple(path for path in _listed(folder, PICTURES) if taken(path))
    pictures = pictures or tuple(path for path in _listed(folder, VIDEOS) if taken(path))[:videos]
    board = folder / "board.yaml"
    return pictures, board if board.exists() and taken(board) else None


def _passed_over(root: Path, flat: bool, logs: Iterable[Path], pictures: Collection[Path]) -> list[str]:
    """Sentences on files and folders that a person may have meant to be read, `logs` outside of logs/ too.

    `pictures` are those that are read.
    """
    misplaced = [(root / "plane", "images/plane/"), *((path, "logs/") for path in logs)]
    names = ["images", "logs", "rig.yaml", "images/plane", "images/board.yaml", "images/plane/board.yaml"]
    meant = [root / name for name in (*names, *(["board.yaml"] if flat else []))]
    said = [
        f"{_named(path, root)}: was left out, expected the name {one.name}"
        for one in meant
        if not (one.exists() or one.is_symlink())
        for path in _entries(one.parent)
        if path.name.lower().replace(".yml", ".yaml") == one.name
    ]
    said += [
        f"{_named(path, root)}: was left out, expected in {to}" for path, to in misplaced if path.exists()
    ]
    folders = [path for path in _entries(root / "images") if path.is_dir()]
    strange = [path for path in folders if path.name.lower() not in ("plane", "dropped")]
    if strange:
        said.append(f"images/: {_names(strange)} left out, folders are not looked into")
    for place, videos in (("images", "videos"), ("images/plane", "one video")):
        files = [path for path in _entries(root / place) if path.is_file() and inside(path, root)]
        strange = [path for path in files if path not in pictures and not _beside_pictures(path)]
        if strange:
            said.append(
                f"{place}/: {_names(strange)} left out, expected pictures, or where there are none {videos}"
            )
    strange = [path for path in _entries(root / "logs") if path.suffix.lower() not in (*LOGS, ".yaml")]
    if folders := [path for path in strange if path.is_dir()]:
        said.append(
            f"logs/: {_names(folders)} left out, folders are not looked into; of a ROS 2 bag put "
            "its file there"
        )
    strange = [path for path in strange if path not in folders]
    if strange:
        *most, last = LOGS
        said.append(
            f"logs/: {_names(strange)} left out, expected logs that end in {', '.join(most)} or {last}"
        )
    return said


def _beside_pictures(path: Path) -> bool:
    """Whether a file belongs beside pictures: a board.yaml, or what a system puts there."""
    return path.suffix.lower() in (".yaml", ".yml") or path.name.lower() in ("thumbs.db", "desktop.ini")


def _names(paths: Iterable[Path]) -> str:
    return several([one_line(path.name)[:60] for path in paths])


def _entries(folder: Path) -> list[Path]:
    """What a person sees in a folder; ~$ begins what Office leaves of a table that is open."""
    if not folder.is_dir():
        return []
    with to_be("listed", folder):
        found = [path for path in folder.iterdir() if not path.name.startswith((".", "~$"))]
    return sorted(found, key=lambda path: path.name)


def _listed(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return [path for path in _entries(folder) if path.suffix.lower() in suffixes]


def _kind(name: str) -> str:
    for start, kind in (("static", "rest"), ("poses", "poses")):
        if name.lower().startswith(start):
            return kind
    return "motion"


def with_beside(logs: Iterable[Path]) -> tuple[Path, ...]:
    """Logs, each followed by the files beside it that say what is in it."""
    from calib.io.logs import companion_files

    return tuple(dict.fromkeys(part for path in logs for part in (path, *companion_files(path))))


def folder_digests(folder: Folder) -> dict[Path, str]:
    """SHA-256 of every file that is read."""
    return {path: file_sha256(path) for path in folder.files()}
