"""The compiled table writer: the text of Python's own formatting, for every number."""

from __future__ import annotations

import struct

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calib.io.cells import GENERAL, TIME, WHOLE, table_bytes

FORMATS = {TIME: ".6f", GENERAL: ".9g", WHOLE: ".0f"}


def expected(values: np.ndarray, kinds: list[int]) -> bytes:
    lines = []
    for row in values.tolist():
        cells = ["" if v != v else format(v, FORMATS[k]) for v, k in zip(row, kinds, strict=True)]
        lines.append(",".join(cells) + "\n")
    return "".join(lines).encode()


def check(values: np.ndarray, kinds: list[int]) -> None:
    assert table_bytes(values, np.array(kinds)) == expected(values, kinds)


def test_rounding_at_the_edge() -> None:
    """Ten digits that end in 5 are ties or next to one; neighbours of powers of ten change their exponent."""
    rng = np.random.default_rng(2)
    ties = (np.floor(10.0 ** rng.uniform(8, 9, 5000)) + 0.5) * 10.0 ** rng.integers(-20, 4, 5000)
    powers = 10.0 ** np.arange(-40, 23)
    edges = np.concatenate([powers, np.nextafter(powers, 0.0), np.nextafter(powers, np.inf)])
    micro = np.floor(rng.uniform(0, 1e9, 5000)) * 1e-6 + 5e-7
    for values in (ties, np.nextafter(ties, 0.0), np.nextafter(ties, np.inf), edges, 999999999.5 / edges):
        check(values[:, None], [GENERAL])
    check(micro[:, None], [TIME])
    check(np.nextafter(micro, 0.0)[:, None], [TIME])


@settings(max_examples=300, deadline=None)
@given(st.lists(st.floats(), min_size=1, max_size=6), st.sampled_from([TIME, GENERAL, WHOLE]))
@example([struct.unpack("<d", b"\xff" * 6 + b"\xef\x7f")[0]], GENERAL)
@example([-0.0, 0.0, -1e-9], TIME)
@example([-0.0, 0.0, -1.0], WHOLE)
@example([9.999999995, 99999.99995, 0.00001234565, 1e9, 123456789.5], GENERAL)
def test_any_double(cells: list[float], kind: int) -> None:
    check(np.array([cells]), [kind] * len(cells))
