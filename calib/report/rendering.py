"""Pages from their templates: each is one file, with its style and its script in it."""

from __future__ import annotations

import base64
import hashlib
from importlib import resources
from typing import Any

__all__ = ["render"]


def render(template: str, style: tuple[str, ...], script: tuple[str, ...], **values: Any) -> str:
    """A template of this package with what else goes into a page.

    Parameters
    ----------
    style, script : names of files that are put one behind the other. The page's policy lets no script run
        but this one.
    values : what the template asks for beside them; all of it is escaped.
    """
    import jinja2

    words = "".join(_resource(name) for name in script)
    digest = base64.b64encode(hashlib.sha256(words.encode()).digest()).decode()
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = environment.from_string(_resource(template)).render(
        style="".join(_resource(name) for name in style),
        script=words,
        script_hash=f"sha256-{digest}",
        **values,
    )
    # A file's name may hold halves of characters, which no page can.
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _resource(name: str) -> str:
    return (resources.files("calib.report") / "templates" / name).read_text(encoding="utf-8")
