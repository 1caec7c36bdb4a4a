"""Packages of the extra: there or told of in one sentence."""

from __future__ import annotations

import pytest

from calib.errors import BadInputError
from calib.fleet.extra import needed


def test_a_package_that_is_not_there() -> None:
    assert needed("json").dumps([1]) == "[1]"
    with pytest.raises(BadInputError, match=r"no_such_package_of_ours cannot be loaded.*extra fleet"):
        needed("no_such_package_of_ours")
