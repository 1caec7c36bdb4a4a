"""What one command reads and writes, so that no output takes the place of an input."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

WATCHER = "watcher of signals"
"""Name of the thread that waits for signals, in a system call and without locks: a fork beside it is safe."""


@dataclass
class Command:
    """What a command has read and is about to write.

    Attributes
    ----------
    inputs : places of files by device and number. outputs : words for what goes there, by place.
    swept : folders that were looked at for what killed processes have left.
    stdout_taken : whether an output goes to stdout, so that words must not.
    """

    inputs: dict[tuple[int, int], str] = field(default_factory=dict)
    outputs: dict[str, str] = field(default_factory=dict)
    swept: set[str] = field(default_factory=set)
    stdout_taken: bool = False

    def keep(self, paths: Iterable[Path]) -> None:
        """Note files, and those directly in folders, as inputs."""
        for path in paths:
            with contextlib.suppress(OSError):
                for one in path.iterdir() if path.is_dir() else [path]:
                    if (number := number_of(one)) is not None:
                        self.inputs[number] = os.path.realpath(one)

    def reads(self, path: Path) -> bool:
        """Whether this is an input, under whatever name."""
        number = number_of(path)
        # A number is given away again when its file is gone.
        return number is not None and number in self.inputs and number_of(self.inputs[number]) == number


_current: ContextVar[Command | None] = ContextVar("command", default=None)


def current() -> Command | None:
    """The command at work; None in a program that calls single functions."""
    return _current.get()


@contextlib.contextmanager
def one_command(inputs: Iterable[Path] = ()) -> Iterator[None]:
    """Run what is inside as a command with these inputs and all that it reads.

    Inside of another command it is a part of that.
    """
    outer = _current.get()
    command = Command() if outer is None else outer
    token = _current.set(command)
    try:
        command.keep(inputs)
        yield
    finally:
        _current.reset(token)


def note_inputs(paths: Iterable[Path]) -> None:
    """Note inputs of the command at work before they are read, as `Command.keep`."""
    if (command := current()) is not None:
        command.keep(paths)


def number_of(path: Path | str) -> tuple[int, int] | None:
    """Device and number of a regular file, the same for all its names; None for anything else."""
    try:
        status = Path(path).stat()
    except OSError:
        return None
    return (status.st_dev, status.st_ino) if Path(path).is_file() else None
