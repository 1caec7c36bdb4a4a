"""The packages of the extra `fleet`, loaded when they are first needed."""

from __future__ import annotations

import importlib
from typing import Any

from calib.errors import BadInputError, pip_install


def needed(name: str) -> Any:
    """A module by its name. Raises `BadInputError` where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise BadInputError(
            f"{name} cannot be loaded, which fleets and sweeps need ({error}): {pip_install('fleet')}"
        ) from error
