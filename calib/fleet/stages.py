"""One rig in this process: the stages of `calib run`, or those of a camera, one verb after the other.

The verbs are those that a person types, with the same words, so that the results are the same bytes.
Figures are drawn only for a page; they change no number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from calib.errors import EXIT_BAD_INPUT, EXIT_DONE, EXIT_POOR, BadInputError
from calib.files import shown
from calib.running.folder import Folder, read_folder
from calib.running.outputs import exit_code, publish, summary
from calib.running.pool import Command, run_here
from calib.running.runner import Done, Runner, opened
from calib.running.stages import STAGES, Planned, Stage

__all__ = ["CAMERA_STAGES", "Ended", "kind_of", "rig_folder", "run_stages"]

CAMERA_STAGES = ("intrinsics", "extrinsics", "distortion")
_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")


@dataclass(frozen=True)
class Ended:
    """How a rig's stages ended, and the results by name relative to `out`."""

    code: int
    stages: dict[str, str]
    reasons: tuple[str, ...]
    out: Path
    files: tuple[str, ...]


class _Here:
    """Runs each command at once, in this process."""

    def __init__(self) -> None:
        self._ended: list[tuple[str, int]] = []

    @property
    def free(self) -> bool:
        """Whether another command can start."""
        return not self._ended

    def start(self, command: Command) -> None:
        """Run a command to its end."""
        self._ended.append((command.name, run_here(command)))

    def finished(self) -> Iterator[tuple[str, int]]:
        """The command that was run."""
        ended, self._ended = self._ended, []
        yield from ended


def rig_folder(root: Path) -> Folder:
    """What a rig's folder holds; pictures may lie in it directly where there is neither images/ nor logs/.

    Raises `BadInputError` for a folder with nothing to work on.
    """
    if (root / "images").is_dir() or (root / "logs").is_dir():
        return read_folder(root)
    root = root.absolute()
    try:
        found = sorted(path for path in root.iterdir() if path.suffix.lower() in _PICTURES and path.is_file())
    except OSError as error:
        raise BadInputError(f"{shown(root)}: cannot be listed: {error.strerror or error}") from error
    pictures = tuple(path for path in found if not path.is_symlink() and not path.name.startswith("."))
    if not pictures:
        raise BadInputError(f"{shown(root)}: holds no images/, no logs/ and no pictures")
    board, rig = root / "board.yaml", root / "rig.yaml"
    return Folder(
        root, pictures, board if board.is_file() else None, (), None, (), rig if rig.is_file() else None, ()
    )


def kind_of(folder: Folder) -> str:
    """ "camera" for a folder that holds only pictures, "run" for one with logs."""
    return "run" if folder.logs else "camera"


def _given(stage: Stage, folder: Folder, words: tuple[str, ...]) -> Stage:
    """A stage with more words in its command."""
    planned = "" if stage.plan is None else stage.plan(folder)
    if not words or not isinstance(planned, Planned):
        return stage
    told = Planned((*planned.arguments, *words), planned.inputs)
    return replace(stage, plan=lambda _: told)


def _stages(
    folder: Folder, kind: str, options: Sequence[tuple[str, str]], figures: bool
) -> tuple[Stage, ...]:
    words = tuple(word for key, value in options for word in (f"--{key}", value))
    wanted = [stage for stage in STAGES if kind == "run" or stage.name in CAMERA_STAGES]
    out = []
    for stage in wanted:
        if stage.name == "intrinsics":
            stage = _given(stage, folder, words)
        out.append(stage if figures else replace(stage, figures=False))
    return tuple(out)


def run_stages(
    folder: Folder, kind: str, options: Sequence[tuple[str, str]], out: Path, page: bool = False
) -> Ended:
    """Run a folder's stages into a new output folder. Raises `BadInputError` as `calib run` does."""
    from calib.cli.run import is_available

    with opened(out, folder.root):
        runner = Runner(
            folder, out, _Here(), is_available, stages=_stages(folder, kind, options, page), fresh=True
        )
        ended = runner.run()
        told = summary(runner, ended, False)
        files = publish(runner, ended, told)
        if page:
            from calib.report.page import write_page
            from calib.report.page_pictures import keep_pictures
            from calib.running.runner import HIDDEN

            keep_pictures(folder.pictures, out / HIDDEN / "pictures")
            write_page(out / "rig.yaml")
            files = [*files, "report.html"]
    code = exit_code(ended) if kind == "run" else _camera_code(ended)
    reasons = tuple(f"{done.job.stage.title}: {done.reason}" for done in ended if done.status in _TELLING)
    return Ended(code, {done.job.name: done.status for done in ended}, reasons, out, tuple(files))


_TELLING = ("poor", "failed", "blocked")


def _camera_code(ended: Sequence[Done]) -> int:
    """As `calib run` would end, firmware apart: 3 when a stage has failed, 1 when one is poor."""
    statuses = {done.status for done in ended}
    if statuses & {"failed", "blocked"}:
        return EXIT_BAD_INPUT
    return EXIT_POOR if "poor" in statuses or "ok" not in statuses else EXIT_DONE
