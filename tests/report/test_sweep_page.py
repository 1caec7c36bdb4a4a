"""The page of a sweep: whole in itself, with the best and the worst."""

from __future__ import annotations

import re

from calib.runner.sweep import Base, Point, SweepSpec, SweepSummary
from calib.show.fleet import sweep_page_text

_SPEC = SweepSpec(
    Base("controller", "pid", "jump", "", "truth", None, "auto"),
    (("pump.lag_s", (0.1, 0.2)),),
    (),
    3,
    0,
    ("m",),
)


def _point(number: int, loss: float) -> Point:
    return Point(
        number, (("pump.lag_s", 0.1 * number),), loss, 2.0 * loss, loss, 3, (("m", loss), ("n", 7.0))
    )


def test_what_is_told() -> None:
    summary = SweepSummary(
        6, 1, 0, "<b>too heavy</b>", "m", ("m", "n"), (_point(1, 0.125),), (_point(2, 8.5),),
        (("pump.lag_s", ((0.1, 0.125), (0.2, 8.5))),),
    )  # fmt: skip
    text = sweep_page_text(_SPEC, summary)
    assert "controller pid on jump" in text and "1 of them failed: &lt;b&gt;too heavy" in text
    assert text.index("0.125") < text.index("8.5") and "Simulated." in text and ">7<" in text
    assert not re.search(r"https?://|src=", text)
