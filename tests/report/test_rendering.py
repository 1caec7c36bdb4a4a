"""A page from its template: whole, and with no script that its policy does not know."""

from __future__ import annotations

import base64
import re
from hashlib import sha256

import jinja2
import pytest

from calib.show.page import _resource, render


def test_the_policy_is_that_of_the_script() -> None:
    values = {
        "version": "1", "summary": {}, "what": "<x>", "feedback": "", "aim": "", "points": 0, "draws": 0,
        "tables": [], "clouds": [],
    }  # fmt: skip
    values["summary"] = {"cases": 1, "failed": 0, "why": "", "measure": "m", "as_before": 0}
    text = render("sweep.html.j2", ("page.css",), ("common.js",), **values)
    (script,) = re.findall(r"<script>(.*?)</script>", text, re.S)
    assert script == _resource("common.js")
    digest = base64.b64encode(sha256(script.encode()).digest()).decode()
    assert f"sha256-{digest}" in text and "&lt;x&gt;" in text and "<x>" not in text
    both = render("sweep.html.j2", ("page.css",), ("common.js", "page.js"), **values)
    assert _resource("common.js") + _resource("page.js") in both and f"sha256-{digest}" not in both
    # Half of a character, as a file's name may hold.
    assert "\\udc80" in render("sweep.html.j2", (), (), **{**values, "what": "\udc80"})
    with pytest.raises(jinja2.UndefinedError):
        render("sweep.html.j2", (), ())
