"""Where compiled functions are kept when neither the package's folder nor the user's can be written."""

from __future__ import annotations

import os
import stat
from pathlib import Path

_NAME = "NUMBA_CACHE_DIR"


def choose_folder(package: Path | None = None) -> None:
    """Name a folder of the user's own among the temporary ones to numba, where it would find none.

    Numba looks beside the functions and in the home folder by itself, and fails without either. It runs what
    it finds, so the folder must be nobody else's. Call it before numba is imported.
    """
    beside = Path(__file__).parent if package is None else package
    if os.environ.get(_NAME) or os.access(beside, os.W_OK) or os.access(Path("~").expanduser(), os.W_OK):
        return
    import tempfile

    folder = Path(tempfile.gettempdir()) / f"calib-compiled-{os.getuid() if hasattr(os, 'getuid') else 'own'}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        os.environ[_NAME] = str(folder if _own(folder) else tempfile.mkdtemp(prefix="calib-compiled-"))
    except OSError:
        # Nothing at all can be written; numba will say so.
        return


def _own(folder: Path) -> bool:
    found = folder.lstat()
    private = not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o077)
    return stat.S_ISDIR(found.st_mode) and private
